"""The tables of `burst.c` in Python: the same structures, and the functions of the library.

Owns no memory but that of the tables; who makes a table keeps what its addresses point to. `library` is None where the
library is missing, and then nothing else of this module may be used.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from ctypes import CFUNCTYPE, POINTER, PYFUNCTYPE, Structure, c_bool, c_double, c_int32, c_int64, c_uint32, c_void_p
from enum import IntEnum
from typing import Any, Final, NamedTuple

from ..variables.value_types import VariableType
from .library import load_library

__all__ = [
    "NEVER",
    "NUMBER_TYPES",
    "OUT_OF_RANGE",
    "STAGE_BITS",
    "WRONG_ROW",
    "BurstEnd",
    "Call",
    "Change",
    "Entry",
    "Gate",
    "Lookup",
    "MemberTable",
    "Move",
    "NativeStep",
    "NodeTable",
    "OutputTable",
    "Participant",
    "Peer",
    "RowBase",
    "Said",
    "Span",
    "Stage",
    "StepKind",
    "Track",
    "UnitTable",
    "Wish",
    "library",
    "table",
]

NEVER: Final = 2**63 - 1
STAGE_BITS: Final = 24
_LARGEST: Final = 2**63 - 1
OUT_OF_RANGE: Final = 100
"""The status of a call where a value does not fit into the type of the model."""
WRONG_ROW: Final = 101
"""The status of a step whose row is not finite."""


class StepKind(IntEnum):
    """How a member takes its step."""

    BY_PYTHON = 0
    FMI1 = 1
    FMI2 = 2
    FMI3 = 3


class Stage(IntEnum):
    """What a member is doing."""

    WAITING = 0
    SETTING = 1
    STEPPING = 2
    GETTING = 3
    IN_PYTHON = 4
    STEPPED = 5


class RowBase(IntEnum):
    """What an offset of a table is relative to; row ``n`` of the gates is ``FIRST_GATE + n``."""

    FIXED = 0
    OUTPUT = 1
    WATCHED = 2
    FIRST_GATE = 3


class Change(IntEnum):
    """What a `Move` makes of a value."""

    UNCHANGED = 0
    SCALED = 1
    LOOKED_UP = 2


class BurstEnd(IntEnum):
    """Why `node_run` returned."""

    SLICE = 0
    DONE = 1
    ATTENTION = 2
    BLOCKED = 3
    PYTHON = 4
    STATUS = 5
    FORGED = 6
    NOT_FINITE = 7


NUMBER_TYPES: Final[dict[VariableType, int]] = {
    "Float64": 0,
    "Float32": 1,
    "Int8": 2,
    "UInt8": 3,
    "Int16": 4,
    "UInt16": 5,
    "Int32": 6,
    "UInt32": 7,
    "Int64": 8,
    "Enumeration": 8,
    "UInt64": 9,
    "Boolean": 10,
}
"""The types of `Move`. An Enumeration is 64 bits in a ring."""


class Participant(Structure):
    """Which process this is among those of the memory."""

    _fields_ = (("bells", c_void_p), ("processes", c_int64), ("own", c_int64))


class Gate(Structure):
    """The rows of one source, for one delay."""

    _fields_ = (
        ("counter", c_void_p),
        ("rows", c_void_p),
        ("stride", c_int64),
        ("mask", c_int64),
        ("lead", c_int64),
        ("points", c_int64),
        ("known", c_int64),
    )


class Entry(Structure):
    """A value of a source, and what its target gets instead; ``large`` adds 2**64 to a negative number."""

    _fields_ = (("from_", c_int64), ("to", c_int64), ("from_large", c_int32), ("to_large", c_int32))


class Lookup(Structure):
    """The map of a connection, and the numbers that its input can be; without items all of its type."""

    _fields_ = (("entries", POINTER(Entry)), ("items", POINTER(c_int64)), ("n_entries", c_int64), ("n_items", c_int64))

    @classmethod
    def of(cls, mapping: Mapping[int, int], items: Iterable[int]) -> Lookup:
        """The table for a map and the numbers of items; it keeps what it points to."""
        pairs = sorted(mapping.items())
        entries = [Entry(_signed(have), _signed(want), have > _LARGEST, want > _LARGEST) for have, want in pairs]
        numbers = sorted({*items})
        return cls(table(Entry, entries), table(c_int64, numbers), len(entries), len(numbers))


class Move(Structure):
    """Values that are copied from one base to another, with factor, offset and type, or with a map."""

    _fields_ = (
        ("from_base", c_int64),
        ("from_", c_int64),
        ("to_base", c_int64),
        ("to", c_int64),
        ("count", c_int64),
        ("from_type", c_int32),
        ("to_type", c_int32),
        ("change", c_int32),
        ("negated", c_int32),
        ("factor", c_double),
        ("offset", c_double),
        ("lookup", c_void_p),
    )


class Call(Structure):
    """A getter or a setter of an FMU; ``size`` is -1 where it takes no number of values."""

    _fields_ = (
        ("function", c_void_p),
        ("references", c_void_p),
        ("count", c_int64),
        ("base", c_int64),
        ("values", c_int64),
        ("size", c_int64),
    )


class OutputTable(Structure):
    """A ring that a member writes."""

    _fields_ = (("rows", c_void_p), ("stride", c_int64), ("mask", c_int64))


class Said(Structure):
    """What a model says in a step besides its status, and how far it is.

    Attributes:
        event_needed, terminate, early: the results of a step in FMI 3.0 (4.2.1).
        call: the getter or setter that returned a status above warning.
        last_time: the time of an early return in s.
        quiet_until: a step that ends at this time (s) or later is taken by Python.
        time: of the model, in s; only after a step without anything special.
        step: own steps done.
    """

    _fields_ = (
        ("event_needed", c_bool),
        ("terminate", c_bool),
        ("early", c_bool),
        ("call", c_int32),
        ("last_time", c_double),
        ("quiet_until", c_double),
        ("time", c_double),
        ("step", c_int64),
    )

    @property
    def addresses(self) -> tuple[int, int, int, int]:
        """Of the results of a step in FMI 3.0: `event_needed`, `terminate`, `early` and `last_time`."""
        first = ctypes.addressof(self)
        return first, first + 1, first + 2, first + 8

    def note(self, *, step: int | None = None, time: float | None = None, quiet_until: float | None = None) -> None:
        """Change what is given."""
        if step is not None:
            self.step = step
        if time is not None:
            self.time = time
        if quiet_until is not None:
            self.quiet_until = quiet_until

    def clear(self) -> None:
        """Before a step in FMI 3.0: nothing is said yet."""
        self.event_needed = self.terminate = self.early = False

    @property
    def anything(self) -> bool:
        """Whether the last step has said anything."""
        return bool(self.event_needed or self.terminate or self.early)


class Track(Structure):
    """An input with a value for each own step that the burst takes before `MemberTable.python_at`."""

    _fields_ = (("values", c_void_p), ("to", c_void_p))


class Span(Structure):
    """Floats of a row that have to be finite: ``place`` in bytes, ``type`` as in `NUMBER_TYPES`."""

    _fields_ = (("place", c_int64), ("count", c_int64), ("type", c_int64))


class MemberTable(Structure):
    """One instance: how it gets its inputs, steps, and gives its outputs."""

    _fields_ = (
        ("gates", POINTER(Gate)),
        ("loads", POINTER(Move)),
        ("setters", POINTER(Call)),
        ("getters", POINTER(Call)),
        ("stores", POINTER(Move)),
        ("n_gates", c_int64),
        ("n_loads", c_int64),
        ("n_setters", c_int64),
        ("n_getters", c_int64),
        ("n_stores", c_int64),
        ("kind", c_int64),
        ("component", c_void_p),
        ("do_step", c_void_p),
        ("said", c_void_p),
        ("start_time", c_double),
        ("base_step_size", c_double),
        ("step_size", c_double),
        ("points", c_int64),
        ("every", c_int64),
        ("last_step", c_int64),
        ("python_at", c_int64),
        ("tracks", POINTER(Track)),
        ("n_tracks", c_int64),
        ("tracks_from", c_int64),
        ("finite", POINTER(Span)),
        ("n_finite", c_int64),
        ("outputs", OutputTable * 2),
        ("counter", c_void_p),
        ("bases", POINTER(c_void_p)),
        ("step", c_int64),
        ("stage", c_int64),
        ("outcome", c_int64),
    )

    def check_rows(self, spans: Sequence[Span]) -> None:
        """These floats of each row have to be finite."""
        self.finite, self.n_finite = table(Span, spans), len(spans)


class UnitTable(Structure):
    """Members that step together."""

    _fields_ = (
        ("members", POINTER(MemberTable)),
        ("n_members", c_int64),
        ("tick_points", c_int64),
        ("last_tick", c_int64),
        ("tick", c_int64),
        ("next", c_int64),
        ("burst", c_int64),
        ("stopped", c_int64),
        ("spent_ns", c_int64),
        ("blocked_by", c_void_p),
        ("need", c_int64),
    )


class Peer(Structure):
    """A process that may be some points behind, and no more."""

    _fields_ = (("progress", c_void_p), ("window", c_int64))


class NodeTable(Structure):
    """All units of a process."""

    _fields_ = (
        ("place", Participant),
        ("units", POINTER(UnitTable)),
        ("n_units", c_int64),
        ("peers", POINTER(Peer)),
        ("n_peers", c_int64),
        ("ceiling", c_void_p),
        ("progress", c_void_p),
        ("last_point", c_int64),
        ("slice_ns", c_int64),
        ("wait_ns", c_int64),
        ("eager", c_int64),
        ("spins", c_int64),
        ("batch", c_int64),
        ("stride", c_int64),
        ("allowed", c_int64),
        ("patience", c_int64),
        ("waited_ns", c_int64),
        ("restored", c_int64),
        ("late", c_int64),
        ("unit", c_int64),
        ("member", c_int64),
        ("attention", c_int64),
    )


class Wish(Structure):
    """One value of a counter that somebody waits for."""

    _fields_ = (("counter", c_void_p), ("need", c_int64))


class NativeStep(NamedTuple):
    """How an FMU takes a step without Python: the tables of `call_step`.

    Attributes:
        kind: how its function of the step is called.
        component: address of the instance.
        do_step: address of this function.
        said: address of its `Said`.
        loads: from the row of inputs to buffers of other types.
        setters: read the row of inputs, or buffers.
        getters: write the rows of `RowBase.OUTPUT` and `RowBase.WATCHED`, or buffers.
        stores: from buffers to these rows.
        kept: what the addresses point to.
    """

    kind: StepKind
    component: int
    do_step: int
    said: int
    loads: Sequence[Move]
    setters: Sequence[Call]
    getters: Sequence[Call]
    stores: Sequence[Move]
    kept: Sequence[object]


def table(kind: Any, items: Sequence[Any]) -> Any:  # noqa: ANN401 ctypes has no type for an array of any structure
    """The items as a C array, which may be empty."""
    return (kind * max(len(items), 1))(*items)


def _signed(number: int) -> int:
    """The number with the same 64 bits that `int64_t` has."""
    return number - 2**64 if number > _LARGEST else number


_STRUCTURES: Final = (
    Participant,
    Gate,
    Move,
    Call,
    OutputTable,
    MemberTable,
    UnitTable,
    Peer,
    NodeTable,
    Wish,
    Said,
    Track,
    Entry,
    Lookup,
    Span,
)


class _Library:
    """The functions of `burst.c`. Those that may take long release the interpreter's lock."""

    def __init__(self, path: str) -> None:
        quick, slow = ctypes.PyDLL(path), ctypes.CDLL(path)
        address = c_void_p
        self.run = CFUNCTYPE(c_int64, address)(("node_run", slow))
        self.sleep_for = CFUNCTYPE(c_int64, address, c_uint32, address, c_int64, c_int64, address)(("sleep_for", slow))
        self.member_step = CFUNCTYPE(c_int64, address, c_int64)(("member_step", slow))
        self.member_is_finite = PYFUNCTYPE(c_int64, address, c_int64)(("member_is_finite", quick))
        self.attend = PYFUNCTYPE(None, address)(("node_attend", quick))
        self.attended = PYFUNCTYPE(None, address)(("node_attended", quick))
        self.ring_bell = PYFUNCTYPE(None, address)(("ring_bell", quick))
        self.bell_seen = PYFUNCTYPE(c_uint32, address)(("bell_seen", quick))
        self.counter_raise = PYFUNCTYPE(None, address, address, c_int64)(("counter_raise", quick))
        self.counter_value = PYFUNCTYPE(c_int64, address)(("counter_value", quick))
        self.grant_withdraw = PYFUNCTYPE(c_int64, address, address, c_int64)(("grant_withdraw", quick))
        sizes = (c_int64 * len(_STRUCTURES))()
        count = PYFUNCTYPE(c_int64, address)(("structure_sizes", quick))(sizes)
        if count != len(_STRUCTURES) or list(sizes) != [ctypes.sizeof(structure) for structure in _STRUCTURES]:
            msg = f"{path} was built from other structures"
            raise OSError(msg)


def _load() -> _Library | None:
    path = load_library()
    return _Library(path) if path is not None else None


library: Final = _load()
