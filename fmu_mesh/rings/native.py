"""The tables of the burst in Python, with the fields that `burst.h` declares, and the functions of the library.

Owns no memory but that of the tables; who makes a table keeps what its addresses point to. `library` is None where the
library is missing: then the tables are only structures.
"""

# Why not `cffi.FFI().cdef(header)`: its parser of C takes 40 to 60 ms at the start of each process of a mesh, these
# expressions less than one. `library.py` compares the SHA-256 of the header, so the sizes need no look of their own.

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from ctypes import POINTER, Structure, c_bool, c_char, c_double, c_int32, c_int64, c_void_p
from enum import IntEnum
from keyword import iskeyword
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from ..variables.value_types import VariableType
from .library import LibraryFunctions, load_library

__all__ = [
    "NEVER",
    "NUMBER_TYPES",
    "OUT_OF_RANGE",
    "STAGE_BITS",
    "WRONG_ROW",
    "BurstEnd",
    "Call",
    "Change",
    "Changed",
    "CopyCall",
    "CopyOutput",
    "CopyTable",
    "Entry",
    "EquationsTable",
    "Gate",
    "HeardTable",
    "IncomingTable",
    "Keep",
    "Last",
    "Lookup",
    "MemberTable",
    "Move",
    "NativeStep",
    "NodeTable",
    "OutgoingTable",
    "OutputTable",
    "Participant",
    "Peer",
    "Piece",
    "Region",
    "RowBase",
    "Said",
    "Span",
    "Stage",
    "StepKind",
    "StreamState",
    "StreamTable",
    "StreamsTable",
    "ToldTable",
    "Track",
    "UnitTable",
    "Wish",
    "WorkKind",
    "declared",
    "library",
    "table",
]

NEVER: Final = 2**63 - 1
STAGE_BITS: Final = 24
OUT_OF_RANGE: Final = 100
"""The status of a call where a value does not fit into the type of the model."""
WRONG_ROW: Final = 101
"""The status of a step whose row is not finite."""

# The numbers of the enumerations of `burst.h`, as classes for the type checker; a test compares them.


class StepKind(IntEnum):
    """How a member takes its step."""

    BY_PYTHON, FMI1, FMI2, FMI3, EQUATIONS = range(5)


class Stage(IntEnum):
    """What a member is doing."""

    WAITING, SETTING, STEPPING, GETTING, IN_PYTHON, STEPPED = range(6)


class RowBase(IntEnum):
    """What an offset of a table is relative to; row ``n`` of the gates is ``FIRST_GATE + n``."""

    FIXED, OUTPUT, WATCHED, FIRST_GATE = range(4)


class Change(IntEnum):
    """What a `Move` makes of a value."""

    UNCHANGED, SCALED, LOOKED_UP, ADDED = range(4)


class StreamState(IntEnum):
    """Whether a stream can be used, or why not."""

    OPEN, CUT, GAP, TWICE, LATE, REFUSED = range(6)


class Last(IntEnum):
    """Whether more rows of a link come."""

    GOES_ON, UNSAID, SAID = range(3)


class BurstEnd(IntEnum):
    """Why `node_run` returned."""

    SLICE, DONE, ATTENTION, BLOCKED, PYTHON, STATUS, FORGED, NOT_FINITE, RAISED = range(9)


class WorkKind(IntEnum):
    """What is done with many copies."""

    STEP, CALL, READ, RESTORE, HAND_OVER = range(5)


_NUMBERS: Final = "Float64 Float32 Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Boolean".split()  # noqa: SIM905  shorter
NUMBER_TYPES: Final = cast(
    "dict[VariableType, int]", {name: number for number, name in enumerate(_NUMBERS)} | {"Enumeration": 8}
)
"""The types of `Move`. An Enumeration is 64 bits in a ring."""

_KINDS: Final[dict[str, Any]] = {
    "int64_t": c_int64,
    "int32_t": c_int32,
    "double": c_double,
    "uint8_t": c_bool,  # a truth of FMI 3.0
    "char": c_char,
}
"""The types of the fields; `declared` adds each structure."""

