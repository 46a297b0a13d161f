"""Kills, stops and delays processes of a mesh at random, and compares what comes out with the undisturbed result.

Run it with `python -m benchmarks.chaos CONFIG`, or with `all` for one mesh of each kind. The mesh runs once
undisturbed, and then again and again with `--restarts`, or with checkpoints, until so many faults were given. Every
result has to have the bytes of the undisturbed one. Each row of the table is one kind of fault. A time is that from the
fault to the first row beyond those that the file had when the recorder was gone (of a stop or a delay: from its end).
It is also given as a multiple of the time from the command to the first row of the same run.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from benchmarks.chaos_meshes import LASTS_S, Mesh, mesh_of, written_meshes
from benchmarks.cutting import CUT, cut_apart, why_no_cuts
from benchmarks.disturbing import (
    EVERYBODY,
    FAULTS,
    GATEWAY,
    RESUME,
    ROLES,
    Disturbed,
    Given,
    Undisturbed,
    disturbed,
    drawn_faults,
    recovering,
    undisturbed,
)
from benchmarks.publishing import markdown_table
from benchmarks.soak import soak

__all__ = ["main"]

_SOAK_RESTARTS = 3
_IN_VAIN = 10
"""So many runs in a row may end before any of their faults; then the mesh is too short for them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Disturb, and print what came of it; 1 if any result is another one, or something was left."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.chaos", description=__doc__.split("\n", 1)[0])
    parser.add_argument("config", metavar="CONFIG", help="a configuration file; all: one mesh of each kind")
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="how many faults of any kind (100)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="decides kind, role and moment of each (1)")
    parser.add_argument(
        "--roles",
        nargs="+",
        choices=(*ROLES, GATEWAY, EVERYBODY),
        default=ROLES,
        help="what is disturbed; fork: the fork server",
    )
    parser.add_argument(
        "--faults",
        nargs="+",
        choices=(*FAULTS, RESUME, CUT),
        default=(*FAULTS, RESUME, CUT),
        help="what is done (all of them); resume: `launch` is killed, alone or with all, and resumed",
    )
    parser.add_argument("--per-run", type=int, default=3, metavar="N", help="faults in one run (3)")
    parser.add_argument(
        "--while-coming-back", type=float, default=0.0, metavar="P", help="probability of a kill after a kill (0)"
    )
    parser.add_argument(
        "--lasts", type=float, default=LASTS_S, metavar="S", help=f"a run of CONFIG is paced for this ({LASTS_S:g} s)"
    )
    parser.add_argument(
        "--with", action="append", default=[], dest="values", metavar="KEY=VALUE", help="`--set-config` of all runs"
    )
    parser.add_argument(
        "--checkpoints",
        type=float,
        metavar="S",
        help="begin again from checkpoints, one every S seconds (from the first point)",
    )
    parser.add_argument("--soak", type=int, metavar="POINTS", help="instead: one run of so many points, undisturbed")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all runs and faults to this file")
    options = parser.parse_args(arguments)
    values = [part for value in options.values for part in ("--set-config", value)]
    with tempfile.TemporaryDirectory(prefix="chaos-") as folder, _ended_by_sigterm():
        try:
            if options.soak:
                own = [*recovering(_SOAK_RESTARTS, options.checkpoints), *values]
                return soak(options.config, options.soak, own, options.json)
            runs = _runs(options, values, Path(folder))
        except KeyboardInterrupt:
            return 130
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    print(_table(runs))
    if options.json is not None:
        options.json.write_text(json.dumps({"seed": options.seed, "runs": [asdict(run) for run in runs]}, indent=1))
    return int(any(run.problem for run in runs))


