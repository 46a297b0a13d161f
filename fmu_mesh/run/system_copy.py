"""One of many copies of a system in this process: its memory, its instances and what steps them.

Used by `fmu_mesh.run.copies`, which steps all copies with one call and knows how each has ended.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, cast

from numpy.typing import NDArray

from ..errors import CallRefused, FmuError, FmuMeshError, TerminationRequested
from ..instances.contract import AccessedNatively, KeepsState, StepsNatively
from ..instances.instance_wrapper import AroundNativeSteps
from ..node.engine import Engine
from ..node.inputs import TimedInputs, set_input
from ..node.stepping import Runner
from ..rings import native
from ..variables.value_types import PlainValue, Value
from .hosted_system import HostedSystem

__all__ = ["Overrides", "SavedCopy", "SystemCopy", "Verb"]

Verb = Literal["Get", "Set"]
Overrides = Mapping[str, Mapping[str, PlainValue]]


class SavedCopy(NamedTuple):
    """The state of one copy at a point; the states of its instances by name, and its texts by the name "".

    ``instances`` stands for the instances that the states belong to, ``set_at`` for their own steps at which something
    was set last.
    """

    point: int
    states: Mapping[str, object]
    kept: bytes
    instances: object
    set_at: Mapping[str, int] = MappingProxyType({})


class SystemCopy:
    """One copy: its memory, its instances and what steps them."""

    def __init__(self, made: Callable[[], HostedSystem]) -> None:
        self._made = made
        self._system, self._instances = made(), object()
        self.engine: Engine

    @property
    def runners(self) -> dict[str, Runner]:
        """The instances, by name."""
        return self._system.runners

    @property
    def current(self) -> Runner | None:
        """From any thread: the instance whose step is under way, or has failed."""
        return self.engine.current if hasattr(self, "engine") else None

    def begin(self, overrides: Overrides, *, is_new: bool) -> None:
        """Initialize all instances; then they are at point 0. Those that cannot begin again are opened anew.

        Args:
            overrides: start values by instance and variable, in the place of those of the plan.
            is_new: whether nothing of what is there can be used again.

        Raises:
            FmuError: an instance cannot be opened or initialized.
        """
        if is_new or (self._system.runners and not self._system.end()):
            self._system.close()
            self._system = self._made()
        if is_new:  # all others are reset, and used again
            self._instances = object()
        try:
            self._system.open()
            self.engine = self._system.begin(overrides)
        except BaseException:
            self._system.close()
            self._system, self._instances = self._made(), object()
            raise

    def located(self, event: FmuError | TerminationRequested, point: int) -> None:
        """See `HostedSystem`."""
        self._system.located(event, point)

    def take_care(self) -> None:
        """Steps have changed the state of the process."""
        for runner in self.runners.values():
            runner.take_care()

    def set(self, instance: str, name: str, value: Value) -> None:
        """Set a variable: it has the value at once, also where the inputs of the instance follow times."""
        own = self.runners[instance]
        set_input(own, name, value, None)
        if isinstance(own.instance, TimedInputs):
            own.instance.set_values({name: value})

    def access(self, instance: str, verb: Verb, names: tuple[str, ...]) -> native.CopyCall | None:
        """See `AccessedNatively`."""
        if instance not in self.runners:  # it could not begin
            return None
        own = self.runners[instance].instance
        return own.access(verb, names) if isinstance(own, AroundNativeSteps) else None

    def column(self, instance: str, name: str) -> native.CopyOutput:
        """Where an output lies in the rows of an instance."""
        if instance not in self.runners:
            return native.CopyOutput()
        runner = self.runners[instance]
        ring, place = runner.outputs, runner.outputs.layout.place(name)
        first = ring.address + ring.place_in_row(place.part, place.first)
        return native.CopyOutput(first, ring.stride, ring.mask, runner.plan.step_points)

    def values(self, instance: str, names: Sequence[str], point: int, since: int) -> list[Value]:
        """The values of variables; those of outputs are in their row, if nothing was set since then."""
        runner = self.runners[instance]
        row = point // runner.plan.step_points
        known = runner.plan.outputs.names
        if since == row == runner.step or any(name not in known for name in names):
            return runner.instance.get_values(names)
        return [runner.outputs.value(row, name) for name in names]

    # --- states

    def save(self, point: int) -> SavedCopy:
        """Save it at a point."""
        states: dict[str, object] = {}
        try:
            for name, keeper in self._keepers():
                states[name] = keeper.get_state()
        except BaseException:
            self.free(SavedCopy(point, states, b"", self._instances))
            raise
        text = tuple(part.copy() for runner in self.runners.values() for part in _texts(runner))
        kept = b"".join(ctypes.string_at(address, size) for address, size in self._spans())
        return SavedCopy(point, states | {"": text}, kept, self._instances)

    def restore(self, saved: SavedCopy) -> None:
        """Bring it back to a point; see `save`.

        Raises:
            CallRefused: it has other instances since then.
        """
        if saved.instances is not self._instances:
            text = (
                "a copy whose FMU had failed has new instances, and a state that was saved before belongs to the others"
            )
            raise CallRefused(text, hint="Save a new state after the reset.")
        for name, keeper in self._keepers():
            keeper.set_state(saved.states[name])
        first = 0
        for address, size in self._spans():
            ctypes.memmove(address, saved.kept[first : first + size], size)
            first += size
        parts = (part for runner in self.runners.values() for part in _texts(runner))
        for part, kept in zip(parts, cast("tuple[NDArray[Any], ...]", saved.states[""]), strict=True):
            part[...] = kept
        for runner in self.runners.values():
            if runner.plan.section.on_failure == "stop":
                runner.follow_inputs()
            else:  # it had failed, or has failed
                runner.refit()

    def restored_by(self, saved: SavedCopy) -> tuple[list[native.CopyCall], list[native.Keep], list[int]] | None:
        """What `restore` does, as calls, pieces, and their places in memory; None if there is more to do.

        It is a state of point 0: of the outputs there is one row, and steps write the others before they are read.
        """
        calls = []
        for name, keeper in self._keepers():
            call = keeper.state_access(saved.states[name]) if isinstance(keeper, AccessedNatively) else None
            if call is None:
                return None
            calls.append(call)
        if any(len(_texts(runner)) for runner in self.runners.values()):
            return None
        rows = {own.outputs.address: own.outputs.stride for own in self.runners.values()}
        pieces, places, kept = [], [], 0
        for address, size in self._spans():
            pieces.append(native.Keep(kept // 8, rows.get(address, size) // 8))
            places.append(address)
            kept += size
        return calls, pieces, places

    def free(self, saved: SavedCopy) -> None:
        """Free what was saved; the states of instances that are closed went with them."""
        for name, keeper in self._keepers() if saved.instances is self._instances else ():
            if name in saved.states:
                with suppress(FmuMeshError, ValueError):  # it has failed before, and its memory goes with it
                    keeper.free_state(saved.states[name])

    def _keepers(self) -> Iterator[tuple[str, KeepsState]]:
        return ((name, cast("KeepsState", runner.instance)) for name, runner in self.runners.items())

    def _spans(self) -> Iterator[tuple[int, int]]:
        """The memory that says how far this copy is, and its rows."""
        yield from self.engine.places
        for runner in self.runners.values():
            yield runner.counter.address, 8
            for ring in (runner.outputs, runner.inputs) if runner.inputs.layout.names else (runner.outputs,):
                yield ring.address, ring.rows * ring.stride
            if isinstance(runner.instance, StepsNatively) and (own := runner.instance.native) is not None:
                yield own.said, ctypes.sizeof(native.Said)

    def close(self) -> None:
        """Close all instances. May be called twice."""
        self._system.close()


def _texts(runner: Runner) -> Collection[NDArray[Any]]:
    rings = (runner.outputs, runner.inputs)
    return [part for ring in rings for part in ring.parts if part.dtype.hasobject]
