"""What an FMU of FMI 1.0 or 2.0 tells about a step that it did not simply take (FMI 1.0 CS, 3.4; FMI 2.0, 4.2.3).

Owns the questions about a step that was discarded, or that goes on by itself after `fmiPending`; what follows from the
answers is the business of the version.
"""

from __future__ import annotations

import ctypes
import time
from typing import Any, Final

__all__ = ["PENDING", "RETRY", "SMALLER_STEPS", "StepStatus", "discarded"]

PENDING: Final = 5
SMALLER_STEPS: Final = "Smaller steps (`step_size`) may help."
RETRY: Final = "Smaller steps (`step_size`), or `retry_discarded_steps: true` in a configuration, may help."

_WARNING: Final = 1
_DO_STEP_STATUS, _LAST_SUCCESSFUL_TIME = 0, 2
_ASK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
_PAUSES_S: Final = (0.0, 1e-3)
"""The first and the longest pause between two questions whether a step is done."""


class StepStatus:
    """Asks one instance.

    Args:
        dll: its library.
        component: the instance.
        prefix: what its functions begin with, such as `fmi2`.
    """

    def __init__(self, dll: Any, component: int, prefix: str) -> None:  # noqa: ANN401 of ctypes
        self._component = component
        self._get_status = _ASK((f"{prefix}GetStatus", dll))
        self._get_real_status = _ASK((f"{prefix}GetRealStatus", dll))

    def wait(self) -> int | None:
        """Wait until a pending step is done, and return its status; None if the FMU does not tell.

        The FMU gets no function to call when it is done, so it has to be asked (FMI 2.0, 2.1.5). The deadline of the
        step is seen to by whoever watches the calls of the instance.
        """
        pause, longest = _PAUSES_S
        while True:
            answer = ctypes.c_int(PENDING)
            if self._get_status(self._component, _DO_STEP_STATUS, ctypes.addressof(answer)) > _WARNING:
                return None
            if answer.value != PENDING:
                return answer.value
            time.sleep(pause)  # noqa: TID251 there is nothing to wait on
            pause = min(longest, pause + longest / 64)

    def last_successful_time(self) -> float | None:
        """Up to where a discarded step was calculated, in s of the FMU's time; None if the FMU does not tell."""
        answer = ctypes.c_double()
        status = self._get_real_status(self._component, _LAST_SUCCESSFUL_TIME, ctypes.addressof(answer))
        return answer.value if status <= _WARNING else None


def discarded(function: str, last_time: float | None, smallest: int | None) -> str:
    """In words that a step was discarded.

    Args:
        function: the name of the function.
        last_time: up to where the FMU got, in s.
        smallest: the part of the step that was tried last, as 1/smallest; None if it was tried once.
    """
    tried = f" down to 1/{smallest} of the step" if smallest is not None else ""
    told = f"; the last successful time is {last_time:.12g} s" if last_time is not None else ""
    return f"{function} returned discard{tried}{told}"
