"""What was measured, as text for the terminal, as Markdown for `docs/performance.md`, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.jobs import Entry, Job, Target
from benchmarks.running import Measured

__all__ = ["Report", "write_docs"]

_BEGIN = "<!-- measured: begin (written by `python -m benchmarks --write-docs`) -->"
_END = "<!-- measured: end -->"
_HEADER = ("contestant", "points", "points/s", "us/point", "spread", "ratio", "at least", "aim", "", "values")

Results = Mapping[str, Mapping[str, Measured]]


class Report:
    """The report of one run of the benchmark; ``about`` are lines on how it was measured."""

    def __init__(self, jobs: Sequence[Job], results: Results, about: Sequence[str]) -> None:
        self._jobs = jobs
        self._results = results
        self._about = about

    def text(self) -> str:
        """For the terminal: one table, a section per job."""
        tables = [(job.title, [_HEADER, *self._rows(job)]) for job in self._jobs]
        widths = [max(len(row[column]) for _, rows in tables for row in rows) for column in range(len(_HEADER))]
        lines = [*self._about]
        for title, rows in tables:
            lines += ["", title]
            lines += ["  " + "  ".join(_aligned(row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, "", *self._target_lines()])

    def markdown(self) -> str:
        """For the documentation."""
        lines = [f"* {line}" for line in self._about]
        for job in self._jobs:
            lines += ["", f"### {job.title[0].upper()}{job.title[1:]}", ""]
            lines += [_markdown_row(_HEADER), _markdown_row(["---"] * len(_HEADER))]
            lines += [_markdown_row(row) for row in self._rows(job)]
        return "\n".join(lines)

    def json(self) -> str:
        """For machines; times in s."""
        jobs: dict[str, Any] = {}
        for job in self._jobs:
            jobs[job.name] = {
                "title": job.title,
                "entries": {
                    label: {
                        "points": measured.points,
                        "instances": measured.instances,
                        "seconds_per_point": [cost * measured.instances for cost in measured.costs],
                        "values": measured.result,
                        "failure": measured.failure,
                    }
                    for label, measured in self._results[job.name].items()
                },
                "targets": [
                    {
                        "entry": target.entry,
                        "against": target.against,
                        "ratio": ratio,
                        "required": target.required,
                        "aim": target.aim,
                        "met": target.meets(ratio) if ratio is not None else None,
                    }
                    for target in job.targets
                    for ratio in [self._ratio(job, target)]
                ],
            }
        return json.dumps({"about": list(self._about), "jobs": jobs}, indent=2)

    def _rows(self, job: Job) -> list[tuple[str, ...]]:
        return [self._row(job, entry) for entry in job.entries]

    def _row(self, job: Job, entry: Entry) -> tuple[str, ...]:
        measured = self._results[job.name][entry.label]
        cost = measured.cost
        if cost is None:
            return (entry.label, *["-"] * 5, *self._target(job, entry), measured.failure or "not run")
        per_point = cost * measured.instances
        spread = f"{_micro(min(measured.costs), measured)}-{_micro(max(measured.costs), measured)}"
        failed = f"; later: {measured.failure}" if measured.failure else ""
        return (
            entry.label,
            f"{measured.points:,}",
            f"{1 / per_point:,.0f}",
            f"{1e6 * per_point:.1f}",
            spread,
            self._ratio_text(job, entry),
            *self._target(job, entry),
            measured.result + failed,
        )

    def _ratio_text(self, job: Job, entry: Entry) -> str:
        """The ratio of this row's target if it has one, else how many times faster the first entry is."""
        for target in job.targets:
            if entry.label == _row_of(target):
                ratio = self._ratio(job, target)
                return f"{ratio:.2f}" if ratio is not None else "-"
        first = job.entries[0]
        if job.system is None or entry is first or entry.label in {target.entry for target in job.targets}:
            return ""
        ratio = self._ratio(job, Target(first.label, entry.label, 1.0, 1.0))
        return f"{ratio:.2f}" if ratio is not None else "-"

    def _target(self, job: Job, entry: Entry) -> tuple[str, str, str]:
        for target in job.targets:
            if entry.label == _row_of(target):
                ratio = self._ratio(job, target)
                sign = "<= " if target.overhead else ""
                verdict = "-" if ratio is None else "PASS" if target.meets(ratio) else "BELOW"
                return f"{sign}{target.required:g}", f"{sign}{target.aim:g}", verdict
        return "", "", ""

    def _ratio(self, job: Job, target: Target) -> float | None:
        own = self._results[job.name][target.entry].cost
        other = self._results[job.name][target.against].cost
        if own is None or other is None:
            return None
        return own / other if target.overhead else other / own

    def _target_lines(self) -> list[str]:
        met = [
            target.meets(ratio)
            for job in self._jobs
            for target in job.targets
            if (ratio := self._ratio(job, target)) is not None
        ]
        return [f"{sum(met)} of {len(met)} required ratios met"]


def write_docs(path: Path, report: Report) -> None:
    """Replace what stands between the markers of the documentation page.

    Raises:
        ValueError: the page has no markers.
    """
    text = path.read_text()
    before, begin, rest = text.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not begin or not end:
        msg = f"{path.name} has no markers for the measured part"
        raise ValueError(msg)
    path.write_text(f"{before}{_BEGIN}\n\n{report.markdown()}\n\n{_END}{after}")


def _row_of(target: Target) -> str:
    """A target stands in the row of the contestant it is measured against, an overhead in its own."""
    return target.entry if target.overhead else target.against


def _micro(cost: float, measured: Measured) -> str:
    return f"{1e6 * cost * measured.instances:.1f}"


def _aligned(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    left = (0, len(_HEADER) - 1)
    return [
        cell.ljust(width) if column in left else cell.rjust(width)
        for column, (cell, width) in enumerate(zip(row, widths, strict=True))
    ]


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
