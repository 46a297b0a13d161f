"""How a run spent its wall-clock time, as Structs: nodes and the master measure it, `launch` shows it.

All times are in s. Instants are those of `time.perf_counter`. On Linux this is one clock for all processes of a host,
so their time lines can be compared; time lines of another host need another origin.
"""

from __future__ import annotations

import msgspec

__all__ = ["GRANT", "TIME_LINE_ENTRIES", "Burst", "MeshProfile", "NodeProfile", "UnitProfile", "Wait"]

TIME_LINE_ENTRIES = 100_000
"""Largest number of bursts and waits in the time lines of all nodes of a mesh; the sums contain all of them."""

GRANT = ""
"""Stands for the master's grant in place of the name of an instance."""


class Burst(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Steps that a node took in a row: own steps of the first instance of a unit, which is an index of its `units`."""

    start: float
    end: float
    unit: int
    steps: int


class Wait(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A wait of a node for one message; ``reason`` is the source instance that it waited for, or `GRANT`."""

    start: float
    end: float
    reason: str


class UnitProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Instances that step together: one instance, or the instances of a cycle within one node.

    Attributes:
        steps: own steps of its first instance.
        compute_s: time spent in them: in the FMU, and for reading and writing rows.
    """

    instances: tuple[str, ...]
    steps: int
    bursts: int
    compute_s: float


class NodeProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one node spent the time from its first to its last point.

    Attributes:
        started: instant of point 0.
        ended: instant of the end of its last step.
        transport_s: time spent encoding and sending frames, and decoding received ones.
        wait_s: time spent waiting for a message, by the source instance that it waited for, or `GRANT`.
        bursts: the time line of stepping, and ``waits`` that of waiting; only the first ones, if there are too many.
        cut: number of entries that are missing in the time lines.
    """

    node: str
    host: str
    pid: int
    started: float
    ended: float
    units: tuple[UnitProfile, ...]
    transport_s: float
    wait_s: dict[str, float]
    bursts: tuple[Burst, ...] = ()
    waits: tuple[Wait, ...] = ()
    cut: int = 0

    @property
    def seconds(self) -> float:
        """From the first to the last point."""
        return self.ended - self.started

    @property
    def compute_s(self) -> float:
        """Time spent in the steps of all units."""
        return sum(unit.compute_s for unit in self.units)

    @property
    def waited_s(self) -> float:
        """Time spent waiting, for any reason."""
        return sum(self.wait_s.values())


class MeshProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The profile of one run; ``held_s`` says how long each node limited the grant."""

    nodes: tuple[NodeProfile, ...]
    held_s: dict[str, float]
