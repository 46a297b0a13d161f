"""Cuts of the network between two hosts of a mesh, which are namespaces of this machine."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import yaml

from benchmarks.chaos_meshes import Mesh
from benchmarks.disturbing import RUN_S, Disturbed, Fault, Run, Undisturbed, factor
from benchmarks.kept_rows import GrowingFile
from fmu_mesh.system.plan import RECORDER
from tests.helpers import Launched
from tests.network_hosts import NEEDS_HOSTS, NetworkHost, link_is, started_apart, started_hosts
from tests.planning import prepare

__all__ = ["CUT", "cut_apart", "why_no_cuts"]

CUT: Final = "cut"
"""The kind of such a fault."""

_LASTS_S: Final = (0.05, 1.5)
_LATER_S: Final = 0.25
_FOLDER: Final = "chaos"


def why_no_cuts() -> str:
    """Why nobody can cut a network here; empty if that is possible."""
    return str(NEEDS_HOSTS.kwargs["reason"]) if NEEDS_HOSTS.args[0] else ""


def cut_apart(mesh: Mesh, expected: Undisturbed, chance: random.Random, count: int, number: int) -> Disturbed:
    """Run a mesh on two hosts, each with every second node, and cut the network between them ``count`` times."""
    told = Disturbed(mesh.name, number, ["on two hosts"], expected.first_row_s)
    moments = sorted(chance.uniform(0.0, 0.95) for _ in range(count))
    faults = [
        Fault(CUT, "link", 0.0, after, chance.uniform(0.0, _LATER_S), chance.uniform(*_LASTS_S)) for after in moments
    ]
    with tempfile.TemporaryDirectory(prefix="cut-") as folder, started_hosts(Path(folder)) as hosts:
        configs = [_written(mesh, host, factor(mesh, expected)) for host in hosts]
        nodes = [node for node in prepare(configs[0]).nodes if node != RECORDER]
        launched = started_apart(hosts, Path(_FOLDER, configs[0].name), nodes)
        file = GrowingFile(configs[0].with_name("result.csv"))
        run = Run(launched[0], file, RUN_S + expected.seconds + mesh.lasts_s)
        try:
            for fault in faults:
                _cut(run, hosts, fault, expected.rows, told)
            codes = [one.wait(run.left_s) for one in launched]
        except AssertionError as error:
            told.problem = f"{error}\n{_story(launched)}"
        else:
            run.judge(max(map(abs, codes)), expected.content, told)
    return told


def _written(mesh: Mesh, host: NetworkHost, real_time_factor: float) -> Path:
    """Write a mesh and what is beside it into a folder of a host."""
    folder = host.folder / "own-clone" / _FOLDER
    shutil.copytree(mesh.config.parent, folder)
    content = yaml.safe_load(mesh.config.read_text(encoding="utf-8"))
    content["simulation"]["real_time_factor"] = real_time_factor
    record = content.get("record") or {}
    content["record"] = {**(record[0] if isinstance(record, list) else record), "file": "result.csv"}
    path = folder / mesh.config.name
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def _cut(run: Run, hosts: Sequence[NetworkHost], fault: Fault, rows: int, told: Disturbed) -> None:
    run.reach(fault, rows, told)
    if not run.launched.running:
        return
    row = run.file.rows
    link_is(hosts[1], "down")
    run.let_pass(fault.lasts_s)
    link_is(hosts[1], "up")
    told.given.append(run.next_row(f"{fault.kind} {fault.role}", row, run.file.rows))


def _story(launched: Sequence[Launched]) -> str:
    return "".join(one.story() for one in launched)
