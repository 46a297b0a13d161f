"""What all workers of this host import before they run anything: they start fast, and share its memory.

The fork server of `multiprocessing` imports it, and a worker of Dask, where the signal of Ctrl-C is ignored (ADR 59).
"""

import importlib
import signal
from contextlib import suppress
from pathlib import Path

from ..config.loading import PlainConfig
from ..errors import ConfigurationError
from ..instances.configuration import examine_data
from ..instances.registry import preload
from . import variant_run  # noqa: F401  its imports are what this is for

__all__ = ["dask_setup"]

preload()
for _name in ("elftools.elf.elffile", "threadpoolctl"):  # what the first run of a worker would import
    importlib.import_module(_name)
with suppress(ConfigurationError):
    examine_data(PlainConfig({"mesh": "m"}, Path("m.yaml")))  # so that the types of a configuration are known


def dask_setup(_worker: object) -> None:
    """In a worker of Dask on this host: Ctrl-C is for the process that uses it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
