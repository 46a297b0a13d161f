"""Values of variables over time as lines of text: a name, a sparkline, the range, the current value and its unit.

Owns how many values are kept: as many as fit into the widest line.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from ...api.samples import Sample
from ...pictures.tables import shortened

__all__ = ["BLOCKS", "KEPT", "PLAIN", "Histories", "sparkline", "sparkline_signs"]

BLOCKS: Final = "▁▂▃▄▅▆▇█"
PLAIN: Final = "_.-:=+*#"
"""For a terminal without these blocks; like them from the least to the greatest."""
KEPT: Final = 120
"""Number of values of a line; a wider terminal does not show more."""
_FEWEST: Final = 8
_WITHOUT_TERMINAL: Final = 40
_LONGEST_NAME: Final = 28
_LONGEST_VALUE: Final = 24
_GAP: Final = "  "


class Histories:
    """The last values of each variable that was seen."""

    def __init__(self) -> None:
        self._values: dict[str, deque[float]] = {}
        self._newest: dict[str, Sample] = {}

    def add(self, samples: Iterable[Sample]) -> None:
        """Add the current values of variables; one of which there is none now has a blank."""
        missing = dict.fromkeys(self._values)
        for sample in samples:
            missing.pop(sample.name, None)
            value = sample.value
            is_number = isinstance(value, bool | int | float)
            self._newest[sample.name] = sample
            self._values.setdefault(sample.name, deque(maxlen=KEPT)).append(float(value) if is_number else math.nan)
        for name in missing:
            self._values[name].append(math.nan)

    @property
    def newest(self) -> list[Sample]:
        """The last sample of each variable, in the order in which they were first seen."""
        return list(self._newest.values())

    def lines(self, width: int | None = None, signs: str = BLOCKS) -> list[str]:
        """A line for each variable, in at most ``width`` columns; without a width, of at most 40 values."""
        rows = []
        for name, sample in self._newest.items():
            finite = [value for value in self._values[name] if math.isfinite(value)]
            range_ = f"{min(finite):.4g}..{max(finite):.4g}" if finite else ""
            rows.append((name, range_, f"{_text(sample.value)} {sample.unit or ''}".rstrip()))
        if not rows:
            return []
        names, ranges, values = (max(len(row[column]) for row in rows) for column in range(3))
        names, values = min(names, _LONGEST_NAME), min(values, _LONGEST_VALUE)
        room = _WITHOUT_TERMINAL if width is None else width - names - ranges - values - 3 * len(_GAP)
        room = min(max(room, _FEWEST), KEPT)
        lines = [
            _GAP.join(
                (
                    shortened(name, names).ljust(names),
                    sparkline(list(self._values[name])[-room:], signs).ljust(room),
                    range_.ljust(ranges),
                    shortened(value, values),
                )
            ).rstrip()
            for name, range_, value in rows
        ]
        return [line if width is None else shortened(line, width) for line in lines]


def sparkline(values: Sequence[float], signs: str = BLOCKS) -> str:
    """A sign for each value, between the least and the greatest one; blank where a value is not finite.

    Example:
        >>> sparkline([0.0, 1.0, 2.0, 3.0, 2.0])
        '▁▃▆█▆'
    """
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return " " * len(values)
    least, greatest = min(finite) / 2, max(finite) / 2  # halves, because the difference may be infinite
    signs_above = (len(signs) - 1) if greatest > least else 0
    lowest, reach = (0, greatest - least) if greatest > least else (len(signs) // 2 - 1, 1.0)
    return "".join(
        signs[lowest + round((value / 2 - least) / reach * signs_above)] if math.isfinite(value) else " "
        for value in values
    )


def sparkline_signs(encoding: str | None) -> str:
    """The signs that can be written in an encoding."""
    try:
        BLOCKS.encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return PLAIN
    return BLOCKS


def _text(value: Any) -> str:  # noqa: ANN401  the value of any variable
    if isinstance(value, np.ndarray):
        return " ".join(str(value).split())
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)
