"""Result formats with a large table: size, time to write, memory, and the time to open one column and all of it.

python -m benchmarks.formats                                       1,000 variables, 100,000 points
python -m benchmarks.formats --points 1000000                      a large one; takes an hour
python -m benchmarks.formats --formats csv parquet --cpu 1         only these, on one processor

Every number is measured in a process of its own, which may take nine tenths of the memory that is free. Only the calls
of the writer count, not the making of the values. HDF5 is not a format of fmu_mesh; it is written with h5py, which
has to be installed, one dataset per variable in chunks of 16384 values. An MCAP has a message for each value, so it
gets fewer points; its row says how many, and is not scaled.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.environment import ROOT
from benchmarks.publishing import Figures, add_write_docs, markdown_table, publish

_BLOCK: Final = 4096
"""Rows of one call: as many as the recorder writes at once."""

_CHUNK: Final = 16384
_MCAP_VALUES: Final = 2_000_000
_STEP_S: Final = 0.001
_TIMEOUT_S: Final = 7200.0
_FORMATS: Final = {
    "csv": ".csv",
    "parquet": ".parquet",
    "mcap": ".mcap",
    "hdf5": ".h5",
    "hdf5-lzf": ".h5",
    "hdf5-gzip": ".h5",
}
_READS: Final = ("pandas, one column", "pandas, all")
_HEADER: Final = (
    "format",
    "points",
    "size",
    "bytes per value",
    "write",
    "million values/s",
    "of it the end",
    "memory",
    *_READS,
)


class _Writer(Protocol):
    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None: ...

    def flush(self) -> None: ...

    def close(self) -> None: ...


class _Hdf5:
    """A dataset per variable, as long as there are rows."""

    def __init__(self, path: Path, names: Sequence[str], compression: str | None) -> None:
        import h5py  # noqa: PLC0415  only for this format

        self._file = h5py.File(path, "w")
        ways = {"compression": compression, "shuffle": compression is not None}
        ways |= {"compression_opts": 1} if compression == "gzip" else {}
        self._sets = [
            self._file.create_dataset(name, (0,), "f8", maxshape=(None,), chunks=(_CHUNK,), **ways)
            for name in ("time", *names)
        ]

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        first = len(self._sets[0])
        for own, column in zip(self._sets, (times, *columns), strict=True):
            own.resize((first + len(times),))
            own[first:] = column

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def _names(variables: int) -> list[str]:
    return [f"y{number}" for number in range(variables)]


def _writer(format_: str, path: Path, variables: int) -> _Writer:
    if format_.startswith("hdf5"):
        return _Hdf5(path, [f"model.{name}" for name in _names(variables)], format_.partition("-")[2] or None)
    from fmu_mesh.config.loading import LoadedConfig, read_text  # noqa: PLC0415  what a format costs counts for it alone
    from fmu_mesh.instances.configuration import examine_data  # noqa: PLC0415  as above
    from fmu_mesh.results.formats import result_format  # noqa: PLC0415  as above
    from fmu_mesh.results.recording import Recording  # noqa: PLC0415  as above
    from fmu_mesh.variables.model_description import ModelDescription, Variable  # noqa: PLC0415  as above

    found = result_format(path)
    assert found is not None
    text = f"mesh: table\nsimulation: {{stop_time: 1.0, step_size: {_STEP_S}}}\ninstances: {{model: {{fmu: A.fmu}}}}\n"
    own = tuple(
        Variable(name, number, "Float64", "output", "continuous", unit="rad")
        for number, name in enumerate(_names(variables))
    )
    description = ModelDescription("model", "model", "3.0", "co_simulation", "", own)
    file = Path("mesh.yaml")
    loaded = LoadedConfig(examine_data(read_text(text, file))[0].config, file)
    recorded = tuple(("model", name) for name in _names(variables))
    return found.open(path, Recording(loaded, {"model": description}, recorded))


def _blocks(variables: int, points: int) -> Iterator[tuple[NDArray[np.float64], list[NDArray[np.float64]]]]:
    """Rows as a simulation gives them: decaying vibrations; every fourth variable holds its value for 100 points."""
    rates = np.linspace(0.5, 20.0, variables)
    held = np.arange(variables) % 4 == 3
    for first in range(0, points, _BLOCK):
        numbers = np.arange(first, min(first + _BLOCK, points))
        times = numbers * _STEP_S
        table = np.sin(times[:, None] * rates) * np.exp(-1e-3 * times)[:, None]
        table[:, held] = np.sin((numbers // 100)[:, None] * rates[held])
        yield times, [table[:, column] for column in range(variables)]


def _write(format_: str, path: Path, variables: int, points: int) -> dict[str, float]:
    before = _peak_mb()
    begin = time.perf_counter()
    writer = _writer(format_, path, variables)
    seconds = time.perf_counter() - begin
    for times, columns in _blocks(variables, points):
        begin = time.perf_counter()
        writer.write(times, columns)
        seconds += time.perf_counter() - begin
    begin = time.perf_counter()
    writer.close()
    end = time.perf_counter() - begin
    size = sum(file.stat().st_size for file in path.parent.glob(f"{path.stem}.*"))
    return {"write": seconds + end, "end": end, "size": size, "memory": _peak_mb() - before}


def _read(format_: str, path: Path, what: str) -> dict[str, float]:
    import pandas as pd  # noqa: PLC0415  only here

    import fmu_mesh  # noqa: PLC0415  only here

    one = what.endswith("one column")
    frame_of: dict[str, Callable[[], Any]] = {
        "csv": lambda: pd.read_csv(path, usecols=["time", "model.y1"] if one else None),
        "parquet": lambda: pd.read_parquet(path, columns=["time", "model.y1"] if one else None, memory_map=True),
        "mcap": lambda: fmu_mesh.Result.read(path).to_pandas().reset_index(),
    }
    before = _peak_mb()
    begin = time.perf_counter()
    frame = frame_of[format_]() if format_ in frame_of else _frame_of_hdf5(path, one=one)
    assert "model.y1" in frame
    return {"seconds": time.perf_counter() - begin, "memory": _peak_mb() - before}


def _frame_of_hdf5(path: Path, *, one: bool) -> Any:  # noqa: ANN401  a data frame
    import h5py  # noqa: PLC0415  only for this format
    import pandas as pd  # noqa: PLC0415  only here

    with h5py.File(path) as file:
        return pd.DataFrame({name: file[name][:] for name in (("time", "model.y1") if one else file)})


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _in_child(*arguments: str) -> dict[str, float] | None:
    """What a process of its own has measured; None if its memory was not enough."""
    command = [sys.executable, "-m", "benchmarks.formats", "--child", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    if done.returncode:
        if "memory" in done.stderr.lower():
            return None
        raise SystemExit(done.stderr)
    answer: dict[str, float] = json.loads(done.stdout)
    return answer


def _child(what: str, format_: str, path: str, variables: str, points: str) -> dict[str, float]:
    fields = (line.split() for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines())
    free = next(int(field[1]) * 1024 for field in fields if field[0] == "MemAvailable:")
    resource.setrlimit(resource.RLIMIT_DATA, (free * 9 // 10, -1))
    if what == "write":
        return _write(format_, Path(path), int(variables), int(points))
    return _read(format_, Path(path), what)


def _row(format_: str, folder: Path, variables: int, points: int) -> tuple[str, ...]:
    points = min(points, _MCAP_VALUES // variables) if format_ == "mcap" else points
    path = folder / f"table{_FORMATS[format_]}"
    arguments = (format_, str(path), str(variables), str(points))
    written = _in_child("write", *arguments)
    assert written is not None  # it writes block by block
    reads = [_in_child(what, *arguments) for what in _READS]
    for file in folder.iterdir():
        file.unlink()
    values = variables * points
    return (
        format_,
        f"{points:,}",
        f"{written['size'] / 1e6:.0f} MB",
        f"{written['size'] / values:.2f}",
        f"{written['write']:.1f} s",
        f"{values / written['write'] / 1e6:.1f}",
        f"{written['end']:.2f} s",
        f"{written['memory']:.0f} MB",
        *(f"{read['seconds']:.2f} s, {read['memory']:.0f} MB" if read else "out of memory" for read in reads),
    )


def main() -> int:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variables", type=int, default=1000)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--formats", nargs="+", choices=_FORMATS, default=[*_FORMATS])
    parser.add_argument("--folder", type=Path, help="where the files go; default: a temporary folder")
    parser.add_argument("--cpu", type=int, help="run on this processor only")
    parser.add_argument("--child", nargs=5, help=argparse.SUPPRESS)
    add_write_docs(parser)
    options = parser.parse_args()
    if options.child is not None:
        print(json.dumps(_child(*options.child)))
        return 0
    if options.cpu is not None:
        os.sched_setaffinity(0, {options.cpu})
    return publish("formats", lambda: _measured(options), write=options.write_docs)


def _measured(options: argparse.Namespace) -> Figures:
    """The table of all formats that can be written here."""
    problems = []
    if any(name.startswith("hdf5") for name in options.formats) and importlib.util.find_spec("h5py") is None:
        problems.append("h5py is not installed; without HDF5: --formats csv parquet mcap")
        options.formats = [name for name in options.formats if not name.startswith("hdf5")]
    rows = []
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        for name in options.formats:
            print(f"writing and reading {name}", file=sys.stderr)
            rows.append(_row(name, Path(folder), options.variables, options.points))
    return Figures(f"{options.variables:,} variables, one round", markdown_table(_HEADER, rows), problems=problems)


if __name__ == "__main__":
    sys.exit(main())
