"""Each option of each call, given in six ways: the call works, or one of our exceptions names the option."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.config.call_options import CallOptions, option_fields
from fmu_mesh.run.options import ConvergenceOptions, OpenOptions, PlanOptions, RunOptions, SimulateOptions
from fmu_mesh.sweeps import worker_server
from fmu_mesh.sweeps.planned_sweep import SweepOptions
from tests.helpers import FMUS, write_config

RIGHT: Mapping[str, Any] = {
    "algorithm": "jacobi",
    "step_size": 0.002,
    "stop_time": 0.004,
    "window": 1,
    "start_values": {"pendulum.a": 1.0},
    "config_values": {"simulation.window": 2},
    "allow_code": True,
    "on_notice": str,
    "real_time_factor": 100.0,
    "update_period": 0.001,
    "catch_up": 1.0,
    "record": ["pendulum.a"],
    "output": "out.csv",
    "scenario": {"events": []},
    "keys_from": os.devnull,
    "state": None,
    "replaced": [],
    "listen": ["tcp/127.0.0.1:0"],
    "connect": ["tcp/127.0.0.1:7447"],
    "security": "lab/host",
    "insecure": True,
    "defects": True,
    "paused": False,
    "view": False,
    "video": None,
    "profile": False,
    "processes": False,
    "memory_limit": 10**6,
    "restarts": 1,
    "on_progress": str,
    "on_event": str,
    "workers": 1,
    "sampler": "lhs:2",
    "seed": 3,
    "reduce": ["max(pendulum.a)"],
    "folder": "swept",
    "curves": False,
    "resume": True,
    "force": True,
    "reset": True,
    "max_instances": {"DampedPendulum.fmu": 2},
    "halvings": 1,
}
"""A value of each option with which a call works."""


@pytest.fixture(autouse=True)
def server_of_workers(folder: Path) -> Iterator[None]:  # noqa: ARG001 in which nothing may be left
    """The server of a study stays for the next one of the program: it ends here with each test."""
    yield
    while worker_server._ready:
        worker_server._ready.pop().close()


class Nowhere(Executor):
    """An executor that runs nothing."""

    def submit(self, *_: Any, **__: Any) -> Future[Any]:  # noqa: ANN401  as the base class
        """Refuse it, as one that was shut down."""
        raise RuntimeError


class Call(NamedTuple):
    """A call of the library, with the options without which it would take long."""

    options: type[CallOptions]
    call: Callable[..., object]
    base: Mapping[str, Any]
    right: Mapping[str, Any] = RIGHT


def started(mesh: fmu_mesh.Mesh, **options: Any) -> None:  # noqa: ANN401 what is tested
    mesh.start(**options).close()


def opened(mesh: fmu_mesh.Mesh, **options: Any) -> None:  # noqa: ANN401 what is tested
    mesh.open(**options).close()


def swept(mesh: fmu_mesh.Mesh, **options: Any) -> None:  # noqa: ANN401 what is tested
    vary = {"pendulum.d": fmu_mesh.Range(0.1, 0.2) if "sampler" in options else [0.1]}
    fmu_mesh.sweep(mesh, vary, **options).close()


def simulated(_: fmu_mesh.Mesh, **options: Any) -> None:  # noqa: ANN401 what is tested
    fmu_mesh.simulate(FMUS / "Gain.fmu", **options)


OF_ONE_FMU = {
    "start_time": 0.0,
    "output_interval": 0.004,
    "kind": "co_simulation",
    "tolerance": 1e-6,
    "solver": {},
    "start_values": {"k": 2.0},
    "inputs": {"u": 1.0},
    "record": ["y"],
}
SHORT = {"stop_time": 0.004, "processes": False}
CALLS = {
    "check": Call(PlanOptions, lambda mesh, **options: mesh.check(**options).require(), {}),
    "run": Call(RunOptions, fmu_mesh.Mesh.run, SHORT, {**RIGHT, "resume": False}),
    "start": Call(RunOptions, started, SHORT, {**RIGHT, "resume": False}),
    "open": Call(OpenOptions, opened, {}, {**RIGHT, "keys_from": None}),
    "simulate": Call(SimulateOptions, simulated, {**SHORT, "step_size": 0.002}, {**RIGHT, **OF_ONE_FMU}),
    "sweep": Call(SweepOptions, swept, {"stop_time": 0.004, "executor": Nowhere()}),
    "convergence": Call(
        ConvergenceOptions,
        fmu_mesh.Mesh.convergence,
        {"stop_time": 0.004, "workers": 1},
        {**RIGHT, "resume": False, "keys_from": None},
    ),
}
WAYS: Mapping[str, Callable[[str], Any]] = {
    "numpy": lambda _: np.float64(0.5),
    "text": lambda _: "x",
    "None": lambda _: None,
    "list": lambda _: [1],
}
CASES = [(call, option) for call, own in CALLS.items() for option in option_fields(own.options)]
NOT_TRIED = {("executor", "right"), ("executor", "None")}
"""The executor is always given, and None starts processes."""


@pytest.mark.parametrize(("call", "option"), CASES)
def test_an_option_works_or_is_named(call: str, option: str, folder: Path) -> None:
    mesh, (_, make, base, right) = fmu_mesh.load(write_config(folder, stop_time=0.01)), CALLS[call]

    for way, value_of in {"right": right.__getitem__, **WAYS}.items():
        if (option, way) in NOT_TRIED:
            continue
        refused = None
        try:
            make(mesh, **{**base, option: value_of(option)})
        except fmu_mesh.FmuMeshError as error:
            refused = error
        assert refused is None or (option in str(refused) and way != "right"), (way, refused)
        shutil.rmtree("swept", ignore_errors=True)
        shutil.rmtree("pair_sweep", ignore_errors=True)
    others = {name: value for name, value in base.items() if name != option}
    with pytest.raises(fmu_mesh.CallRefused, match=f"Did you mean `{option}`"):
        make(mesh, **others, **{f"{option}_": RIGHT.get(option)})


WRONG: Mapping[str, Callable[[Any], object]] = {
    "load": fmu_mesh.load,
    "from_yaml": fmu_mesh.Mesh.from_yaml,
    "from_fmu": fmu_mesh.Mesh.from_fmu,
    "save": lambda value: fmu_mesh.load("pair.yaml").save(value),
    "attach": lambda value: fmu_mesh.attach("pair", timeout=value),
    "meshes": lambda value: fmu_mesh.meshes(connect=value),
    "inspect": fmu_mesh.inspect,
    "inspect_package": fmu_mesh.inspect_package,
    "recover": fmu_mesh.recover,
    "rerun": fmu_mesh.rerun,
    "read": fmu_mesh.Result.read,
    "sweep": lambda value: fmu_mesh.sweep(value, {"pendulum.d": [0.1]}),
}


@pytest.mark.parametrize("call", WRONG)
def test_an_argument_of_a_wrong_type_is_refused(call: str, folder: Path) -> None:
    write_config(folder)

    for value in ({}, 3 if call != "attach" else "3", object()):
        with pytest.raises(fmu_mesh.CallRefused, match="expected "):
            WRONG[call](value)


def test_a_misspelt_argument_is_refused() -> None:
    with pytest.raises(fmu_mesh.CallRefused, match="Did you mean `path`"):
        fmu_mesh.load(pth="pair.yaml")  # type: ignore[call-arg]  # what is to be refused


def test_what_pandas_has_is_taken_as_a_mapping(folder: Path) -> None:
    pandas = pytest.importorskip("pandas")
    mesh = fmu_mesh.load(write_config(folder, stop_time=0.01))
    starts = pandas.Series({"pendulum.a": 0.5, "delay.d": 0.2})

    plan = mesh.plan(start_values=starts, stop_time=np.array(0.005))  # type: ignore[arg-type]  # taken as a number

    assert plan.plan.grid.last_point == 5
    assert plan.plan.system.instances["pendulum"].start_values["a"] == 0.5
    assert mesh.plan(start_values=starts.items()).contents == plan.contents


def test_record_names_what_is_recorded_into_arrays_or_the_output(folder: Path) -> None:
    mesh = fmu_mesh.load(write_config(folder, stop_time=0.01))

    kept = mesh.run(record=["delay.*"], processes=False)
    written = mesh.run(record=["in:delay.x", "pendulum.a"], output="few.csv", processes=False)

    assert (kept.names, kept.file, sorted(folder.glob("*.csv"))) == (["delay.y"], None, [folder / "few.csv"])
    assert written.names == ["delay.x", "pendulum.a"]
