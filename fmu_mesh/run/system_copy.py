"""One of many copies of a system in this process: its memory, its instances and what steps them.

Used by `fmu_mesh.run.copies`, which steps all copies with one call and knows how each has ended.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, Literal, NamedTuple, cast

from msgspec.structs import replace
from numpy.typing import NDArray

from ..errors import FmuError, FmuMeshError, ProtocolBroken
from ..instances.call_guard import Guarded, Unwatched
from ..instances.contract import AccessedNatively, Instance, KeepsState, StepsNatively
from ..node.burst_engine import BurstEngine, make_engine
from ..node.engine import Engine, PlainEngine
from ..node.initialization import Initialization
from ..node.inputs import TimedInputs, set_input, with_times
from ..node.stepping import Runner, connect
from ..rings import native
from ..rings.host_memory import HostMemory
from ..rings.native import BurstEnd
from ..system.memory_map import MemoryMap, RingPlace
from ..system.plan import NodePlan
from ..variables.value_types import Value

__all__ = ["IN_ONE_NODE", "Overrides", "SavedCopy", "SystemCopy", "Verb"]

IN_ONE_NODE: Final = "instances"
"""The node with all instances."""

Verb = Literal["Get", "Set"]
Overrides = Mapping[str, Mapping[str, Value]]


class SavedCopy(NamedTuple):
    """The state of one copy at a point; the states of its instances by name, and its texts by the name ""."""

    point: int
    states: Mapping[str, object]
    kept: bytes


class SystemCopy:
    """One copy: its memory, its instances and what steps them."""

    def __init__(
        self, node: NodePlan, places: tuple[MemoryMap, Mapping[str, RingPlace]], opened: Callable[[str], Instance]
    ) -> None:
        self._node, self._opened = node, opened
        self._map, self._places = places
        self.runners: dict[str, Runner] = {}
        self.engine: Engine

    def begin(self, overrides: Overrides) -> None:
        """Open new instances and initialize them; then they are at point 0.

        These start values, by instance and variable, stand in the place of those of the plan.
        """
        node, memory = self._node, HostMemory.private(self._map, IN_ONE_NODE)
        guards: list[Instance] = []
        try:
            for item in node.instances:
                own = overrides.get(item.name)
                plan = replace(item, start_values=item.start_values | dict(own)) if own else item
                guards.append(Guarded(item.name, partial(self._opened, item.name), Unwatched(), node.timeouts))
                timed = with_times(guards[-1], plan, node.grid, lambda _message: None)
                place = self._places[item.name]
                ring, counter = memory.ring(place), memory.counter(place.counter)
                self.runners[item.name] = Runner(plan, timed, node.grid, ring, counter)
            connect(node, self.runners, memory, memory)
            Initialization(node, _nothing_comes).run(self.runners.values())
            units = [[self.runners[name] for name in names] for names in node.units]
            self.engine = make_engine(node, units, memory, spins=False)
            for runner in self.runners.values():
                runner.begin()
            memory.grant.raise_to(node.grid.last_point)
        except BaseException:
            for guarded in guards:
                guarded.close()
            self.runners.clear()
            raise

    @property
    def point(self) -> int:
        """Without the library: the last point that all instances have reached."""
        return min(self.engine.covered, self._node.grid.last_point)

    def step_to(self, goal: int) -> None:
        """Without the library: step to a point."""
        for point in range(self.point, goal):
            cast("PlainEngine", self.engine).step_to(point + 1)

    def complete(self, end: int) -> None:
        """Let Python complete a step for which the library has returned ``end``."""
        if end == BurstEnd.BLOCKED:
            raise ProtocolBroken("an instance cannot step, although all instances before it have stepped")
        cast("BurstEngine", self.engine).complete(end)

    def begun_at(self, error: FmuError) -> int:
        """The point at which the step began that has failed."""
        runner = self.runners.get(error.instance or "") or self.engine.current
        return runner.point if runner is not None else 0

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
        own = self.runners[instance].instance
        return own.access(verb, names) if isinstance(own, AccessedNatively) else None

    def column(self, instance: str, name: str) -> native.CopyOutput:
        """Where an output lies in the rows of an instance."""
        runner = self.runners[instance]
        place = runner.outputs.layout.place(name)
        at = runner.outputs.place_in_row(place.part, place.first)
        return native.CopyOutput(ctypes.addressof(runner.table), at)

    def values(self, instance: str, names: Sequence[str], point: int, since: int) -> list[Value]:
        """The values of variables; those of outputs are in their row, if nothing was set since then."""
        runner = self.runners[instance]
        row = point // runner.plan.step_points
        known = runner.plan.outputs.names
        if since == row or any(name not in known for name in names):
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
            self.free(SavedCopy(point, states, b""))
            raise
        text = tuple(part.copy() for runner in self.runners.values() for part in _texts(runner))
        kept = b"".join(ctypes.string_at(address, size) for address, size in self._spans())
        return SavedCopy(point, states | {"": text}, kept)

    def restore(self, saved: SavedCopy) -> None:
        """Bring it back to a point; see `save`."""
        for name, keeper in self._keepers():
            keeper.set_state(saved.states[name])
        first = 0
        for address, size in self._spans():
            ctypes.memmove(address, saved.kept[first : first + size], size)
            first += size
        parts = (part for runner in self.runners.values() for part in _texts(runner))
        for part, kept in zip(parts, cast("tuple[NDArray[Any], ...]", saved.states[""]), strict=True):
            part[...] = kept

    def restored_by(self, saved: SavedCopy) -> tuple[list[native.CopyCall], list[native.Keep]] | None:
        """What `restore` does, as calls of the library; None if there is more to do. ``saved`` has to be kept."""
        calls = []
        for name, keeper in self._keepers():
            call = keeper.state_access(saved.states[name]) if isinstance(keeper, AccessedNatively) else None
            if call is None:
                return None
            calls.append(call)
        if any(len(_texts(runner)) for runner in self.runners.values()):
            return None
        keeps, kept = [], ctypes.cast(ctypes.c_char_p(saved.kept), ctypes.c_void_p).value or 0
        for address, size in self._spans():
            keeps.append(native.Keep(address, kept, size))
            kept += size
        return calls, keeps

    def free(self, saved: SavedCopy) -> None:
        """Free what was saved."""
        for name, keeper in self._keepers():
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
            for ring in (runner.outputs, runner.inputs):
                yield ring.address, ring.rows * ring.stride
            if isinstance(runner.instance, StepsNatively) and (own := runner.instance.native) is not None:
                yield own.said, ctypes.sizeof(native.Said)

    def close(self) -> None:
        """Close all instances. May be called twice."""
        for runner in self.runners.values():
            runner.instance.close()
            runner.follow(native.MemberTable())
        self.runners.clear()


def _texts(runner: Runner) -> Collection[NDArray[Any]]:
    rings = (runner.outputs, runner.inputs)
    return [part for ring in rings for part in ring.parts if part.dtype.hasobject]


def _nothing_comes(_left_s: float) -> None:
    """In the place of a wait for other nodes."""
    raise ProtocolBroken("an initial value has no source in this process")
