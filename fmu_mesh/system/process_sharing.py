"""What may share a process: the one rule that groups, `group: auto`, `--local`, `open`, `repeated` and sweeps use.

A process has one library of each name, one variable for each symbol that C++ declares unique, and one interpreter of
Python. An instance *claims* what it uses of that kind. Two instances with one claim share a process only if both mean
the same content by it. The kinds say what an instance claims; this module decides, and knows no kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

__all__ = ["BOTH_USE_PYTHON", "Claims", "ClaimsOf", "SharedProcess"]

Claims = Mapping[str, str]
"""By the reason why two instances cannot share a process, in words: the content with which they can.

An empty content is equal to no other one, not even to that of the same model.
"""
ClaimsOf = Callable[[str], Claims]
"""What an instance claims, by its name. The files of its model are read for it, so nobody asks without need."""

BOTH_USE_PYTHON = "both use the interpreter of Python, of which a process has one"
"""A claim of FMUs that embed Python, and of components: an FMU changes where Python looks for modules."""


class SharedProcess:
    """The instances that one process runs, at a time or one after another.

    Example:
        >>> process = SharedProcess()
        >>> [process.refusal(name, lambda: {"both load libgain.so": name[0]}) for name in ("a1", "a2", "b")]
        [None, None, "'a1' and 'b' cannot run in one process: both load libgain.so"]
    """

    def __init__(self) -> None:
        self._first: tuple[str, Callable[[], Claims]] | None = None
        self._taken: dict[str, tuple[str, str]] | None = None

    def refusal(self, name: str, claims: Callable[[], Claims]) -> str | None:
        """Why an instance cannot join; None: it has joined. The claims of the first one are read for the second."""
        if self._first is None:
            self._first = name, claims
            return None
        if self._taken is None:
            first, of_first = self._first
            self._taken = {why: (content, first) for why, content in of_first().items()}
        own = claims()
        for why, content in own.items():
            if why in self._taken and (not content or self._taken[why][0] != content):
                return f"'{self._taken[why][1]}' and '{name}' cannot run in one process: {why}"
        self._taken = {why: (content, name) for why, content in own.items()} | self._taken
        return None