_HEADER: Final = re.sub(r"/\*.*?\*/", "", Path(__file__).with_name("burst.h").read_text("ascii"), flags=re.DOTALL)
_DECLARED: Final = {name: fields for fields, name in re.findall(r"typedef struct \{(.*?)\} (\w+);", _HEADER, re.DOTALL)}
_FIELDS: Final = re.compile(r"(?:const |_Atomic )?(\w+) ([^;]+);")
_FIELD: Final = re.compile(r"(\**)(\w+)(?:\[(\d+)\])?")


def declared(name: str) -> Callable[[type[Structure]], type[Structure]]:
    """Give a class the fields of a structure of `burst.h`; one whose name Python needs itself gets `_` behind it."""

    def complete(structure: type[Structure]) -> type[Structure]:
        fields = [(kind, *field) for kind, own in _FIELDS.findall(_DECLARED[name]) for field in _FIELD.findall(own)]
        arrays = {field.removeprefix("n_") for _, _, field, _ in fields if field.startswith("n_")}
        found = []
        for kind, stars, field, length in fields:
            if stars:
                made = POINTER(c_void_p) if stars == "**" else POINTER(_KINDS[kind]) if field in arrays else c_void_p
            else:
                made = _KINDS[kind] * int(length) if length else _KINDS[kind]
            found.append((f"{field}_" if iskeyword(field) else field, made))
        structure._fields_ = found
        _KINDS[name] = structure
        return structure

    return complete


class Changed(Structure):
    """A structure whose fields others change while the library does not use it."""

    def note(self, **changed: float | None) -> None:
        """Change fields."""
        for name, value in changed.items():
            setattr(self, name, value)


@declared("Place")
class Participant(Structure):
    """Which process this is among those of the memory."""


@declared("Wish")
class Wish(Structure):
    """One value of a counter that somebody waits for."""


@declared("Region")
class Region(Structure):
    """Memory of this process that the host of an FMU needs."""


@declared("Gate")
class Gate(Changed):
    """The rows of one source, for one rule."""


@declared("Entry")
class Entry(Structure):
    """A value of a source, and what its target gets instead; ``large`` adds 2**64 to a negative number."""


@declared("Lookup")
class Lookup(Structure):
    """The map of a connection, and the numbers that its input can be; without items all of its type."""

    @classmethod
    def of(cls, mapping: Mapping[int, int], items: Iterable[int]) -> Lookup:
        """The table for a map and the numbers of items; it keeps what it points to."""

        def signed(number: int) -> int:  # with the same 64 bits
            return number - 2**64 if number >= 2**63 else number

        pairs = sorted(mapping.items())
        entries = [Entry(signed(have), signed(want), have >= 2**63, want >= 2**63) for have, want in pairs]
        numbers = sorted({*items})
        return cls(table(Entry, entries), table(c_int64, numbers), len(entries), len(numbers))


@declared("Move")
class Move(Structure):
    """Values that are copied from one base to another, with factor, offset and type, or with a map."""


@declared("Call")
class Call(Structure):
    """A getter or a setter of an FMU; ``size`` is -1 where it takes no number of values."""


@declared("Output")
class OutputTable(Structure):
    """A ring that a member writes."""


@declared("Span")
class Span(Structure):
    """Floats of a row that have to be finite: ``place`` in bytes, ``type`` as in `NUMBER_TYPES`."""


@declared("Said")
class Said(Changed):
    """What a model says in a step besides its status, and how far it is."""

    @property
    def addresses(self) -> tuple[int, int, int, int]:
        """Of the results of a step in FMI 3.0: `event_needed`, `terminate`, `early` and `last_time`."""
        first = ctypes.addressof(self)
        return first, first + 1, first + 2, first + Said.last_time.offset

    def clear(self) -> None:
        """Before a step in FMI 3.0: nothing is said yet."""
        self.event_needed = self.terminate = self.early = False

    @property
    def anything(self) -> bool:
        """Whether the last step has said anything."""
        return bool(self.event_needed or self.terminate or self.early)


@declared("Track")
class Track(Structure):
    """An input with a value for each own step that the burst takes before `MemberTable.python_at`."""


class _WithArrays(Changed):
    def give(self, **arrays: Sequence[Structure]) -> None:
        """Give it arrays, by the names of their fields, and their lengths; it keeps them."""
        kinds: dict[str, Any] = {field: kind for field, kind, *_ in self._fields_}
        for name, items in arrays.items():
            setattr(self, name, table(kinds[name]._type_, items))
            setattr(self, f"n_{name}", len(items))


