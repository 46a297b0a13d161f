"""Where the wall-clock time of a run went, as Structs: measured by nodes and the master, shown by whoever started them.

All times are in s. Instants are those of `time.perf_counter`: on Linux one clock for all processes of a host, so that
time lines of several processes fit together; those of another host need an origin of their own.
"""

from __future__ import annotations

import msgspec

__all__ = ["GRANT", "TIME_LINE_ENTRIES", "Burst", "MeshProfile", "NodeProfile", "UnitProfile", "Wait"]

TIME_LINE_ENTRIES = 100_000
"""How many bursts and waits the time lines of all nodes of a mesh hold together; sums are never cut."""

GRANT = ""
"""What stands for the master's grant where the name of an instance could stand."""


class Burst(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Steps that a node took in a row.

    Attributes:
        unit: index of the unit that stepped, in `NodeProfile.units`.
        steps: own steps of its first instance.
        sent_s: how much of the time, at its end, went into sending frames.
    """

    start: float
    end: float
    unit: int
    steps: int
    sent_s: float


class Wait(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A wait of a node for one message; ``reason`` is the source instance that was behind, or `GRANT`."""

    start: float
    end: float
    reason: str


class UnitProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is stepped together: one instance, or the instances of a cycle within one node.

    Attributes:
        steps: own steps of its first instance.
        bursts: bursts they were taken in.
        compute_s: time spent in them: the FMU, and the rows it reads and writes.
    """

    instances: tuple[str, ...]
    steps: int
    bursts: int
    compute_s: float


class NodeProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How one node spent the time from its first to its last point.

    Attributes:
        started: instant of point 0.
        ended: instant at which it had no step left to take.
        transport_s: time spent encoding and sending frames, and decoding those that came.
        wait_s: time spent waiting for a message, by the source instance that was behind, or `GRANT`.
        bursts: the time line of stepping; the first ones, if there were more than it may hold.
        waits: likewise, the time line of waiting.
        cut: entries that the time lines do not hold.
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
        """Time spent waiting, whatever for."""
        return sum(self.wait_s.values())


class MeshProfile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The profile of one run.

    Attributes:
        nodes: in the order of the plan; the recorder is not among them.
        held_s: how long which node was the one that kept the grant from growing.
    """

    nodes: tuple[NodeProfile, ...]
    held_s: dict[str, float]
