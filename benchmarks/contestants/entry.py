"""The entry of a contestant's process: read the task, run, print the outcome as one JSON line."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
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

__all__ = ["FMUS", "main", "nodes", "versions"]

FMUS = Path(__file__).resolve().parents[2] / "fmus"
_DEADLINE_S = 30.0


def main(run: Callable[[Task], Outcome]) -> None:
    """Run the task that the command line names."""
    outcome = run(Task.from_json(Path(sys.argv[1]).read_text()))
    print(json.dumps(dataclasses.asdict(outcome)), flush=True)


def versions(*packages: str) -> dict[str, str]:
    """The installed versions of these packages."""
    return {package: version(package) for package in packages}


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
