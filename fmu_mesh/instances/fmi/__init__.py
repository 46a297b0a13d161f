"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

import platform
import sys
from types import ModuleType
from typing import Any


class _NoProxy(ModuleType):
    """Instead of `fmpy.logging`: FMPy has no library of it for ARM, and each import would print so."""

    @staticmethod
    def addLoggerProxy(callbacks: Any) -> None:  # noqa: ANN401, N802 as FMPy has it
        """Texts of messages stay as the FMU gives them."""


if sys.platform == "linux" and platform.machine() == "aarch64":
    sys.modules.setdefault("fmpy.logging", _NoProxy("fmpy.logging"))
