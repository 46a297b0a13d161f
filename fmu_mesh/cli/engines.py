"""`render` and `submit`: a mesh for an engine that has many hosts."""

from __future__ import annotations

import argparse
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Final

from ..api.result import result_of
from ..errors import ConfigurationError, Interrupted, MeshLost, from_report
from ..files import write_whole
from ..hosts.compose import compose_file
from ..hosts.kubernetes import manifests
from ..hosts.slurm import SlurmJob, submitted
from ..hosts.slurm_mesh import batch_script, followed
from ..run.outcome import Outcome
from ..run.run_plan import RunPlan
from ..text import short_path
from .arguments import Runs
from .output.display import Display
from .output.terminal import teller
from .run_options import forwarded, given_options, mesh_of
from .running import finish, planned_run

__all__ = ["RUNS"]

_IMAGE: Final = "fmu-mesh"
_FOLDER_S: Final = 60.0
"""How long a shared file system may take to show a result that another host has written."""


def _render(arguments: argparse.Namespace) -> int:
    engine, image, claim = arguments.engine, arguments.image, arguments.claim
    wrong = {
        "--image": engine == "slurm" and image is not None,
        "--claim": engine != "kubernetes" and claim is not None,
        "--slurm-option": engine != "slurm" and bool(arguments.slurm_option),
        "--resume": engine != "slurm" and bool(arguments.resume),
    }
    for flag in (flag for flag, is_wrong in wrong.items() if is_wrong):
        raise ConfigurationError(f"`render {engine}` takes no {flag}")
    run, words = _planned(arguments), forwarded(arguments)
    match engine:
        case "slurm":
            text = batch_script(run, words, arguments.slurm_option, resume=bool(arguments.resume)).text
        case "compose":
            text = compose_file(run, words, image=image or _IMAGE)
        case _:
            text = manifests(run, words, image=image or _IMAGE, claim=claim)
    if arguments.target is None:
        print(text, end="")
    else:
        write_whole(arguments.target, text)
    return 0


def _planned(arguments: argparse.Namespace) -> RunPlan:
    """Plan a run; where its master listens is up to the engine, whatever the configuration says."""
    return planned_run(mesh_of(arguments), given_options(arguments) | {"listen": ()}, arguments)


def _submit(arguments: argparse.Namespace) -> int:
    run = _planned(arguments)
    records = run.plan.system.records
    beside = Path(records[0].file).parent if records else run.config_file.parent
    try:
        beside.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"{run.mesh}-slurm-", dir=beside))
    except OSError as error:
        text = f"there can be no folder of the job in '{short_path(beside)}': {error.strerror}"
        raise ConfigurationError(text, hint="It is beside the result, which all hosts have to share.") from error
    job = None
    try:
        words, resume = forwarded(arguments), bool(arguments.resume)
        script = batch_script(run, words, arguments.slurm_option, folder=folder, resume=resume)
        job = submitted(folder / "mesh.sbatch", script.text)
    finally:
        if job is None:
            shutil.rmtree(folder, ignore_errors=True)
    tell = teller(quiet=arguments.quiet)
    tell(f"job {job.id} of Slurm; its log is '{short_path(job.log())}'")
    with Display(run.plan, show_progress=not arguments.no_progress, quiet=arguments.quiet) as display:
        try:
            outcome = followed(job, script, display.event, tell)
        except KeyboardInterrupt:
            raise Interrupted(f"job {job.id} of Slurm goes on", hint=f"`scancel {job.id}` ends it.") from None
        if outcome.error is not None:
            raise from_report(outcome.error)
    _check_results(outcome, job)
    shutil.rmtree(folder, ignore_errors=True)
    finish(run.plan, result_of(run, outcome), arguments)
    return 0


def _check_results(outcome: Outcome, job: SlurmJob) -> None:
    """Check that the results of another host are here, too."""
    end, never = time.monotonic() + _FOLDER_S, threading.Event()
    for file, _ in outcome.files:
        while not Path(file).exists():
            if time.monotonic() > end:
                text = f"job {job.id} has written '{file}' on its host, and it is not here"
                raise MeshLost(text, hint="Record into a folder that all hosts share.")
            never.wait(1.0)


RUNS: Runs = {"render": _render, "submit": _submit}
