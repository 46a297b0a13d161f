"""The values that have come by Zenoh keys, beside the first result file of a run: `<file>.keys.jsonl`.

One line for each value: its variable, the point at which its instance took it, the time in s from which on it holds
(null: from that point on), and the value. So a run can be repeated without the keys, however long it was: neither who
writes nor who reads keeps the lines in memory.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from ..errors import ConfigurationError
from ..files import opened, replaced, sha256_of
from ..system.live_keys import KeyValue, RecordedKeys
from ..system.records import IN_MEMORY
from ..text import shown
from ..variables.model_description import Value, Variable
from ..variables.value_conversion import ValueRefused, checked_value

__all__ = ["KEYS_ENDING", "KeysFile", "keys_beside", "recorded_keys", "recorded_values"]

KEYS_ENDING: Final = ".keys.jsonl"


def keys_beside(result: Path) -> Path:
    """The file with the values of keys of a run, by its first result file."""
    return result.with_name(result.name + KEYS_ENDING)


class KeysFile:
    """Writes the values of one run; they are in the file at once, or after `begin`.

    Args:
        result: the first result file. One in memory, or a device, has no such file.
    """

    def __init__(self, result: Path) -> None:
        has_file = result.suffix != IN_MEMORY and (result.is_file() or not result.exists())
        self._path = keys_beside(result) if has_file else None
        self._waiting: list[KeyValue] = []
        self._descriptor: int | None = None
        self._begun = False

    def begin(self) -> str | None:
        """The first rows will follow: the file of an earlier run goes; return the name of the new one, if there is one.

        Raises:
            OSError: it cannot be written.
        """
        if self._begun:
            return None
        self._begun = True
        if self._path is not None and not self._waiting:
            self._path.unlink(missing_ok=True)
        waiting, self._waiting = self._waiting, []
        return self.add(waiting)

    def add(self, values: Sequence[KeyValue]) -> str | None:
        """Add values; return the name of the file if it begins with them. The errors are those of `begin`."""
        if self._path is None or not values:
            return None
        if not self._begun:
            self._waiting += values
            return None
        is_first = self._descriptor is None
        if self._descriptor is None:
            with replaced(self._path) as draft:
                self._descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        left = memoryview(b"".join(msgspec.json.encode(value) + b"\n" for value in values))
        while left:
            left = left[os.write(self._descriptor, left) :]
        return self._path.name if is_first else None

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def recorded_keys(path: Path) -> RecordedKeys:
    """The file with the values of keys of an earlier run.

    Raises:
        ConfigurationError: it cannot be read.
    """
    try:
        return RecordedKeys(str(path.absolute()), sha256_of(path))
    except OSError as error:
        text = f"'{path}' cannot be read: {error.strerror}"
        raise ConfigurationError(
            text, hint="`keys_from` takes the first result of a run with keys, which has this file beside it."
        ) from error


def recorded_values(
    recorded: RecordedKeys, instance: str, variables: Mapping[str, Variable]
) -> Iterator[tuple[str, int, float | None, Value]]:
    """The values for one instance, in their order, by the names of its ``variables`` that get values of keys.

    The last line may be cut off where a run was killed. The file of a run to which nothing has come is `os.devnull`.

    Raises:
        ConfigurationError: the file cannot be read, has changed since the run was planned, or is something else.
    """
    path = Path(recorded.path)
    if recorded.path == os.devnull:
        return
    if recorded_keys(path) != recorded:
        raise ConfigurationError(f"'{path}' has changed since the run was planned", hint="Start the run again.")
    decode = msgspec.json.Decoder(KeyValue).decode
    own = f'["{instance}.'.encode()
    with opened(path) as file:
        for number, line in enumerate(file, start=1):
            if not line.startswith(own):
                continue
            try:
                name, point, time, plain = decode(line)
                variable = variables[name.partition(".")[2]]
                value = checked_value(plain, variable, shown(plain))
            except (msgspec.DecodeError, UnicodeDecodeError, ValueRefused, KeyError) as error:
                if line.endswith(b"\n"):
                    why = f"'{instance}' has no key for {error}" if isinstance(error, KeyError) else error
                    raise ConfigurationError(f"line {number} of '{path}' is no value of a key: {why}") from error
                return
            yield variable.name, point, time, value
