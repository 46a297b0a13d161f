"""Reads the columns of a run back from the messages of its MCAP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema
from numpy.typing import NDArray

from ...files import opened
from ...results.recording import Columns
from ...simtime import ENDLESS, TimeGrid
from ...variables.value_types import DTYPES, VariableType, is_text
from ..messages.cdr import HEADER_SIZE, Codec
from ..messages.definitions import NUMBERS, Basic, MessageTypes, path_parts
from .mcap_layout import TopicColumns
from .mcap_records import McapContent

__all__ = ["read_mcap"]


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
                case Channel() if record.topic in topics:
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


def _value(message: Any, path: Sequence[str | int]) -> Any:  # noqa: ANN401  any field
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
