"""The life cycle of an FMU instance, the same for all FMI versions: files, states, messages and errors.

A version of FMI and a kind of FMU add the calls: how an instance is made, initialized, stepped and freed.
"""

from __future__ import annotations

import math
import shutil
from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from fmpy.fmi1 import FMICallException

from ...errors import InitializationFailed, LoadFailed, StepFailed
from ...rings.native import Said
from ...variables.model_description import ModelDescription
from ...variables.value_conversion import to_value
from ...variables.value_types import Value
from ..call_guard import FOLDER
from ..contract import LogMessage
from .archive.archive import Terms
from .archive.sources import extract
from .calls import FmpyCalls, pointer
from .fmu_values import OK, FmuValues, status_name
from .state import Bookkeeping, KeepsFmuState
from .step_options import StepOptions

__all__ = ["FmuInstance", "LogSink"]


LogSink = Callable[[LogMessage], None]


class FmuInstance(KeepsFmuState, FmuValues):
    """One instance of an FMU; see `fmu_mesh.instances.contract.Instance` for the call sequence.

    Args:
        path: the .fmu file.
        name: instance name.
        description: what `read_description` returned for it.
        folder: an existing private folder; the FMU is extracted below it.
        log: called with every log message, on the thread that calls the FMU.
        terms: limits and checks for the archive.
        options: how the instance is stepped.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """

    _library: type[Any]
    """FMPy's class for this version of FMI and this kind of FMU."""

    _prefix: str
    """The prefix of FMI functions in this version, such as `fmi2`."""

    _function_names: Mapping[str, str] = {}
    """FMI functions whose name does not follow from the name of FMPy's method, by that name."""

    _component: int
    """The address of the instance, for functions called through ctypes; ``_self`` is the same for cffi."""

    def __init__(  # noqa: PLR0913, PLR0917 what an instance is made of; all of it is named where it is called
        self,
        path: Path,
        name: str,
        description: ModelDescription,
        folder: Path,
        log: LogSink = lambda _message: None,
        terms: Terms = Terms(),  # noqa: B008 a frozen Struct
        options: StepOptions = StepOptions(),  # noqa: B008 a frozen Struct
    ) -> None:
        self.name = name
        self._options = options
        self._log = log
        self._last_messages: list[str] = []
        self._said = Said(step=-1, quiet_until=math.inf)
        self._state: Literal["instantiated", "initialization", "stepping", "failed", "closed"] = "instantiated"
        self._live = False
        self._keep = []
        self._describe(description)
        self._extracted = extract(path, folder, terms, model=description)
        try:
            with FOLDER:  # FMPy loads a library from its own folder
                fmu = self._library(
                    guid=description.guid,
                    modelIdentifier=description.model_identifier,
                    unzipDirectory=str(self._extracted),
                    instanceName=name,
                )
            self._fmu: Any = FmpyCalls(fmu, self._prefix, self._function_names)
            self._instantiate()
            self._component = fmu.component
            self._self = pointer(self._component)
            self._instantiated()
            self._live = True
        except Exception as error:
            self._state = "failed"
            self.close()
            raise LoadFailed(f"'{path}' cannot be instantiated: {error}{self._message()}", instance=name) from error

    @property
    def description(self) -> ModelDescription:
        """The model description; arrays have the shapes that the structural parameters give them."""
        return self._description

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end).

        Binary values may be base64 as in a configuration.
        """
        self._check_live()
        self._describe(self._description.sized(start_values))
        values = {name: to_value(value, self._variables[name]) for name, value in start_values.items()}
        self._enter_initialization(start_time, stop_time, values)
        self._state = "initialization"

    def exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        self._check_live()
        self._exit_initialization()
        self._state = "stepping"

    @abstractmethod
    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""

    @abstractmethod
    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        if self._state == "closed":
            return
        if self._live:
            if self._state == "stepping":
                _quietly(self._terminate)
            _quietly(self._free)
        self._live = False
        self._state = "closed"
        self._keep = []
        self.remove_files()

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        shutil.rmtree(self._extracted, ignore_errors=True)

    def logged(self, status: int, category: bytes, message: bytes) -> None:
        """Take a message from the FMU's logger; the last ones become part of an error that follows."""
        text = message.decode(errors="replace").strip()
        name = status_name(status)
        if status > OK:
            self._last_messages = [*self._last_messages[-2:], text]
        self._log(LogMessage(self.name, name, category.decode(errors="replace"), text, self._said.step))

    # --- what a version of FMI adds

    @abstractmethod
    def _instantiate(self) -> None:
        """Make the instance; any exception says why it cannot be made."""

    def _instantiated(self) -> None:
        """Look up what the steps need, now that the instance exists."""

    @abstractmethod
    def _enter_initialization(self, start_time: float, stop_time: float | None, start_values: dict[str, Value]) -> None:
        """Set the start values and enter Initialization Mode."""

    @abstractmethod
    def _exit_initialization(self) -> None:
        """Leave Initialization Mode."""

    def _terminate(self) -> None:
        """End the simulation."""
        self._fmu.terminate()

    def _free(self) -> None:
        """Free the instance."""
        self._fmu.freeInstance()

    # --- shared by the versions

    def _tolerance(self) -> float | None:
        """The tolerance for the FMU (FMI 2.0, 2.1.6; FMI 3.0, 2.3.2)."""
        return self._options.tolerance or self._description.default_experiment.tolerance

    def _bookkeeping(self) -> Bookkeeping:
        return Bookkeeping(self._said.step)

    def _restore(self, kept: Bookkeeping) -> None:
        self._said.note(step=kept.step)
        self._state = "stepping"

    def _describe(self, description: ModelDescription) -> None:
        self._description = description
        self._variables = {variable.name: variable for variable in description.variables}

    def _check_live(self) -> None:
        if not self._live:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)

    def _initializing(self, function: str, call: Callable[[], object]) -> None:
        try:
            call()
        except FMICallException as error:
            raise self._not_initialized(function, error.status) from error

    def _not_initialized(self, function: str, status: int) -> InitializationFailed:
        self._state = "failed"
        return InitializationFailed(f"{function} returned {status_name(status)}{self._message()}", instance=self.name)

    def _failed(
        self, what: str, variable: str | None = None, hint: str | None = None
    ) -> StepFailed | InitializationFailed:
        kind = StepFailed if self._state == "stepping" else InitializationFailed
        self._state = "failed"
        return kind(f"{what}{self._message()}", instance=self.name, variable=variable, hint=hint)

    def _message(self) -> str:
        messages, self._last_messages = self._last_messages, []
        return f"; the FMU says: {' | '.join(messages)}." if messages else "; the FMU gave no message."


def _quietly(call: Callable[[], object]) -> None:
    """Call a function of the FMU at the end, where a failure has no consequence."""
    try:
        call()
    except (FMICallException, OSError):
        return
