"""`kind`, `solver`, `tolerance`, `retry_discarded_steps`, `extrapolation`: what is refused and why, what is shown."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.system.plan import Plan
from tests.fmus.event_fmus import Version
from tests.fmus.helpers import find_fmu
from tests.plain_run import PlainRun
from tests.planning import prepare

EventFmu = Callable[..., Path]


def planned(folder: Path, instances: dict[str, Any], connections: list[Any] | None = None) -> Plan:
    """The plan of a mesh of a second in ten steps."""
    path = folder / "mesh.yaml"
    content = {
        "mesh": "m",
        "simulation": {"stop_time": 1.0, "step_size": 0.1},
        "instances": instances,
        "connections": connections or [],
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return prepare(path)


def refused(folder: Path, instances: dict[str, Any], connections: list[Any] | None = None) -> str:
    with pytest.raises(ConfigurationError) as caught:
        planned(folder, instances, connections)
    return str(caught.value)


def test_auto_prefers_co_simulation_and_takes_model_exchange_only_without_it(
    event_fmu: EventFmu, tmp_path: Path
) -> None:
    plan = planned(
        tmp_path,
        {
            "both": {"fmu": str(event_fmu("Ball", 2))},
            "equations": {"fmu": str(event_fmu("Ball", 2, only="model_exchange"))},
            "oldest": {"fmu": str(event_fmu("Ball", 1))},
        },
    )

    kinds = {name: instance.description.kind for name, instance in plan.system.instances.items()}
    assert kinds == {"both": "co_simulation", "equations": "model_exchange", "oldest": "model_exchange"}


@pytest.mark.parametrize(
    ("only", "kind", "says"),
    [
        ("model_exchange", "co_simulation", "is for model exchange only, not for co-simulation"),
        ("co_simulation", "model_exchange", "is for co-simulation only, not for model exchange"),
    ],
)
def test_a_kind_that_an_fmu_has_not_is_refused(
    only: str, kind: str, says: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    message = refused(tmp_path, {"ball": {"fmu": str(event_fmu("Ball", 3, only=only)), "kind": kind}})

    assert says in message
    assert "`kind: auto` uses the kind that the FMU has" in message


def test_settings_of_a_solver_are_checked_together(event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu = str(event_fmu("Ball", 2))

    message = refused(
        tmp_path,
        {
            "one": {"fmu": fmu, "kind": "model_exchange", "solver": {"relative_tolerance": 0, "maximum_step_size": -1}},
            "two": {"fmu": fmu, "solver": {"name": "euler"}},
            "three": {"fmu": fmu, "kind": "model_exchange", "retry_discarded_steps": True},
        },
    )

    assert "instances.one.solver.relative_tolerance: 0; expected a number > 0" in message
    assert "instances.one.solver.maximum_step_size: -1; expected a number > 0" in message
    assert "instances.two.solver: a solver for 'two', which runs as co-simulation" in message
    assert "instances.three.retry_discarded_steps: true, but a model-exchange FMU has no steps of its own" in message


def test_a_tolerance_is_refused_where_the_fmu_cannot_be_told_one(event_fmu: EventFmu, tmp_path: Path) -> None:
    ball, steps = str(event_fmu("Ball", 2)), str(find_fmu("Steps1", tmp_path))

    message = refused(
        tmp_path,
        {
            "none": {"fmu": ball, "tolerance": 0.0},
            "model": {"fmu": ball, "kind": "model_exchange", "tolerance": 1e-8},
            "oldest": {"fmu": steps, "tolerance": 1e-8},
        },
    )

    assert "instances.none.tolerance: 0; expected a number > 0" in message
    assert (
        "instances.model.tolerance: 1e-08, but the FMU runs as model exchange, with a solver of ours; expected "
        "`solver: {relative_tolerance: ...}`" in message
    )
    assert (
        "instances.oldest.tolerance: 1e-08, but co-simulation in FMI 1.0 cannot be told one (fmiInitializeSlave); "
        "expected no tolerance" in message
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"canHandleVariableCommunicationStepSize": "false"}, "does not handle a variable communication step size"),
        ({"canGetAndSetFMUstate": "false"}, "cannot get and set its state"),
    ],
)
def test_retrying_is_refused_if_the_fmu_cannot(
    changes: dict[str, str], reason: str, event_fmu: EventFmu, tmp_path: Path
) -> None:
    fmu = str(event_fmu("Stairs", 2, **changes))

    assert reason in refused(tmp_path, {"stairs": {"fmu": fmu, "retry_discarded_steps": True}})


@pytest.mark.parametrize(
    ("source", "target", "version", "changes", "reason"),
    [
        ("integral.s", "integral.u", 3, {}, "co-simulation in FMI 3.0 takes no input derivatives"),
        ("integral.s", "integral.u", 2, {"canInterpolateInputs": "false"}, "does not interpolate inputs"),
        ("integral.above", "stairs.increment", 2, {}, "'increment' is no scalar Real input"),
        ("integral.s", "again.u", 2, {}, "discarded steps of its target are retried"),
    ],
)
def test_linear_inputs_are_refused_where_they_cannot_be(
    source: str,
    target: str,
    version: Version,
    changes: dict[str, str],
    reason: str,
    event_fmu: EventFmu,
    tmp_path: Path,
) -> None:
    instances = {
        "integral": {"fmu": str(event_fmu("Integral", version, **changes))},
        "stairs": {"fmu": str(event_fmu("Stairs", 2))},
        "again": {"fmu": str(event_fmu("Integral", 2)), "retry_discarded_steps": True},
    }

    message = refused(tmp_path, instances, [{"from": source, "to": target, "extrapolation": "linear", "delay": 1}])

    assert f"connections[0].extrapolation: linear for {source} -> {target}, but " in message
    assert reason in message


def test_check_shows_the_solver_the_slopes_and_what_needs_a_tool(event_fmu: EventFmu, tmp_path: Path) -> None:
    plan = planned(
        tmp_path,
        {
            "ball": {"fmu": str(event_fmu("Ball", 2, needsExecutionTool="true"))},
            "integral": {
                "fmu": str(event_fmu("Integral", 3)),
                "kind": "model_exchange",
                "solver": {"relative_tolerance": 1e-8},
            },
        },
        [{"from": "ball.h", "to": "integral.u", "extrapolation": "linear"}],
    )

    page = "\n".join(plan_page(plan))

    assert "Integral3.fmu (FMI 3.0 model exchange, auto 1e-08)" in page
    assert "changes linearly in the step" in page
    assert "the FMU of 'ball' needs an execution tool (it does not say which); expected that tool on the host" in page


def test_two_instances_of_an_fmu_that_allows_one_share_no_process(event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu = str(event_fmu("Ball", 2, canBeInstantiatedOnlyOncePerProcess="true"))

    message = refused(tmp_path, {"one": {"fmu": fmu, "group": "g"}, "two": {"fmu": fmu, "group": "g"}})
    apart = planned(tmp_path, {"one": {"fmu": fmu}, "two": {"fmu": fmu}})

    assert "'one' and 'two' cannot run in one process: the FMU " in message
    with pytest.raises(ConfigurationError, match="'one' and 'two' cannot run in one process"):
        PlainRun(apart).run()
