"""The measured tables of the documentation: when they may be measured, and how they get into their page.

Every figure of speed in the documentation stands in a block, between two comments that name it and the command that
writes it. Each program here measures through `publish`, so that all of them decide alike: with `--write-docs` it waits
for a quiet machine before the first round, and if none comes, it measures and writes nothing.
"""

from __future__ import annotations

import argparse
import datetime as dt
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.environment import ROOT, loads, machine

__all__ = [
    "BLOCKS",
    "PAGE",
    "PATIENCE_S",
    "QUIET_LOAD",
    "Figures",
    "Host",
    "add_write_docs",
    "markdown_table",
    "markers",
    "publish",
    "replace_block",
]

PAGE = ROOT / "docs" / "performance.md"
QUIET_LOAD = 1.0
"""The load average of one minute has to be below this before the first round."""

PATIENCE_S = 300.0
"""So long `publish` waits for a quiet machine."""

_LOOK_S = 5.0

BLOCKS = {
    "jobs": "benchmarks",
    "far": "benchmarks.far",
    "ros topics": "benchmarks.ros_topics",
    "live data": "benchmarks.live_data",
    "floods": "benchmarks.floods",
    "tls": "benchmarks.tls",
    "ssh": "benchmarks.over_ssh",
    "recording": "benchmarks.recording",
    "formats": "benchmarks.formats",
    "scale": "benchmarks.scale",
    "connections": "benchmarks.scale --connections",
    "variables": "benchmarks.scale --variables",
    "arrays": "benchmarks.arrays",
    "sweeps": "benchmarks.sweeps",
    "many variants": "benchmarks.sweeps --memory",
    "imports": "benchmarks.imports",
}
"""The blocks of the page, and the program that writes each of them with `--write-docs`."""


@dataclass(frozen=True)
class Figures:
    """What was measured.

    Attributes:
        about: how it was measured, such as "medians of 3 interleaved rounds".
        tables: as Markdown.
        shown: for the terminal, if that is another text.
        problems: what is wrong, such as values that differ; such figures do not get into the page.
    """

    about: str
    tables: str
    shown: str = ""
    problems: Sequence[str] = ()


@dataclass(frozen=True)
class Host:
    """What waiting for a quiet machine needs; the tests have one of their own.

    Attributes:
        load: the load average of one minute.
        clock: time in s.
        pause: waits for a number of seconds.
    """

    load: Callable[[], float] = lambda: os.getloadavg()[0]
    clock: Callable[[], float] = time.monotonic
    pause: Callable[[float], object] = threading.Event().wait

    def becomes_quiet(self) -> bool:
        """Wait for a load below `QUIET_LOAD`; False if there is none within `PATIENCE_S`."""
        end = self.clock() + PATIENCE_S
        while (load := self.load()) >= QUIET_LOAD:
            if self.clock() >= end:
                return False
            print(f"waiting for a load below {QUIET_LOAD:g}; it is {load:.2f}", file=sys.stderr, flush=True)
            self.pause(_LOOK_S)
        return True


def add_write_docs(parser: argparse.ArgumentParser) -> None:
    """Add the option `--write-docs`."""
    text = f"put the table into docs/{PAGE.name}; waits up to {PATIENCE_S / 60:.0f} minutes for a quiet machine"
    parser.add_argument("--write-docs", action="store_true", help=text)


def publish(
    block: str, measure: Callable[[], Figures], *, write: bool, host: Host | None = None, page: Path = PAGE
) -> int:
    """Measure, print what was measured, and with ``write`` put it into the page.

    Args:
        block: one of `BLOCKS`.
        measure: takes all rounds.
        write: whether the page is written; then the machine has to be quiet first.
        host: where the load is looked at; None: this machine.
        page: the page with the block.

    Returns:
        The exit code: 1 if the machine did not become quiet, if a run failed, or if a figure is wrong.
    """
    host = host or Host()
    if write and not host.becomes_quiet():
        print(
            f"error: the load average is {host.load():.2f} after {PATIENCE_S / 60:.0f} minutes, and has to be below "
            f"{QUIET_LOAD:g}. Nothing was measured, and {page.name} is as it was. End what else runs on this machine.",
            file=sys.stderr,
        )
        return 1
    before = loads()
    try:
        figures = measure()
    except RuntimeError as error:
        print(f"error: {error}. {page.name} is as it was.", file=sys.stderr)
        return 1
    about = (
        f"{figures.about}; {machine()}; {dt.datetime.now(dt.UTC):%Y-%m-%d}, commit {_commit()}; "
        f"load average before {before}, after {loads()}."
    )
    print(f"{about}\n\n{figures.shown or figures.tables}")
    for problem in figures.problems:
        print(f"error: {problem}", file=sys.stderr)
    if figures.problems:
        return 1
    if write:
        replace_block(page, block, f"{about}\n\n{figures.tables}")
    return 0


def markers(block: str) -> tuple[str, str]:
    """The comments before and after a block."""
    command = f"python -m {BLOCKS[block]} --write-docs"
    return f"<!-- {block}: begin (written by `{command}`) -->", f"<!-- {block}: end -->"


def replace_block(page: Path, block: str, new: str) -> None:
    """Replace what stands between the markers of a block.

    Raises:
        ValueError: the page has no such markers.
    """
    first, last = markers(block)
    before, begin, rest = page.read_text(encoding="utf-8").partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        msg = f"{page.name} has no markers of the block '{block}'"
        raise ValueError(msg)
    page.write_text(f"{before}{first}\n\n{new}\n\n{last}{after}", encoding="utf-8")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]], *, texts: int = 1) -> str:
    """A table whose first columns, ``texts`` of them, are text, and the others numbers."""
    alignment = ["---" if column < texts else "---:" for column in range(len(header))]
    lines = [" | ".join(header), " | ".join(alignment), *(" | ".join(map(str, row)) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines)


def _commit() -> str:
    """The commit that is measured, and whether code was changed since."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    if head.returncode:
        return "unknown"
    changes = [*git, "status", "--porcelain", "--untracked-files=no", "--", "fmu_mesh", "benchmarks"]
    changed = subprocess.run(changes, capture_output=True, text=True, check=False).stdout
    return head.stdout.strip() + (" with changes" if changed else "")
