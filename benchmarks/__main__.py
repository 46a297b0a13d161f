"""`python -m benchmarks`: run all jobs with all contestants and print one table."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.environment import Peers
from benchmarks.jobs import JOBS, Job, with_checkout
from benchmarks.publishing import Figures, add_write_docs, publish
from benchmarks.report import Report
from benchmarks.running import Bench

_QUICK_BUDGET_S = 285.0
_FULL_BUDGET_S = 1140.0


def main() -> int:
    """Run; 1 if one of our own results is not the reference's."""
    names = [job.name for job in JOBS]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="fmu_mesh and its peers on the same FMUs")
    parser.add_argument("--quick", action="store_true", help="fewer points for slow contestants; below 5 minutes")
    parser.add_argument("--jobs", nargs="+", choices=names, default=names, metavar="JOB", help=f"of {', '.join(names)}")
    parser.add_argument("--only", metavar="TEXT", help="only contestants whose module or label contains this")
    parser.add_argument("--repeat", type=int, metavar="N", help="interleaved rounds (default: 5, quick: 2)")
    parser.add_argument(
        "--against", type=Path, metavar="FOLDER", help="also run fmu_mesh of another checkout, which has a .venv"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the measurements to this file")
    add_write_docs(parser)
    options = parser.parse_args()
    if options.write_docs and (options.only or options.jobs != names):
        parser.error("--write-docs needs all jobs and all contestants")
    if options.against is not None and not (options.against / ".venv" / "bin" / "python").exists():
        parser.error(f"{options.against} has no .venv/bin/python")

    peers = Peers()
    peers.prepare()
    jobs = [job for job in JOBS if job.name in options.jobs]
    if options.against is not None:
        jobs = with_checkout(jobs, options.against)
    return publish("jobs", lambda: _measured(jobs, peers, options), write=options.write_docs)


def _measured(jobs: Sequence[Job], peers: Peers, options: argparse.Namespace) -> Figures:
    """The tables of all jobs; our own results that are not the reference's are problems."""
    began, repeat = time.monotonic(), options.repeat or (2 if options.quick else 5)
    with (
        tempfile.TemporaryDirectory(prefix="bench-") as folder,
        Bench(jobs, peers, Path(folder), quick=options.quick, only=options.only or "") as bench,
    ):
        rounds = bench.run(repeat, _QUICK_BUDGET_S if options.quick else _FULL_BUDGET_S)
    versions = ", ".join(f"{name} {number}" for name, number in sorted(bench.versions.items()))
    report = Report(jobs, bench.results, [f"Versions: {versions}."])
    if options.json is not None:
        options.json.write_text(report.json() + "\n")
    minutes = (time.monotonic() - began) / 60
    about = (
        f"{'Quick run, medians' if options.quick else 'Medians'} of {rounds} interleaved rounds, {minutes:.0f} minutes"
    )
    return Figures(about, report.markdown(), report.text(), bench.broken)


if __name__ == "__main__":
    sys.exit(main())