@declared("Equations")
class EquationsTable(_WithArrays):
    """The equations of a model-exchange FMU, and their solver."""


@declared("Member")
class MemberTable(_WithArrays):
    """One instance: how it gets its inputs, steps, and gives its outputs."""


@declared("Unit")
class UnitTable(Changed):
    """Members that step together."""


@declared("Peer")
class Peer(Structure):
    """A process that may be some points behind, and no more."""


@declared("Piece")
class Piece(Structure):
    """Bytes of a row that go over the wire, and whether they are Booleans."""


class _Counted(_WithArrays):
    @property
    def known(self) -> int:
        """How many rows are here."""
        return int(library.counter_value(self.counter)) if library is not None else 0


@declared("Outgoing")
class OutgoingTable(_Counted):
    """The rows of one link for another process."""

    last: int
    sent: int

    def go_on(self, received: int) -> None:
        """While nobody sends: send all rows from here on, and once more that they are the last."""
        self.sent = received if 0 <= received <= self.known else 0
        if self.last == Last.SAID:
            self.last = Last.UNSAID

    def end(self) -> bool:
        """No more rows come; whether that is news."""
        goes_on = self.last == Last.GOES_ON
        if goes_on:
            self.last = Last.UNSAID
        return goes_on


@declared("Incoming")
class IncomingTable(_Counted):
    """The rows of one link from another process."""

    ended: int

    def take_end(self) -> bool:
        """Whether no more rows come, and nobody knows that yet."""
        if is_news := self.ended == 1:
            self.ended = 2
        return is_news


@declared("Told")
class ToldTable(Structure):
    """A counter of this process that another one has, too."""


@declared("Heard")
class HeardTable(Structure):
    """A counter of another process."""


@declared("Stream")
class StreamTable(_WithArrays):
    """One socket to another process."""

    has_ended: int
    is_known: int

    def take_state(self) -> StreamState | None:
        """Why it cannot be used, if it cannot, and nobody knows that yet."""
        if self.state == StreamState.OPEN or self.is_known:
            return None
        self.is_known = True
        return StreamState(self.state)

    def take_ended(self) -> list[int]:
        """The links of which no more rows come, if nobody knows that yet."""
        if not self.has_ended:
            return []
        self.has_ended = False
        return [rows.link for rows in self.incoming[: self.n_incoming] if rows.take_end()]

    @property
    def is_sent(self) -> bool:
        """Whether the kernel has all that was to be sent."""
        return not self.sending and bool(self.send_to == self.send_from)


@declared("Streams")
class StreamsTable(_WithArrays):
    """All streams of a process."""

    def attend(self) -> None:
        """Who serves them has something else to do."""
        self.attention = 1


@declared("Node")
class NodeTable(Changed):
    """All units of a process."""


@declared("Copy")
class CopyTable(Structure):
    """One of many copies of a system in this process."""


@declared("CopyCall")
class CopyCall(Structure):
    """A getter or setter of one copy, for one variable."""


@declared("Keep")
class Keep(Structure):
    """Memory that each copy has, and what it has to be again."""


@declared("CopyOutput")
class CopyOutput(Structure):
    """Where the rows of one copy have an output."""


class NativeStep(NamedTuple):
    """How an FMU takes a step without Python: the tables of `call_step`.

    Attributes:
        loads: from the row of inputs to buffers of other types.
        lines: the inputs of the row that follow a line; None, if there are none.
        setters: read the row of inputs, or buffers.
        getters: write the rows of `RowBase.OUTPUT` and `RowBase.WATCHED`, or buffers.
        stores: from buffers to these rows.
        kept: what the addresses point to.
        host: the `Host` that runs the FMU; 0: this process does.
        regions: the memory that the addresses point to, for the host.
        share: lets the host map memory of a run, with its path, and its address and size here.
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
    lines: ctypes.Array[Any] | None = None
    host: int = 0
    regions: Sequence[Region] = ()
    share: Callable[[Path | None, int, int], None] | None = None


def table(kind: Any, items: Sequence[Any]) -> Any:  # noqa: ANN401 ctypes has no type for an array of any structure
    """The items as a C array, which may be empty."""
    return (kind * max(len(items), 1))(*items)


_path = load_library()
library: Final = LibraryFunctions(_path) if _path is not None else None
