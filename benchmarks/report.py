"""What was measured, as text for the terminal, as Markdown for `docs/performance.md`, and as JSON."""

from __future__ import annotations

import dataclasses
import json
import statistics
from collections.abc import Mapping, Sequence

from benchmarks.jobs import OTHER, Entry, Job
from benchmarks.running import Measured
from benchmarks.targets import TARGETS, Target

__all__ = ["Report"]

_STEPS = ("points", "points/s", "us/point", "spread", "ratio", "values")
_COMMANDS = ("s", "spread", "ratio", "values")
_WATCHED = (
    "first point, s",
    "end, s",
    "spread",
    "ratio",
    "processes",
    "MB, private",
    "MB, PSS",
    "MB per node",
    "values",
)
_TARGETS = ("figure", "measured", "at least", "aim", "")

Results = Mapping[str, Mapping[str, Measured]]
Row = tuple[str, ...]


class Report:
    """The report of one run of the benchmark.

    Args:
        jobs: what ran.
        results: by job name, then by entry label.
        about: lines on how it was measured.
        targets: what our own figures should be; those of other jobs are left out.
    """

    def __init__(
        self, jobs: Sequence[Job], results: Results, about: Sequence[str], targets: Sequence[Target] = TARGETS
    ) -> None:
        self._jobs = jobs
        self._results = results
        self._about = about
        self._targets = [
            target
            for target in targets
            if all(label in results.get(target.job, {}) for label in (target.entry, target.against) if label)
        ]

    def text(self) -> str:
        """For the terminal: the targets, and a table per job."""
        lines = [*self._about]
        for title, rows in self._tables():
            widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
            lines += ["", title]
            lines += ["  " + "  ".join(_aligned(row, widths)).rstrip() for row in rows]
        return "\n".join(lines)

    def markdown(self) -> str:
        """For the documentation."""
        lines = [*self._about]
        for title, (header, *rows) in self._tables():
            lines += ["", f"### {title[0].upper()}{title[1:]}", ""]
            lines += [_markdown_row(header), _markdown_row(["---", *["---:"] * (len(header) - 2), "---"])]
            lines += [_markdown_row(row) for row in rows]
        return "\n".join(lines)

    def json(self) -> str:
        """For machines; times in s."""
        jobs = {
            job.name: {
                "title": job.title,
                "timed": job.timed,
                "entries": {label: dataclasses.asdict(measured) for label, measured in self._results[job.name].items()},
            }
            for job in self._jobs
        }
        targets = [
            {**dataclasses.asdict(target), "value": value, "met": None if value is None else target.meets(value)}
            for target in self._targets
            for value in [self.value_of(target)]
        ]
        return json.dumps({"about": list(self._about), "jobs": jobs, "targets": targets}, indent=2)

    def value_of(self, target: Target) -> float | None:
        """The figure of a target; None if it was not measured."""
        own = self._results[target.job][target.entry]
        match target.figure:
            case "first point, s":
                return own.first_point_s
            case "MB per node":
                return own.node_mb
        other = self._results[target.job][target.against]
        if own.cost is None or other.cost is None:
            return None
        if target.figure == "times as fast":
            return other.cost / own.cost
        each = other.instances / own.instances if target.figure == "times as long, each" else 1.0
        return own.cost / other.cost * each

    def _tables(self) -> list[tuple[str, list[Row]]]:
        """Title, header and rows of each table."""
        tables = [(job.title, [_header(job), *(self._row(job, entry) for entry in job.entries)]) for job in self._jobs]
        if self._targets:
            tables.insert(0, ("our targets", [_TARGETS, *map(self._target_row, self._targets)]))
        return tables

    def _target_row(self, target: Target) -> Row:
        value = self.value_of(target)
        sign = "" if target.more_is_better else "<= "
        verdict = "-" if value is None else "PASS" if target.meets(value) else "BELOW"
        return (
            f"{target.what} ({target.figure.removesuffix(', each')})",
            "-" if value is None else _number(value),
            f"{sign}{target.required:,}",
            f"{sign}{target.aim:,}",
            verdict,
        )

    def _row(self, job: Job, entry: Entry) -> Row:
        measured = self._results[job.name][entry.label]
        if measured.cost is None:
            return (entry.label, *["-"] * (len(_header(job)) - 2), measured.failure or "not run")
        values = measured.result + (f"; {measured.failed} more: {measured.failure}" if measured.failed else "")
        ratio = self._ratio(job, entry, measured.cost)
        if job.timed == "commands":
            spread = f"{min(measured.costs):.2f}-{max(measured.costs):.2f}"
            return (
                entry.label,
                *_first_point(job, measured),
                f"{measured.cost:.2f}",
                spread,
                ratio,
                *_memory(job, measured),
                values,
            )
        spread = f"{_number(1e6 * min(measured.costs))}-{_number(1e6 * max(measured.costs))}"
        figures = (f"{measured.points:,}", f"{1 / measured.cost:,.0f}", _number(1e6 * measured.cost), spread)
        return (entry.label, *figures, ratio, values)

    def _ratio(self, job: Job, entry: Entry, cost: float) -> str:
        """How many times as long it takes as the row that it is compared with."""
        own = entry.beside or job.entries[0].label
        base = entry.label.removesuffix(OTHER) if entry.label.endswith(OTHER) else own
        compared = self._results[job.name][base].cost
        return "" if base == entry.label or compared is None else f"{cost / compared:.2f}"


def _header(job: Job) -> Row:
    return (job.rows, *(_WATCHED if job.watched else _COMMANDS if job.timed == "commands" else _STEPS))


def _first_point(job: Job, measured: Measured) -> Row:
    if not job.watched:
        return ()
    return ("-" if measured.first_point_s is None else f"{measured.first_point_s:.2f}",)


def _memory(job: Job, measured: Measured) -> Row:
    """Medians of what was seen of the processes."""
    if not job.watched:
        return ()
    if not measured.started:
        return ("-",) * 4
    names = ("processes", "private_mb", "pss_mb")
    medians = [statistics.median(getattr(started, name) for started in measured.started) for name in names]
    return (*(f"{median:,.0f}" for median in medians), f"{measured.node_mb or 0.0:.1f}")


def _number(value: float) -> str:
    """With three digits or more."""
    return (
        f"{value:,.0f}" if value >= 1000 else f"{value:.1f}" if value >= 100 else f"{value:.{2 if value >= 1 else 3}f}"
    )


def _aligned(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    """The first and the last column begin left, the others end right."""
    last = len(row) - 1
    return [
        cell.ljust(width) if column in (0, last) else cell.rjust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
