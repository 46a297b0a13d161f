"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""

import platform
import sys
from types import ModuleType

if sys.platform == "linux" and platform.machine() == "aarch64":
    # FMPy lacks the library of its logger there, and each import would print so. With this, messages stay as they are.
    _logging = ModuleType("fmpy.logging")
    vars(_logging)["addLoggerProxy"] = lambda callbacks: None  # noqa: ARG005 as FMPy calls it
    sys.modules.setdefault("fmpy.logging", _logging)
