"""What Zenoh writes of the links that who listens has refused, as it is told to people."""

from __future__ import annotations

import re
from collections import Counter

__all__ = ["RefusedLinks"]

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_REFUSED = re.compile(r"WARN.* zenoh_link_(?:tls|quic)\S*: (.*?)(?:\. Hint: .*)?$")
"""Why who listens has refused a link; the hint is about something else."""


class RefusedLinks:
    """What is told of links that who listens has refused: strangers may knock as often as they like."""

    def __init__(self) -> None:
        self._times: Counter[str] = Counter()

    def told(self, line: str) -> str | None:
        """What to say instead of a line that Zenoh has written; None if it is about something else.

        Each reason is told at its first time, its tenth, its hundredth and so on; otherwise this is empty.

        Example:
            >>> RefusedLinks().told("... WARN acc-0 zenoh_link_tls::unicast: peer sent no certificates. Hint: a limit.")
            'a link was refused: peer sent no certificates'
        """
        found = _REFUSED.search(_COLOUR.sub("", line))
        if found is None:
            return None
        reason = re.sub(r"\d+", "", found[1])  # the time, in some of them
        self._times[reason] += 1
        times = self._times[reason]
        if not re.fullmatch("10*", str(times)):
            return ""
        return f"a link was refused: {found[1]}" + (f" ({times} times)" if times > 1 else "")
