"""`python -m benchmarks`: run all jobs with all contestants and print one table."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.environment import ROOT, Peers, loads, machine
from benchmarks.jobs import JOBS, with_checkout
from benchmarks.report import Report, write_docs
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
    parser.add_argument("--write-docs", action="store_true", help="put the tables into docs/performance.md")
    options = parser.parse_args()
    repeat = options.repeat or (2 if options.quick else 5)
    if options.write_docs and (options.only or options.jobs != names):
        parser.error("--write-docs needs all jobs and all contestants")
    if options.against is not None and not (options.against / ".venv" / "bin" / "python").exists():
        parser.error(f"{options.against} has no .venv/bin/python")

    peers = Peers()
    peers.prepare()
    jobs = [job for job in JOBS if job.name in options.jobs]
    if options.against is not None:
        jobs = with_checkout(jobs, options.against)
    before, began = loads(), time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="bench-") as folder,
        Bench(jobs, peers, Path(folder), quick=options.quick, only=options.only or "") as bench,
    ):
        rounds = bench.run(repeat, _QUICK_BUDGET_S if options.quick else _FULL_BUDGET_S)
    versions = ", ".join(f"{name} {number}" for name, number in sorted(bench.versions.items()))
    report = Report(
        jobs,
        bench.results,
        [
            f"{'quick run, ' if options.quick else ''}median of {rounds} interleaved rounds; {machine()}",
            f"{(time.monotonic() - began) / 60:.0f} minutes; load average before {before}, after {loads()}",
            f"versions: {versions}",
        ],
    )
    print(f"\n{report.text()}")
    if options.json is not None:
        options.json.write_text(report.json() + "\n")
    if options.write_docs:
        write_docs(ROOT / "docs" / "performance.md", report)
    for broken in bench.broken:
        print(f"error: {broken}", file=sys.stderr)
    return 1 if bench.broken else 0


if __name__ == "__main__":
    sys.exit(main())
