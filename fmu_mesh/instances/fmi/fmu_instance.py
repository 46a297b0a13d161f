"""The life cycle of an FMU instance, the same for all FMI versions: files, states, messages and errors.

A version of FMI and a kind of FMU add the calls: how an instance is made, initialized, stepped and freed.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

from fmpy.fmi1 import FMICallException

from ...errors import FmuError, InitializationFailed, LoadFailed, StepFailed
from ...rings.native import Said
from ...variables.model_description import ModelDescription
from ...variables.value_conversion import to_value
from ...variables.value_types import Value
from ..contract import LogMessage
from ..kept_models import KeptModels
from .archive.archive import Terms
from .archive.system_libraries import missing_libraries
from .callbacks import recall, register, tell_counted, unregister
from .calls import pointer
from .fmu_values import FATAL, OK, FmuValues, status_name
from .loaded_fmu import FmuFunctions, FmuToLoad, LoadedFmu
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
        kept: has what earlier instances of this name have left, and gets what this one leaves.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """

    _functions: FmuFunctions
    """Those of this version of FMI and this kind of FMU."""

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
        kept: KeptModels | None = None,
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
        self._kept = kept
        fmu = FmuToLoad(path, name, description, terms, self._functions, options.deep_binding)
        self._model = LoadedFmu(fmu, folder) if kept is None else LoadedFmu.kept(fmu, kept)
        try:
            self._model.load()
            self._fmu = self._model.calls
            self._check_functions()
            self._instantiate()
            self._component = self._fmu.component
            self._self = pointer(self._component)
            self._instantiated()
            self._live = True
        except Exception as error:
            self._state = "failed"
            library = description.library if self._model.calls is None else None
            self.close()
            missing = missing_libraries(path, library, terms) if library else ()
            text = "; ".join(missing) or str(error)
            raise LoadFailed(f"'{path}' cannot be instantiated: {text}{self._message()}", instance=name) from error

    @property
    def description(self) -> ModelDescription:
        """The model description; arrays have the shapes that the structural parameters give them."""
        return self._description

    @property
    def changes_process(self) -> bool:
        """See `ChangesProcess`."""
        return self._model.changes_process

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
        was_reset = False
        if self._live and self._state == "stepping":
            was_reset = self._end_run(resets=self._kept is not None and (self._kept.resets or self._only_once))
        elif self._live:
            self._quietly(self._release)
        self._leave_model(was_reset=was_reset)
        unregister(self)
        self._live = False
        self._state = "closed"
        self._keep = []

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        self._model.remove_files()

    def logged(self, status: int, category: bytes, message: bytes, counted: int) -> None:
        """See `Logged`; the last messages become part of an error that follows."""
        if status > OK:
            self.recalled(message)
        text, kind = message.decode(errors="replace").strip(), category.decode(errors="replace")
        if counted:
            more = f"{counted:,} more messages" if counted > 1 else "1 more message"
            text = f"{more} like '{text}' ({kind}) {'were' if counted > 1 else 'was'} not shown"
        self._log(LogMessage(self.name, status_name(status), kind, text, self._said.step))

    def recalled(self, message: bytes) -> None:
        """See `Logged`."""
        self._last_messages = [*self._last_messages[-2:], message.decode(errors="replace").strip()]

    # --- what a version of FMI adds

    @abstractmethod
    def _make_instance(self) -> None:
        """Make the instance; any exception says why it cannot be made."""

    def _instantiate(self) -> None:
        """Make the instance, unless there is one that was reset."""
        register(self.name, self, id(self._model))
        self._model.instantiate(self._make_instance)

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

    def _release(self) -> None:
        """Free what this object has allocated in the FMU."""

    # --- shared by the versions

    def _end_run(self, *, resets: bool) -> bool:
        """End the simulation; with ``resets`` also reset the instance, and return whether that was done."""
        self._quietly(self._terminate)
        self._quietly(self._release)
        return resets and not self._model.is_lost and self._model.reset()

    def _quietly(self, call: Callable[[], object]) -> None:
        """Call a function at the end, where a failure has no consequence, but that of fatal."""
        try:
            if not self._model.is_lost:
                call()
        except FMICallException as error:
            self._note(error.status)
        except OSError:
            return

    def _leave_model(self, *, was_reset: bool) -> None:
        """Leave the FMU to the next instance of this name; after a failure nothing of it is used again.

        A library that allows one instance is unloaded with it.
        """
        model = self._model
        if (
            self._kept is None
            or not self._live
            or self._state == "failed"
            or model.is_lost
            or (self._only_once and not was_reset)
        ):
            model.close()
            return
        if not was_reset:
            model.free()
        self._kept.keep(self.name, model)

    @property
    def _only_once(self) -> bool:
        return self._description.only_once_per_process

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

    def _check_functions(self) -> None:
        """Refuse a library without a function that every run needs; others may be missing until they are called."""
        names = {*self._functions.needed}
        names |= {self._function_name("Get", variable.type) for variable in self._description.with_causality("output")}
        names |= {self._function_name("Set", variable.type) for variable in self._description.with_causality("input")}
        missing = self._fmu.dll.missing  # in FMI 1.0 with the model identifier before the name
        if lacking := sorted(name for name in names if any(one.endswith(name) for one in missing)):
            raise RuntimeError(f"its library has no function {', '.join(lacking)}, which every run needs")

    def _check_live(self) -> None:
        if self._model.is_lost:
            raise FmuError("the FMU has returned fatal: no function of it may be called any more", instance=self.name)
        if not self._live:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)

    def _initializing(self, function: str, call: Callable[[], object]) -> None:
        try:
            call()
        except FMICallException as error:
            raise self._failed(function, status=error.status) from error

    def _note(self, status: int) -> None:
        """After fatal, no function of the instance is called, not even to free it (FMI 2.0, 2.1.3; 3.0, 2.2.3)."""
        if status == FATAL:
            self._model.lose()

    def _failed(
        self, what: str, variable: str | None = None, hint: str | None = None, status: int | None = None
    ) -> StepFailed | InitializationFailed:
        if status is not None:
            what = f"{what} returned {status_name(status)}"
            self._note(status)
        kind = StepFailed if self._state == "stepping" else InitializationFailed
        self._state = "failed"
        error = kind(f"{what}{self._message()}", instance=self.name, variable=variable, hint=hint)
        tell_counted(self)  # a node closes its instances after it has told its failure
        return error

    def _message(self) -> str:
        recall()
        messages, self._last_messages = self._last_messages, []
        return f"; the FMU says: {' | '.join(messages)}." if messages else "; the FMU gave no message."