def _runs(options: argparse.Namespace, values: Sequence[str], folder: Path) -> list[Disturbed]:
    """Run until all faults were given.

    Raises:
        RuntimeError: a mesh cannot run undisturbed, or ends too soon to be disturbed.
    """
    kinds = [kind for kind in options.faults if kind != CUT]
    if CUT in options.faults and (reason := why_no_cuts()):
        print(f"left out: cuts of a network: {reason}", flush=True)
    elif CUT in options.faults:
        kinds.append(CUT)
    if not kinds:
        raise RuntimeError("there is nothing left to do")
    everything = options.config == "all"
    meshes = list(written_meshes(folder)) if everything else [mesh_of(Path(options.config), options.lasts)]
    runs: list[Disturbed] = []
    known: dict[str, Undisturbed] = {}
    left, in_vain = options.kills, 0
    for number, (mesh, variant) in enumerate(_in_turn(meshes, random.Random(options.seed))):  # noqa: S311  an order
        own = [*variant, *values]
        if mesh.name not in known:
            print(f"{mesh.name}: undisturbed", flush=True)
            known[mesh.name] = undisturbed(mesh, values)
        expected = known[mesh.name]
        chance = random.Random(f"{options.seed} {number}")  # noqa: S311  faults
        count = min(options.per_run, left)
        if CUT in kinds and chance.random() < 1 / len(kinds):  # for cuts, a mesh runs on two hosts
            run = cut_apart(mesh, expected, chance, count, number)
        else:
            own_kinds = [kind for kind in kinds if kind != CUT]
            faults = drawn_faults(chance, count, own_kinds, options.roles, options.while_coming_back)
            run = disturbed(mesh, own, expected, faults, number, options.checkpoints)
        runs.append(run)
        left -= len(run.given)
        in_vain = 0 if run.given or run.problem else in_vain + 1
        gave = ", ".join(f"{given.label} at row {given.row}" for given in run.given) or "no fault"
        print(f"run {number}: {mesh.name} {' '.join(run.options)}: {gave}: {run.problem or 'equal'}", flush=True)
        if left <= 0 or (run.problem and not run.given):  # it differs by itself
            break
        if in_vain == _IN_VAIN:
            msg = f"{mesh.name} ends before its faults. Give it more points, or a larger --lasts"
            raise RuntimeError(msg)
    return runs


def _in_turn(meshes: Sequence[Mesh], chance: random.Random) -> Iterator[tuple[Mesh, Sequence[str]]]:
    """All meshes in all ways, for ever: each mesh comes once before any comes again."""
    ways = {mesh.name: chance.sample(list(mesh.variants), len(mesh.variants)) for mesh in meshes}
    turn = 0
    while True:
        for mesh in chance.sample(list(meshes), len(meshes)):
            own = ways[mesh.name]
            yield mesh, own[turn % len(own)]
        turn += 1


def _table(runs: Sequence[Disturbed]) -> str:
    given: dict[str, list[tuple[Disturbed, Given]]] = {}
    for run in runs:
        for one in run.given:
            given.setdefault(one.label, []).append((run, one))
    rows = []
    for label, faults in sorted(given.items()):
        own = [run for run in runs if any(one.label == label for one in run.given)]
        times = [(one.next_row_s, one.next_row_s / run.first_row_s) for run, one in faults if one.next_row_s]
        median, p99 = (_both(times, part) for part in (0.5, 0.99))
        equal = sum(not run.problem for run, _ in faults)
        lost, doubled = sum(run.found.lost for run in own), sum(run.found.doubled for run in own)
        rows.append((label, len(faults), equal, lost, doubled, median, p99))
    header = ["fault", "given", "results equal", "rows lost", "rows doubled", "to the next new row, s", "p99, s"]
    first = [run.first_row_s for run in runs]
    about = f"{len(runs)} runs; from the command to the first row {statistics.median(first):.2f} s (median)"
    return f"\n{markdown_table(header, rows)}\n\n{about}"


def _both(times: Sequence[tuple[float, float]], part: float) -> str:
    """The time below which this part of all are, and the same as a multiple of the time to the first row."""
    if not times:
        return "-"
    seconds, multiples = (
        sorted(column)[min(int(part * len(times)), len(times) - 1)] for column in zip(*times, strict=True)
    )
    return f"{seconds:.2f} ({multiples:.1f} times)"


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """SIGTERM ends this program as Ctrl-C does, so that nothing of a run is left."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
