"""One long run: what its processes have and keep over time, in memory, open files and files of the run."""

from __future__ import annotations

import json
import os
import statistics
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import psutil
import yaml

from benchmarks.chaos_meshes import chain
from benchmarks.publishing import markdown_table
from fmu_mesh.run.state_file import STATE
from tests.helpers import Place

__all__ = ["Sample", "has_grown", "soak"]

_EVERY_S: Final = 0.5
_MOST_S: Final = 3600.0
_SHOWN: Final = 20
_MB: Final = 1e6
_GROWTH: Final = 1.05
"""Flat is what grows by less from the second quarter of a run to the last one, and by less than `_ROOM`."""

_ROOM: Final = (8.0, 2.0, 0.5)
"""What does not count as growth: so many MB of memory, open files, and MB of files."""


@dataclass(frozen=True)
class Sample:
    """What a run has at one time: seconds since the command, PSS, open files, files of the run, and its result.

    And the point of its newest checkpoint; 0 without one.
    """

    at_s: float
    memory_mb: float
    open_files: float
    folder_mb: float
    result_mb: float
    checkpoint: int = 0


def soak(config: str, points: int, options: Sequence[str], file: Path | None) -> int:
    """Run a mesh for so many points, and print the table; 1 if it fails, or something grows.

    Args:
        config: a file; `all`: a chain of four, of which the last output is recorded.
        points: steps of the mesh.
        options: more of `launch`, such as those of `recovering`.
        file: gets all samples as JSON.
    """
    samples: list[Sample] = []
    with Place() as place:
        own = place.folder / "soak.yaml"
        source = Path(config).resolve() if config != "all" else own
        if config == "all":
            content = {"mesh": "soak", **chain(), "record": {"variables": ["delay.y"]}}
            own.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        simulation = yaml.safe_load(source.read_text(encoding="utf-8"))["simulation"]
        stop_time = simulation.get("start_time", 0.0) + points * simulation["step_size"]
        result = place.folder / "result.csv"
        end = time.monotonic() + _MOST_S
        begun = time.monotonic()
        launched = place.start(
            *("launch", source, "--no-progress", "--stop-time", str(stop_time)),
            *("--real-time-factor", "0", "--output", result, *options),
        )
        never = threading.Event()
        while launched.running:
            if time.monotonic() > end:
                print(f"error: it is not done after {_MOST_S:g} s\n{place.story()}")
                return 1
            samples.append(_sample(launched.pid, [place.folder / "run", place.folder / "tmp"], result, begun))
            never.wait(_EVERY_S)
        if launched.wait():
            print(f"error: {launched.story()}")
            return 1
        print(launched.output)
    grown = has_grown(samples)
    shown = samples[:: max(1, len(samples) // _SHOWN)]
    header = ["at, s", "memory (PSS), MB", "open files", "files of the run, MB", "result, MB", "checkpoint"]
    rows = [
        (
            *(f"{s.at_s:.1f}", f"{s.memory_mb:.1f}", f"{s.open_files:g}", f"{s.folder_mb:.2f}", f"{s.result_mb:.0f}"),
            f"{s.checkpoint}",
        )
        for s in shown
    ]
    print(markdown_table(header, rows, texts=0))
    print(f"\n{'; '.join(grown) or 'flat'}")
    if file is not None:
        file.write_text(json.dumps([asdict(sample) for sample in samples], indent=1))
    return int(bool(grown))


def has_grown(samples: Sequence[Sample]) -> list[str]:
    """What has grown from the second quarter of a run to its last one, in words; nothing if all is flat."""
    steady = [sample for sample in samples if sample.result_mb]  # without its start
    quarter = len(steady) // 4
    grown = []
    if not quarter:
        return ["too short to be looked at"]
    for name, room in zip(("memory_mb", "open_files", "folder_mb"), _ROOM, strict=True):
        early, late = (
            statistics.median(getattr(sample, name) for sample in part)
            for part in (steady[quarter : 2 * quarter], steady[-quarter:])
        )
        if late > max(_GROWTH * early, early + room):
            grown.append(f"{name} has grown from {early:.1f} to {late:.1f}")
    return grown


def _sample(pid: int, folders: Sequence[Path], result: Path, begun: float) -> Sample:
    memory = files = 0.0
    with suppress(psutil.Error):
        for process in [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]:
            with suppress(psutil.Error):
                memory += process.memory_full_info().pss
                files += process.num_fds()
    # Unlike `Path.rglob`, `os.walk` bears with folders that are removed meanwhile.
    there = [Path(parent, name) for folder in folders for parent, _, names in os.walk(folder) for name in names]
    size = sum(map(_size, there))
    checkpoint = max((int(own.stem) for own in there if own.suffix == STATE and own.stem.isdecimal()), default=0)
    return Sample(time.monotonic() - begun, memory / _MB, files, size / _MB, _size(result) / _MB, checkpoint)


def _size(path: Path) -> int:
    """What a file takes of the disk, in bytes; 0 if it is gone."""
    with suppress(OSError):
        return path.lstat().st_blocks * 512
    return 0
