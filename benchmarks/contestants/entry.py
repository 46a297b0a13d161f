"""The entry of a contestant's process: read the task, run, print the outcome as one JSON line."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import multiprocessing
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.task import Outcome, Task

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["FMUS", "compiled", "main", "nodes", "versions"]

_ROOT = Path(__file__).resolve().parents[2]
FMUS = _ROOT / "fmus"
_DEADLINE_S = 30.0


def main(run: Callable[[Task], Outcome]) -> None:
    """Run the task that the command line names."""
    outcome = run(Task.from_json(Path(sys.argv[1]).read_text()))
    print(json.dumps(dataclasses.asdict(outcome)), flush=True)


def versions(*packages: str) -> dict[str, str]:
    """The installed versions of these packages."""
    return {package: version(package) for package in packages}


def compiled(source: Path, *flags: str) -> tuple[Path, dict[str, str]]:
    """The program of one C file, and the version of the compiler. It is built once and kept under `build/`.

    Raises:
        RuntimeError: there is no C compiler, or it refuses the file.
    """
    compiler = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
    if compiler is None:
        msg = "there is no C compiler"
        raise RuntimeError(msg)
    about = subprocess.run([compiler, "--version"], check=True, capture_output=True, text=True).stdout.splitlines()[0]
    sources = [source, *sorted(source.parent.glob("*.h"))]
    digest = hashlib.sha256(repr((about, flags, [file.read_bytes() for file in sources])).encode()).hexdigest()[:12]
    program = _ROOT / "build" / "bench-programs" / f"{source.stem}-{digest}"
    if not program.exists():
        program.parent.mkdir(parents=True, exist_ok=True)
        draft = program.with_name(f"{program.name}.{os.getpid()}")
        command = [compiler, "-std=gnu11", "-O2", "-o", str(draft), str(source), *flags]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            msg = f"{source.name} does not compile: {done.stderr.strip()}"
            raise RuntimeError(msg)
        draft.replace(program)
    return program, {"cc": about}


@contextmanager
def nodes(target: Callable[..., None], arguments: Sequence[tuple[Any, ...]]) -> Iterator[list[Connection]]:
    """One fresh process per element of ``arguments``; each calls ``target(pipe, *arguments)``.

    The processes end with this one, whatever happens.
    """
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    for own in arguments:
        here, there = context.Pipe()
        process = context.Process(target=target, args=(there, *own), daemon=True)
        process.start()
        there.close()
        pipes.append(here)
        processes.append(process)
    try:
        yield pipes
        for process in processes:
            process.join(_DEADLINE_S)
    finally:
        for process in processes:
            process.kill()
