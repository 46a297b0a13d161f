"""The state of an instance in a node, as bytes that outlive its process, and a run that begins with one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, cast

from msgspec.structs import replace

from ..errors import FmuError
from ..instances.contract import KeepsState
from ..results.played_rows import RowsToPlay
from ..rings.packed_member import PackedMember, columns_of, put_columns
from ..system.attempt import Attempt
from ..system.states import BeginsWith
from ..variables.value_conversion import to_value
from ..wire.messages import InstanceState, encode_state
from .inputs import TimedInputs, set_input
from .stepping import RowPlayer, Runner

__all__ = ["load_states", "set_again", "state_messages"]

_FIRST: Final = Attempt()


def load_states(begins_with: BeginsWith, runners: Mapping[str, Runner], attempt: Attempt = _FIRST) -> None:
    """After Initialization Mode, and before an engine is made: bring the runners to their states.

    In an ``attempt`` that plays, they come to them later: until then, they play their rows.

    Raises:
        FmuError: an instance cannot use its state.
        FmuMeshError: the rows cannot be read.
    """
    rows = RowsToPlay(Path(attempt.rows)) if attempt.plays_to else None
    for name, data in begins_with.states.items():
        runner = runners[name]
        if rows is not None:
            load = partial(_load_later, runner, data, attempt.plays_to)
            read, last = partial(rows.read, name, runner.outputs), attempt.plays_to // runner.plan.step_points - 1
            runner.play(RowPlayer(read, last, load))
            continue
        runner.begin_at(runner.grid.first_point // runner.plan.step_points)
        _load(runner, data, runner.grid.first_point)
    for name in begins_with.anew.keys() & runners.keys():
        if isinstance(timed := runners[name].instance, TimedInputs):
            timed.last.count_from(runners[name].step)


def set_again(begins_with: BeginsWith, runners: Mapping[str, Runner]) -> None:
    """When there is an engine, and before the first step: set what is another start value now.

    Raises:
        FmuError: an instance refused it.
    """
    for name, values in begins_with.set_again.items():
        description = runners[name].instance.description
        variables = {variable.name: variable for variable in description.variables}
        for own, value in values.items():
            set_input(runners[name], own, to_value(value, variables[own]), None)


def state_messages(runners: Mapping[str, Runner], at: int) -> Iterable[bytes] | None:
    """The states of all runners at the point of a checkpoint, as messages; None before that point.

    The master cannot go on without an answer: where an instance has no state to send, it gets the reason. After that
    point the checkpoint was given up, and there are no messages.
    """
    points = [runner.point for runner in runners.values()]
    if min(points) < at:
        return None
    return chain.from_iterable(_state_of(own, at) for own in (runners.values() if max(points) == at else ()))


def _state_of(runner: Runner, at: int) -> Iterable[bytes]:
    try:
        own = InstanceState(runner.name, _packed(runner))
    except FmuError as error:
        own = InstanceState(runner.name, error=error.at(at, runner.grid.time(at)).report())
    return encode_state(own, at)


def _packed(runner: Runner) -> bytes:
    """The state of a runner between two steps, at a point at which all instances have an own one.

    So its newest row is the only one that a step may still read.

    Raises:
        FmuError: the instance cannot write its state.
    """
    step, instance = runner.step, cast("KeepsState", runner.instance)
    if isinstance(runner.instance, TimedInputs):
        runner.instance.reached(step)
    state = instance.get_state()
    try:
        data = instance.serialize_state(state)
    finally:
        instance.free_state(state)
    known = PackedMember(data, step, -1, {}, {}, {})
    if isinstance(runner.instance, TimedInputs):
        own, data = runner.instance.apart(data)
        known = replace(own, state=data)
    outputs = columns_of(runner.outputs, runner.outputs.parts, [step])
    inputs = columns_of(runner.inputs, runner.inputs.parts, [0])
    return replace(known, outputs=outputs, inputs=inputs).encoded()


def _load_later(runner: Runner, data: bytes, point: int) -> None:
    runner.play(None)
    _load(runner, data, point)
    runner.refit()


def _load(runner: Runner, data: bytes, point: int) -> None:
    own, grid, name = PackedMember.decoded(data, runner.name), runner.grid, runner.name
    if (at := own.step * runner.plan.step_points) != point:
        raise FmuError(f"its state is of point {at}, and the run needs that of point {point}", instance=name)
    runner.bind_at(own.step)
    if own.over_time and not isinstance(runner.instance, TimedInputs):
        timed = TimedInputs(runner.instance, "hold")
        timed.start(grid, runner.plan.step_points, own.step)
        runner.wrap(timed)
    instance = cast("KeepsState", runner.instance)
    together = runner.instance.together(own) if isinstance(runner.instance, TimedInputs) else own.state
    if isinstance(runner.instance, TimedInputs):
        runner.instance.skip_before(point)
    state = instance.deserialize_state(together)
    try:
        instance.set_state(state)
    finally:
        instance.free_state(state)
    outputs = runner.outputs
    others = put_columns(outputs, outputs.parts, [own.step], own.outputs, name)
    put_columns(runner.inputs, runner.inputs.parts, [0], own.inputs, name)
    for other, value in zip(others, runner.instance.get_values(others) if others else [], strict=True):
        outputs.put(own.step, other, value)
