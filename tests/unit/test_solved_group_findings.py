"""What a group that is solved may be: findings, delays, order, and units of the plan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.pictures.plan_page import plan_page
from fmu_mesh.system.plan import RECORDER, Plan
from tests.helpers import write_config
from tests.planning import prepare
from tests.solved_systems import LINKS, driven_masses, masses

EventFmu = Callable[..., Path]


def plan_of(folder: Path, instances: Mapping[str, Mapping[str, Any]], links: Any = LINKS, **sections: Any) -> Plan:  # noqa: ANN401  those of a configuration
    return prepare(write_config(folder, instances=instances, connections=links, **sections))


def findings(folder: Path, instances: Mapping[str, Mapping[str, Any]], links: Any = LINKS) -> list[str]:  # noqa: ANN401  as above
    with pytest.raises(ConfigurationError) as error:
        plan_of(folder, instances, links)
    return [f"{found.path}: {found.found}; expected {found.expected}" for found in error.value.findings]


def test_a_group_is_one_unit_with_delays_of_1_within(event_fmu: EventFmu, tmp_path: Path) -> None:
    plan = prepare(write_config(tmp_path, **driven_masses(event_fmu("LinearPart", 2), tmp_path)))

    assert plan.nodes["g"].units == (("one", "two"),)
    assert plan.order == ("pendulum", "one", "two", "back")
    assert {str(c): c.delay for c in plan.connections} == {
        "two.y -> one.u": 1,
        "one.x -> two.u": 1,
        "one.v -> two.w": 1,
        "pendulum.a -> two.push": 0,
        "one.x -> back.u": 0,
        "back.y -> two.back": 1,
    }
    assert [group.members for group in plan.nodes["g"].groups] == [("one", "two")]
    assert plan.groups[0].feedthrough == {"one": {}, "two": {"y": {"u": -1000.0, "w": -10.0}}}
    assert plan.cycles == (("one", "two", "back"),)


def test_settings_at_two_members_have_to_be_the_same(event_fmu: EventFmu, tmp_path: Path) -> None:
    instances = masses(event_fmu("LinearPart", 2))
    same = {**instances, "two": {**instances["two"], "group": instances["one"]["group"]}}
    other = {**instances, "two": {**instances["two"], "group": {"name": "g", "solve": "newton", "tolerance": 1e-6}}}

    assert len(plan_of(tmp_path, same).groups) == 1
    assert findings(tmp_path, other) == [
        (
            "instances.two.group: other settings for the group 'g' than `instances.one.group` has; expected "
            "`group: g`, or the settings at one member only"
        )
    ]


def test_a_group_without_solve_is_a_group(event_fmu: EventFmu, tmp_path: Path) -> None:
    instances = masses(event_fmu("LinearPart", 2), solve=None)

    plan = plan_of(tmp_path, instances)

    assert (plan.groups, [*plan.nodes]) == ((), ["g", RECORDER])


def test_members_have_states_and_one_step_size(event_fmu: EventFmu, tmp_path: Path) -> None:
    instances = masses(event_fmu("LinearPart", 2))
    instances["two"]["fmu"] = str(event_fmu("LinearPart", 2, canGetAndSetFMUstate="false"))
    instances["two"] |= {"on_failure": "hold", "step_size": 0.002}

    assert findings(tmp_path, instances) == [
        (
            "instances.one.group: 'g' is solved, and has the step sizes 0.001 s of 'one', 0.002 s of 'two'; "
            "expected one for all members"
        ),
        (
            "instances.two.group: 'two' has no state to go back to (its model description does not have "
            "canGetAndSetFMUstate), in the group 'g', which is solved; expected another group, or one without `solve`"
        ),
        (
            "instances.two.on_failure: an instance whose outputs are held after a failure, in the group 'g', which is "
            "solved; expected stop"
        ),
    ]


def test_step_control_needs_fmus_that_vary_their_step(event_fmu: EventFmu, tmp_path: Path) -> None:
    fmu = event_fmu("LinearPart", 2, canHandleVariableCommunicationStepSize="false")
    instances = masses(fmu, step_control={"tolerance": 1e-3})
    assert len(plan_of(tmp_path, instances).groups) == 1  # for model exchange we vary it

    for own in instances.values():
        own["kind"] = "co_simulation"
        del own["solver"]
    assert [text.partition(", while ")[2] for text in findings(tmp_path, instances)] == [
        f"'{name}' cannot vary its step size (canHandleVariableCommunicationStepSize), in the group 'g', which is "
        "solved; expected no `step_control`"
        for name in ("one", "two")
    ]


def test_there_has_to_be_something_to_solve(event_fmu: EventFmu, tmp_path: Path) -> None:
    assert findings(tmp_path, masses(event_fmu("LinearPart", 2)), []) == [
        (
            "instances.one.group: nothing to solve in 'g': no continuous Float64 input of a member comes from a "
            "member; expected such connections, or no `solve`"
        )
    ]


def test_delays_ways_and_tolerances_that_mean_nothing_are_refused(event_fmu: EventFmu, tmp_path: Path) -> None:
    links = [
        {"from": "two.y", "to": "one.u", "delay": 0},
        {"from": "one.x", "to": "two.u", "extrapolation": "midpoint"},
    ]
    instances = masses(event_fmu("LinearPart", 2), tolerance=0.0, step_control={"tolerance": -1.0})

    assert findings(tmp_path, instances, links) == [
        "instances.one.group.tolerance: 0; expected a number > 0",
        "instances.one.group.step_control.tolerance: -1; expected a number > 0",
        "connections[0].delay: 0 for two.y -> one.u, within the group 'g', which is solved; expected no `delay`",
        "connections[1].extrapolation: midpoint for one.x -> two.u, within a group that is solved; expected none",
    ]


def test_a_direct_dependence_that_is_not_known_is_refused(event_fmu: EventFmu, tmp_path: Path) -> None:
    """A component takes no line: its inputs are means, from which an output is corrected by a constant."""
    (tmp_path / "parts.py").write_text(
        "import fmu_mesh\n\n"
        "class Square(fmu_mesh.Component):\n"
        "    u = fmu_mesh.Input()\n"
        "    y = fmu_mesh.Output(depends_on=('u',))\n\n"
        "    def initialize(self):\n        self.y = self.u * self.u\n\n"
        "    def step(self, time, step_size):\n        self.initialize()\n",
        encoding="utf-8",
    )
    instances = masses(event_fmu("LinearPart", 2))
    instances["two"] = {"python": "parts.py:Square", "group": "g"}

    assert findings(tmp_path, instances, ["one.x -> two.u", "two.y -> one.u"]) == [
        (
            "instances.two.feedthrough: a group that is solved, but how y depends directly on u is not known: 'y' "
            "by 'u' is no constant; expected `feedthrough: {y: {u: ...}}` there, or no `solve`"
        )
    ]


def test_check_names_the_unknowns(event_fmu: EventFmu, tmp_path: Path) -> None:
    page = plan_page(plan_of(tmp_path, masses(event_fmu("LinearPart", 2))))

    assert "  'g' is solved at each point: one.u, two.u, two.w" in page
