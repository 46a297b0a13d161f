"""Steps that an FMU of FMI 1.0 or 2.0 does not simply take (FMI 1.0 CS, 3.4; FMI 2.0, 4.2.3).

A step that returns `fmiPending` goes on by itself: we ask until it is done. A step that returns `fmiDiscard` is taken
in smaller ones, where the FMU can repeat it.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from typing import Any, Final

from ....simtime import step_within
from ..calls import declared
from ..fmu_values import DISCARD, WARNING

__all__ = [
    "PENDING",
    "RETRY",
    "SMALLER_STEPS",
    "SMALLEST",
    "StepStatus",
    "discarded",
    "take_sub_steps",
]

PENDING: Final = 5
SMALLEST: Final = 1024
"""The smallest sub-step is this part of the communication step; if it is discarded, the step fails."""
SMALLER_STEPS: Final = "Smaller steps (`step_size`) may help."
RETRY: Final = "Smaller steps (`step_size`), or `retry_discarded_steps: true` in a configuration, may help."

_DO_STEP_STATUS, _LAST_SUCCESSFUL_TIME = 0, 2
_ASK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
_PAUSES_S: Final = (0.0, 1e-3)
"""The first and the longest pause between two questions whether a step is done."""


class StepStatus:
    """Asks one instance about its last step.

    ``component`` returns its address, and ``failed`` makes its error.
    """

    def __init__(self, dll: Any, component: Callable[[], int], symbols: str, failed: Callable[..., Exception]) -> None:  # noqa: ANN401 of ctypes
        self._component = component
        self._prefix = symbols.rpartition("_")[2]
        self._failed = failed
        self._get_status = declared(dll, f"{symbols}GetStatus", _ASK)
        self._get_real_status = declared(dll, f"{symbols}GetRealStatus", _ASK)

    def settled(self, status: int) -> int:
        """The status of a step that has returned ``status``; wait until a pending step is done.

        The FMU gets no function to call when it is done, so we have to ask (FMI 2.0, 2.1.5). `CallWatch` watches the
        deadline of the step.
        """
        pause, longest = _PAUSES_S
        while status == PENDING:
            answer = ctypes.c_int(PENDING)
            if self._get_status(self._component(), _DO_STEP_STATUS, ctypes.addressof(answer)) > WARNING:
                what = f"{self._prefix}DoStep returned pending, and {self._prefix}GetStatus does not tell when the step"
                raise self._failed(f"{what} is done")
            if (status := answer.value) != PENDING:
                break
            time.sleep(pause)  # noqa: TID251 there is nothing to wait on
            pause = min(longest, pause + longest / 64)
        return status

    def last_successful_time(self) -> float | None:
        """The time up to which a discarded step was calculated, in s of the FMU; None if the FMU does not tell."""
        answer = ctypes.c_double()
        status = self._get_real_status(self._component(), _LAST_SUCCESSFUL_TIME, ctypes.addressof(answer))
        return answer.value if status <= WARNING else None


def take_sub_steps(attempt: Callable[[float, float], int], time: float, step_size: float) -> int:
    """Take a step from ``time`` by ``step_size`` (s) in halves, quarters and so on, as small as necessary.

    ``attempt`` takes a step of some size from a time (both in s), and returns its status. After `DISCARD`, the FMU is
    back at the start of this step.

    Returns `DISCARD` if even the smallest sub-step was discarded; a higher status that ended the step; or the status of
    the last sub-step.
    """
    done, size, status = 0, SMALLEST // 2, DISCARD
    while done < SMALLEST:
        # Binary fractions of the step have exact sums; the time is rounded, but never past the end of the step.
        start = time + step_size * (done / SMALLEST)
        status = attempt(start, step_within(start, step_size * (size / SMALLEST), time + step_size))
        if status == DISCARD and size > 1:
            size //= 2
        elif status >= DISCARD:
            return status
        else:
            done += size
    return status


def discarded(function: str, last_time: float | None, smallest: int | None) -> str:
    """The text of an error for a step that was discarded.

    ``last_time`` is the last successful time in s, if the FMU tells; the last attempt was a sub-step of 1/``smallest``
    of the step, or the whole step if that is None.
    """
    tried = f" down to 1/{smallest} of the step" if smallest is not None else ""
    told = f"; the last successful time is {last_time:.12g} s" if last_time is not None else ""
    return f"{function} returned discard{tried}{told}"
