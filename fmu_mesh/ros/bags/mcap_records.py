"""What is in the MCAP of a run, also without its end: reads its columns, and finishes it after its writer was killed.

A run writes messages in chunks, in the order of their rows; the sequence number of a message is the point of its row.
`mcap_layout` says which metadata records there are.

Only this module knows the records of MCAP; writing a file that is not interrupted is up to `mcap.writer`.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk
from numpy.typing import NDArray

from ...errors import ConfigurationError
from ...files import Kept, decoded_json, opened
from ...results.recording import Columns, metadata_in, with_notes
from ...ros_wire.cdr import HEADER_SIZE, Codec
from ...ros_wire.definitions import NUMBERS, Basic, MessageTypes, Part, path_parts
from ...simtime import ENDLESS, TimeGrid
from ...variables.value_types import DTYPES, VariableType, is_text
from .mcap_layout import NOTE, RECORDING, ROWS, RecordedMcap, TopicColumns

__all__ = ["end_of_rows", "finish_mcap", "read_mcap"]

_MAGIC: Final = b"\x89MCAP0\r\n"
_HEAD: Final = struct.Struct("<BQ")


def finish_mcap(path: Path, kept: Kept) -> int:
    """Cut a file off after its last whole row, and write its end; return the number of its rows.

    Nobody is writing the file any more. If it has its end, it stays as it is. Rows in ``kept`` are known to be there.

    Raises:
        ConfigurationError: it is not the MCAP of a run.
        OSError: it cannot be written.
    """
    with path.open("r+b") as file:
        if not os.fstat(file.fileno()).st_size:
            return 0
        content = McapContent(file, path)
        if content.rows is not None:
            return content.rows
        rows, changed = content.whole_rows()
        if not rows:
            file.truncate(0)
            return 0
        rows = max(rows, kept.rows)
        _write_end(file, content, rows, changed)
    return rows


def end_of_rows(path: Path) -> int:
    """Where the end of a finished file begins, in bytes: more rows can be written there.

    Raises:
        ConfigurationError: it is not the MCAP of a run.
        OSError: it cannot be read.
    """
    with opened(path) as file:
        content = McapContent(file, path)
        return max(offset for offset, _, note in content.notes if note.name == ROWS)


def read_mcap(path: Path) -> Columns:
    """Read the columns of a run; of a file without its end the rows that are complete.

    Raises:
        ConfigurationError: it is not the MCAP of a run.
        OSError: it cannot be read.
    """
    with opened(path) as file:
        content = McapContent(file, path)
        channels = _channels(content)
        rows = content.rows if content.rows is not None else content.whole_rows()[0]
    recording = content.recording
    first, every = recording.first, recording.every
    grid = TimeGrid(recording.start_time, recording.step_size, ENDLESS)
    times = grid.times(first, first + rows * every)[::every]
    types = {column.name: column.type for column in recording.columns}
    found: dict[str, NDArray[Any]] = {}
    for channel in channels:
        found |= channel.columns(times, types, first, every)
    units = {column.name: column.unit for column in recording.columns if column.unit is not None}
    return Columns(times, {name: found[name] for name in types}, units, content.metadata)


class _PlacedChunk(ChunkIndex):
    """The index of a chunk, and the number of messages of each channel in it."""

    def __init__(self, offset: int, length: int, chunk: Chunk) -> None:
        super().__init__(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
        self.counts: Counter[int] = Counter()

    def add(self, index: MessageIndex, offset: int, length: int) -> None:
        """Add the next message index."""
        self.message_index_offsets[index.channel_id] = offset
        self.message_index_length += length
        self.counts[index.channel_id] = len(index.records)


class McapContent:
    """The complete records of an MCAP that a run has written, or is writing.

    Attributes:
        notes: (offset, length, metadata record) of each.
        rows: the number of rows; None if the file has no end.
        metadata: of the run, with what was noted.

    Raises:
        ConfigurationError: it is not the MCAP of a run.
    """

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self.file = file
        self.chunks: list[_PlacedChunk] = []
        self.notes: list[tuple[int, int, Metadata]] = []
        self._is_finished = False
        self._size = os.fstat(file.fileno()).st_size
        file.seek(0)
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ConfigurationError(f"'{path}' is no result file: it does not begin as an MCAP does.")
        for offset, opcode, length in self._heads():
            self._look(offset, opcode, length)
        records = [(note.name, note.metadata) for _, _, note in self.notes]
        about = next((record for name, record in records if name == RECORDING), None)
        if about is None:
            hint = "Was it recorded by this version? `fmu-mesh play` reads all bags."
            text = f"'{path}' is no result file: it does not say which variables are in its topics."
            raise ConfigurationError(text, hint=hint)
        self.recording = decoded_json(about["recording"], RecordedMcap)
        entries = [decoded_json(record["entry"], dict[str, Any]) for name, record in records if name == NOTE]
        self.metadata = with_notes(metadata_in(about["metadata"]), entries)
        rows = [int(record["rows"]) for name, record in records if name == ROWS]
        self.rows = rows[-1] if rows and self._is_finished else None

    def records_of(self, placed: _PlacedChunk) -> list[McapRecord]:
        """The schemas, channels and messages of a chunk."""
        self.file.seek(placed.chunk_start_offset + _HEAD.size)
        return breakup_chunk(Chunk.read(self._record(placed.chunk_length)), validate_crc=True)

    def whole_rows(self) -> tuple[int, int]:
        """The number of whole rows, and the index of the first chunk that has messages of another one."""
        names: dict[int, str] = {}
        if self.chunks:
            first = self.records_of(self.chunks[0])
            names = {record.id: record.topic for record in first if isinstance(record, Channel)}
        last: int | None = None
        there: set[str] = set()
        changed = index = len(self.chunks)
        while index:
            index -= 1
            messages = [record for record in self.records_of(self.chunks[index]) if isinstance(record, Message)]
            last = messages[-1].sequence if last is None else last
            own = [message for message in messages if message.sequence == last]
            there |= {names[message.channel_id] for message in own}
            changed = index if own else changed
            if len(own) < len(messages):
                break
        if last is None:
            return 0, 0
        row = (last - self.recording.first) // self.recording.every
        if there == self.recording.due(row):
            return row + 1, len(self.chunks)
        return row, changed

    def _heads(self) -> Iterator[tuple[int, int, int]]:
        """Offset, opcode and length of every complete record of the data."""
        offset = len(_MAGIC)
        while offset + _HEAD.size <= self._size:
            self.file.seek(offset)
            opcode, length = _HEAD.unpack(self.file.read(_HEAD.size))
            if opcode == Opcode.DATA_END:
                self.file.seek(-len(_MAGIC), os.SEEK_END)
                self._is_finished = self.file.read() == _MAGIC
                return
            if offset + _HEAD.size + length > self._size:
                return
            yield offset, opcode, _HEAD.size + length
            offset += _HEAD.size + length

    def _look(self, offset: int, opcode: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            self.chunks.append(_PlacedChunk(offset, length, Chunk.read(self._record(length))))
        elif opcode == Opcode.MESSAGE_INDEX:
            self.chunks[-1].add(MessageIndex.read(self._record(length)), offset, length)
        elif opcode == Opcode.METADATA:
            self.notes.append((offset, length, Metadata.read(self._record(length))))

    def _record(self, length: int) -> ReadDataStream:
        """The content of the record whose head was read last."""
        return ReadDataStream(io.BytesIO(self.file.read(length - _HEAD.size)))


def _channels(content: McapContent) -> list[_ChannelReader]:
    """The messages of all topics with columns."""
    types = MessageTypes(content.recording.distribution)
    topics = {topic.name: topic for topic in content.recording.topics}
    schemas: dict[int, str] = {}
    channels: dict[int, _ChannelReader] = {}
    for chunk in content.chunks:
        for record in content.records_of(chunk):
            match record:
                case Message():
                    if record.channel_id in channels:
                        channels[record.channel_id].add(record)
                case Schema():
                    types.define(record.name, record.data.decode())
                    schemas[record.id] = record.name
                case Channel() if record.topic in topics and record.id not in channels:  # who resumes writes it again
                    channels[record.id] = _ChannelReader(topics[record.topic], types, schemas[record.schema_id])
    return list(channels.values())


class _ChannelReader:
    """Collects the values of one topic."""

    def __init__(self, topic: TopicColumns, types: MessageTypes, message: str) -> None:
        self._fields = [(path_parts(path), columns) for path, columns in topic.fields]
        self._codec = Codec(types, message)
        self._plain = _plain_dtype(types, message) if [path for path, _ in topic.fields] == ["data"] else None
        self._points: list[int] = []
        self._stamps: list[int] = []
        self._data: list[bytes] = []

    def add(self, message: Message) -> None:
        """Take the next message."""
        self._points.append(message.sequence)
        self._stamps.append(message.log_time)
        self._data.append(message.data)

    def columns(
        self, times: NDArray[np.float64], types: dict[str, VariableType], first: int, every: int
    ) -> dict[str, NDArray[Any]]:
        """Its columns, in which a value holds until the next message; corrects ``times`` where its stamps differ."""
        own = (np.array(self._points, np.int64) - first) // every
        known = own < len(times)
        stamps = np.array(self._stamps, np.float64)[known] / 1e9
        wrong = np.abs(times[own[known]] - stamps) > 1e-9 + np.spacing(stamps)
        times[own[known][wrong]] = stamps[wrong]
        held = np.searchsorted(own, np.arange(len(times)), side="right") - 1
        found: dict[str, NDArray[Any]] = {}
        if self._plain is not None:
            [(_, (name,))] = self._fields
            values = np.frombuffer(b"".join(self._data), self._plain)["data"]
            return {name: values.astype(DTYPES[types[name]])[held]}
        messages = [self._codec.decode(data) for data in self._data]
        for path, names in self._fields:
            found |= _field_columns([_value(message, path) for message in messages], names, types, held)
        return found


def _field_columns(
    values: list[Any], names: Sequence[str], types: dict[str, VariableType], held: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """The columns of one field: of an array one for each element."""
    type_ = types[names[0]]
    if is_text(type_):
        texts = np.empty(len(values), object)
        texts[:] = [value if isinstance(value, str) else np.asarray(value, np.uint8).tobytes() for value in values]
        return {names[0]: texts[held]}
    table = np.array(values).reshape(len(values), len(names)).astype(DTYPES[type_])
    return dict(zip(names, np.ascontiguousarray(table[held].T), strict=True))


def _value(message: Any, path: Sequence[Part]) -> Any:  # noqa: ANN401  any field
    for part in path:
        message = message[part]
    return message


def _plain_dtype(types: MessageTypes, message: str) -> np.dtype[Any] | None:
    """How numpy reads messages that have a single number, such as std_msgs/msg/Float64; None for others."""
    match types.fields(message):
        case (("data", Basic(kind)),) if kind in NUMBERS:
            number = np.dtype(kind)
            size = HEADER_SIZE + number.itemsize
            return np.dtype({"names": ["data"], "formats": [number], "offsets": [HEADER_SIZE], "itemsize": size})
    return None


def _write_end(file: BinaryIO, content: McapContent, rows: int, changed: int) -> None:
    """Write the end of a file after its whole rows; from the chunk ``changed`` on there are messages of another row."""
    # The last chunk is always written again: its message indexes may be missing.
    first = min(changed, len(content.chunks) - 1)
    end = content.recording.first + rows * content.recording.every  # the point of the first row that is left out
    records = [r for r in content.records_of(content.chunks[first]) if not isinstance(r, Message) or r.sequence < end]
    registered = [record for record in content.records_of(content.chunks[0]) if not isinstance(record, Message)]
    kept, start = content.chunks[:first], content.chunks[first].chunk_start_offset
    notes = [(offset, length, note) for offset, length, note in content.notes if offset < start]
    later = [note for offset, _, note in content.notes if offset > start and note.name != ROWS]
    file.seek(start)
    file.truncate()
    out = RecordBuilder()
    if any(isinstance(record, Message) for record in records):
        kept.append(_write_chunk(file, records))
    for note in (*later, Metadata(ROWS, {"rows": str(rows)})):
        offset = file.tell()
        note.write(out)
        notes.append((offset, out.count, note))
        file.write(_taken(out))
    DataEnd(0).write(out)
    file.write(_taken(out))
    _write_summary(file, registered, kept, notes)


def _write_chunk(file: BinaryIO, records: Sequence[McapRecord]) -> _PlacedChunk:
    """Write a chunk, and its message indexes."""
    out = RecordBuilder()
    indexes: dict[int, MessageIndex] = {}
    for record in records:
        if isinstance(record, Message):
            index = indexes.setdefault(record.channel_id, MessageIndex(record.channel_id, []))
            index.records.append((record.log_time, out.count))
        record.write(out)
    data = _taken(out)
    stamps = [stamp for index in indexes.values() for stamp, _ in index.records]
    chunk = Chunk("", data, max(stamps), min(stamps), zlib.crc32(data), len(data))
    offset = file.tell()
    chunk.write(out)
    placed = _PlacedChunk(offset, out.count, chunk)
    file.write(_taken(out))
    for index in indexes.values():
        offset = file.tell()
        index.write(out)
        placed.add(index, offset, out.count)
        file.write(_taken(out))
    return placed


def _write_summary(
    file: BinaryIO,
    registered: Sequence[McapRecord],
    chunks: Sequence[_PlacedChunk],
    notes: Sequence[tuple[int, int, Metadata]],
) -> None:
    """Write what `mcap.writer` writes at the end: the summary, its offsets and the footer."""
    schemas = [record for record in registered if isinstance(record, Schema)]
    channels = [record for record in registered if isinstance(record, Channel)]
    counts = sum((placed.counts for placed in chunks), Counter[int]())
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(channels),
        channel_message_counts=dict(counts),
        chunk_count=len(chunks),
        message_count=counts.total(),
        message_end_time=max(placed.message_end_time for placed in chunks),
        message_start_time=min(placed.message_start_time for placed in chunks),
        metadata_count=len(notes),
        schema_count=len(schemas),
    )
    groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
        (Opcode.SCHEMA, schemas),
        (Opcode.CHANNEL, channels),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, chunks),
        (Opcode.METADATA_INDEX, [MetadataIndex(offset, length, note.name) for offset, length, note in notes]),
    ]
    start, out, offsets = file.tell(), RecordBuilder(), []
    for opcode, records in groups:
        first = out.count
        for record in records:
            record.write(out)
        offsets.append(SummaryOffset(opcode, start + first, out.count - first))
    offsets_start = start + out.count
    for offset in offsets:
        offset.write(out)
    summary = _taken(out)
    crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start), zlib.crc32(summary))
    Footer(start, offsets_start, crc).write(out)
    file.write(summary + _taken(out) + _MAGIC)


def _taken(out: RecordBuilder) -> bytes:
    """What was written; afterwards nothing is."""
    data: bytes = out.end()  # type: ignore[no-untyped-call]  # mcap leaves its type open
    return data
