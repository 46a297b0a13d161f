"""The contract of a kind of instance, and of an instance: how a model is described, opened and stepped.

A kind is found by its key through the entry points `fmu_mesh.instances` (`fmu_mesh.instances.registry`); FMUs and the
physics engines are found in the same way as the kinds of other packages. `docs/extending.md` shows how to write one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Literal, Protocol, TypeVar, runtime_checkable

import msgspec

from ..config.instance_sections import InstanceSection
from ..config.mesh import LimitsConfig, TimeoutsConfig
from ..files import below
from ..simtime import TimeGrid
from ..system.linear_inputs import LinearInput
from ..system.process_sharing import Claims
from ..system.solved_groups import SolvedGroup
from ..variables.model_description import ModelDescription, Value
from .kept_models import KeptModels

if TYPE_CHECKING:
    from ..rings.native import CopyCall, NativeStep, Span
    from ..rings.ring import Ring

__all__ = [
    "BeginsAgain",
    "ChangesProcess",
    "Instance",
    "KeepsFiles",
    "KeepsState",
    "KeepsStateAsBytes",
    "Kind",
    "LogMessage",
    "Opening",
    "Prepares",
    "Showing",
    "StepsNatively",
]

Section = TypeVar("Section", bound=InstanceSection)


class LogMessage(msgspec.Struct, frozen=True):
    """One message of a model or its engine (for an FMU: FMI 2.0, 2.1.5; FMI 3.0, 2.3.1).

    Attributes:
        instance: instance name.
        status: `OK`, `Warning`, `Error`, ... in the words of FMI.
        step: the own step of the instance in which the message came; -1 before the first step.
        noted: what we say with it, once, and note in results, whatever the category: that the model is stiff, or that
            the instance has failed and its outputs are held, or have substitutes.
    """

    instance: str
    status: str
    category: str
    message: str
    step: int
    noted: Literal["", "stiff", "held", "disabled"] = ""


class Showing(msgspec.Struct, frozen=True):
    """Whether and how the world of a physics engine is shown.

    Attributes:
        view: in a window.
        video: the file of a film, or None.
    """

    view: bool = False
    video: Path | None = None

    def __bool__(self) -> bool:
        return self.view or self.video is not None


class Opening(msgspec.Struct, Generic[Section], frozen=True):
    """What a kind gets to open an instance.

    Attributes:
        name: instance name.
        path: absolute path of the model; `Path()` for a kind without files.
        section: its section of the configuration, without the common keys.
        description: what `Kind.describe` returned for the model, with arrays in the sizes of this instance.
        content: what `Kind.content` returned when the run was planned; None if that is not known.
        folder: an existing private folder for files. What the instance leaves there is removed after the run.
        limits: how large an FMU may be.
        timeouts: how long its calls may take.
        linear_inputs: the inputs that change linearly within a step; only where the description allows it.
        midpoint_inputs: those that get the middle of the line of their source; not a matter of the kind.
        group: the solved group that it is a member of, which then leads its ``linear_inputs``; None: there is none.
        log: call it with every message of the model, on the thread that calls the instance.
        showing: only given to a kind with `can_be_shown`.
        kept: where an instance may leave what the next one of its name can use again, in a process that runs a mesh
            again and again; None: nothing is used again.
    """

    name: str
    path: Path
    section: Section
    description: ModelDescription
    folder: Path
    content: str | None = None
    limits: LimitsConfig = LimitsConfig()
    timeouts: TimeoutsConfig = TimeoutsConfig()
    linear_inputs: tuple[LinearInput, ...] = ()
    midpoint_inputs: tuple[LinearInput, ...] = ()
    group: SolvedGroup | None = None
    log: Callable[[LogMessage], None] = lambda _message: None
    showing: Showing = Showing()
    kept: KeptModels | None = None


class Kind(ABC, Generic[Section]):
    """A kind of instances: what its section of a configuration may say, and how its models are described and opened.

    An entry point of the group `fmu_mesh.instances` names an object of such a class; its name is the key of the kind.

    Call sequence, in the process that plans a run: `check_showing` if somebody wants to see the world, then `describe`
    for each model and `content` for each file; `check_engine` and `check_model` only for `fmu-mesh check`. Then `open`
    in the process that runs the instance, which may be on another host. Every process that reads a configuration with
    this key imports the module of the kind, so import slow libraries within the methods.

    Attributes:
        section: the Struct of the section; its tag is the key of the kind.
        expected: in words, what the file of a model is: "a CSV file with a column `time`".
        can_be_shown: whether `--view` and `--video` can show its instances.
    """

    section: type[Section]
    expected: str = "a file of this kind"
    can_be_shown: bool = False

    @abstractmethod
    def describe(
        self, path: Path, section: Section, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """The model description of the model at ``path``.

        Two calls with the same file and section return the same description, on every host.

        Args:
            path: absolute path of the model; `Path()` for a kind without files.
            section: the section of an instance, without the common keys.
            limits: how large an FMU may be.
            tell: call it with one sentence before anything that takes several seconds.

        Raises:
            LoadFailed: the model cannot be read; says why. It becomes a finding about the configuration.
        """

    @abstractmethod
    def content(self, path: Path) -> str:
        """A SHA-256 of all files that the model consists of; an empty text for a kind without files.

        It does not depend on where the files are. Processes on several hosts compare it.

        Raises:
            OSError, LoadFailed: a file cannot be read.
        """

    def files(self, path: Path) -> Sequence[Path]:
        """The files that the model consists of, which another host gets: by default that at ``path``, or all below it.

        Raises:
            OSError, LoadFailed: a file cannot be read.
        """
        return (path,) if not path.is_dir() else below(path)

    def needs_compiler(self, path: Path, section: Section, limits: LimitsConfig) -> bool:
        """Whether `describe` would compile what the model contains; no by default, and nothing is compiled here.

        Raises:
            LoadFailed: the model cannot be read.
        """
        return False

    def claims(self, path: Path, section: Section, description: ModelDescription, limits: LimitsConfig) -> Claims:
        """What such an instance uses of which a process has only one; nothing by default.

        Called only where instances are to share a process: what is slow is done here.

        Raises:
            LoadFailed: the model cannot be read.
        """
        return {}

    def check_engine(self) -> None:
        """Check that this host can run such instances; nothing is checked by default.

        Raises:
            LoadFailed: it cannot; says why, with a hint what to install.
        """

    def host_checks(self) -> Mapping[str, Callable[[], str]]:
        """What `doctor` looks for, by name: each returns what is here, or raises as `check_engine`; starts nothing."""
        return {}

    def check_model(self, path: Path, description: ModelDescription, limits: LimitsConfig) -> None:
        """Check that this host has what one model needs; nothing is checked by default.

        Args:
            path: absolute path of the model.
            description: what `describe` returned.
            limits: how large an FMU may be.

        Raises:
            LoadFailed: it has not; says what is missing.
        """

    def check_showing(self, showing: Showing) -> None:
        """Check that this host can show what ``showing`` asks for; called only with `can_be_shown`.

        Raises:
            ConfigurationError: it cannot; says why.
        """

    def preload(self) -> None:
        """Import what `open` needs, so that the processes of a run share it; nothing is imported by default.

        Called in a process with one thread, which forks them: an import must start no thread.
        """

    def prepare(self, opening: Opening[Section]) -> None:
        """Do once what every `open` of a model needs, such as unpacking it; nothing is prepared by default.

        Called in the process of `preload`. It must load no library of the model.

        Raises:
            LoadFailed: it cannot be done; `open` says so again.
        """

    @abstractmethod
    def open(self, opening: Opening[Section]) -> Instance:
        """Open an instance; the caller closes it.

        Raises:
            LoadFailed: it cannot be opened; says why.
        """


class Instance(Protocol):
    """One instance of a model. Call it from one thread only.

    Call sequence: `enter_initialization`, then `set_values` and `get_values` as often as needed, then
    `exit_initialization`; then `bind`, and `do_step` at consecutive points of its own, with `set_values` and
    `get_values` between steps; at the end, and after any exception, `close`.

    Raises:
        FmuError: by every method but `close`; after it only `close` is allowed.
    """

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        ...

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end; FMI 2.0, 4.2.1)."""
        ...

    def exit_initialization(self) -> None:
        """Leave Initialization Mode. Outputs are valid from now on."""
        ...

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name, between two calls of `do_step` or in Initialization Mode."""
        ...

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name, between two calls of `do_step` or in Initialization Mode."""
        ...

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings that `do_step` works on, and write the current outputs to row ``step`` of the output rings.

        May be called again between two steps, with other rings.

        Args:
            inputs: `do_step` reads from it the connected inputs, which are the columns of its layout.
            outputs: one or two rings; `do_step` writes to them the outputs of their layouts. Each has a ``mask`` of its
                own.
            grid: the communication points of the run.
            points: how many points of ``grid`` one own step takes; own step ``n`` starts at point ``n * points``.
            step: the number of the next own step.
        """
        ...

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``.

        Raises:
            TerminationRequested: the FMU asks to end the simulation. The step does not count; no other may follow.
        """
        ...

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises. May be called twice."""
        ...


@runtime_checkable
class KeepsFiles(Protocol):
    """An instance with files on the disk that must go even if it hangs in a call and can never be closed."""

    def remove_files(self) -> None:
        """Remove the files. Called from another thread, just before the process is ended."""
        ...


@runtime_checkable
class StepsNatively(Protocol):
    """An instance whose steps a node may take without Python (`fmu_mesh.rings.native`), instead of `do_step`."""

    @property
    def native(self) -> NativeStep | None:
        """The tables of a step on the rings of the last `bind`; None if `do_step` takes the steps."""
        ...

    @property
    def stage(self) -> int:
        """What `do_step` is doing, a `fmu_mesh.rings.native.Stage`; from any thread. A node asks its own tables."""
        ...

    def check_rows(self, spans: Sequence[Span]) -> bool:
        """From now on `do_step` raises `NotFinite` if one of these floats of its row is not finite; whether it does."""
        ...

    def finish(self, step: int, outcome: int) -> None:
        """Complete own step ``step`` as `do_step` does, after the library has returned ``outcome``, which is not 0.

        Raises:
            FmuError: the step has failed.
            TerminationRequested: see `Instance.do_step`.
        """
        ...


@runtime_checkable
class Prepares(Protocol):
    """An instance that looks up once what it needs to set or get a variable many times, between calls of `do_step`."""

    def setter(self, name: str) -> Callable[[Value], None] | None:
        """What `set_values` does with a variable; None where that is quicker, or other values belong to it."""
        ...

    def getter(self, name: str) -> Callable[[], Value] | None:
        """What `get_values` does with a variable; None where that is as quick."""
        ...


@runtime_checkable
class BeginsAgain(Protocol):
    """An instance whose run can end without `close`, and which then begins another run of the same sizes.

    Call sequence: `end_run` after the last step; if it returns True, `begin_again`, and all calls of `Instance` from
    `enter_initialization` on, `bind` included. Otherwise, and at any time, `close`.
    """

    def end_run(self) -> bool:
        """End the simulation as `close` does, but keep what does not depend on the run; whether that was possible."""
        ...

    def begin_again(self) -> None:
        """Be as a new instance before Initialization Mode.

        Raises:
            LoadFailed: the model makes no other instance.
        """
        ...


@runtime_checkable
class AccessedNatively(Protocol):
    """An instance whose values and states the library may get and set for many copies at once."""

    def access(self, verb: Literal["Get", "Set"], names: Sequence[str]) -> CopyCall | None:
        """The call for these variables of one type, their elements one after another in the dtype of that type.

        None if only `get_values` and `set_values` can.
        """
        ...

    def state_access(self, state: object) -> CopyCall | None:
        """The call of `KeepsState.set_state`; None if there is more to do than to call it and to restore `Said`."""
        ...


@runtime_checkable
class ChangesProcess(Protocol):
    """An instance that knows whether its steps may change the state of their process (`ProcessState`)."""

    @property
    def changes_process(self) -> bool:
        """Whether a step may change it."""
        ...


class KeepsState(Protocol):
    """An instance whose state can be saved and restored, also in another process (FMI 2.0, 2.1.8; FMI 3.0, 2.2.10).

    The model description says so with `can_get_and_set_state`, and with `can_serialize_state` for the last two methods.
    Call them between two calls of `do_step`.

    Raises:
        FmuError: the FMU cannot, or failed to.
    """

    def get_state(self) -> object:
        """Save the complete current state. Give it to `free_state` when it is not needed any more."""
        ...

    def set_state(self, state: object) -> None:
        """Restore a state of `get_state`. The next `do_step` continues from there."""
        ...

    def free_state(self, state: object) -> None:
        """Free the memory of a state."""
        ...

    def serialize_state(self, state: object) -> bytes:
        """The state as bytes, which another process can use."""
        ...

    def deserialize_state(self, data: bytes) -> object:
        """The state from the bytes that an instance of the same model has made."""
        ...


class KeepsStateAsBytes:
    """The rest of `KeepsState` where `get_state` returns bytes, which any instance of the model can restore."""

    def free_state(self, state: object) -> None:
        """Nothing to free."""

    def serialize_state(self, state: object) -> bytes:
        """The state, which is bytes already."""
        assert isinstance(state, bytes)
        return state

    def deserialize_state(self, data: bytes) -> object:
        """The state, which is these bytes; `set_state` checks them."""
        return data
