"""How outputs depend directly on connected inputs: of all instances for `loops: solved`, and within solved groups.

What the user says (`feedthrough`) counts, else what is measured; where neither says it, a cycle cannot be solved.
"""

# Each model is opened in a child process, some at a time, each by a thread that waits for its answer (ADR 93). The
# child has a deadline, and ends with this process. The threads meet in `findings` only, whose list each appends to.

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from ..config.findings import Findings
from ..config.instance_sections import InstanceSection, key_of, placed
from ..instances.feedthrough import Measured, measured
from ..system.consistent_outputs import element_pairs
from ..system.graph import is_cycle, strongly_connected
from ..system.solved_groups import blocks_of, is_solved
from ..system.system import ResolvedSystem
from ..text import listed, nearest
from ..variables.model_description import Causality
from ..variables.value_conversion import to_plain

__all__ = ["with_feedthrough"]

_MEASURED = ("fmu", "python", "onnx")
"""The kinds that can be opened a second time; the others are worlds and simulators."""

_AT_ONCE = 4


class _Question(NamedTuple):
    """The inputs of an instance, and the outputs that may depend directly on them."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def with_feedthrough(
    system: ResolvedSystem, sections: Mapping[str, InstanceSection], findings: Findings, warnings: Findings
) -> ResolvedSystem:
    """The system with the derivatives of outputs by inputs, if they are needed; warns where one is not known.

    Raises:
        ConfigurationError: a cycle needs one that is not known, or one that is given has a wrong name. It has the
            ``findings``.
    """
    if system.config.simulation.loops == "delayed" and not blocks_of(system.config.members):
        return system
    questions = _questions(system)
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        answers = threads.map(lambda name: _answer(system, sections, name, questions[name], findings), questions)
        known = dict(zip(questions, answers, strict=True))
    blocks = blocks_of(system.config.members)
    edges = [(c.source_instance, c.target_instance) for c in system.connections if not c.initial_only]
    cycles = [part for part in strongly_connected(system.instances, edges) if is_cycle(part, edges)]
    for name, answer in known.items():
        own = system.instances[name]
        inputs = {one.name for one in own.description.with_causality("input")}
        if answer.derivatives and (changed := [one.variable for one in own.scenario if one.variable not in inputs]):
            what = "how its outputs depend directly on inputs stays as it is at the start"
            warnings.add(f"instances.{name}", f"the scenario changes {listed(changed)}; {what}", "")
        why = answer.failure or (f"{listed(answer.changing)} is no constant" if answer.changing else "")
        if not why:
            continue
        asked, cycle = questions[name], next((part for part in cycles if name in part), None)
        what = f"how {listed(asked.outputs)} depends directly on {listed(asked.inputs)} is not known: {why}"
        if name in blocks:
            expected = f"`feedthrough: {{{asked.outputs[0]}: {{{asked.inputs[0]}: ...}}}}` there, or no `solve`"
            findings.add(f"instances.{name}.feedthrough", f"a group that is solved, but {what}", expected)
            continue
        if cycle is None:
            warnings.add(f"instances.{name}.feedthrough", f"{what}. It is not made consistent", "")
            continue
        around = " -> ".join([*cycle, cycle[0]])
        expected = f"`feedthrough: {{{asked.outputs[0]}: {{{asked.inputs[0]}: ...}}}}` there, or `loops: delayed`"
        findings.add(f"instances.{name}.feedthrough", f"solved loops on the cycle {around}, but {what}", expected)
    findings.raise_any()
    return replace(system, feedthrough={name: answer.derivatives for name, answer in known.items()})


def _questions(system: ResolvedSystem) -> dict[str, _Question]:
    inputs: dict[str, dict[str, None]] = {}
    outputs: dict[str, dict[str, None]] = {}
    instances, blocks = system.instances, blocks_of(system.config.members)
    everywhere = system.config.simulation.loops == "solved"
    for c in system.connections:
        same = instances[c.source_instance].step_points == instances[c.target_instance].step_points
        held = is_solved(c, blocks) and c.extrapolation != "linear"  # with a line, outputs belong to its end
        asks = held if c.target_instance in blocks else everywhere and same
        if not c.initial_only and c.source.type == c.target.type == "Float64" and not c.map:
            for source, target in element_pairs(c):
                outputs.setdefault(c.source_instance, {})[source] = None
                if asks:
                    inputs.setdefault(c.target_instance, {})[target] = None
    for name, variable in system.recorded:
        outputs.setdefault(name, {})[variable] = None
    found = {}
    for name, own in inputs.items():
        described = ((output, instances[name].description.variable_of(output)) for output in outputs.get(name, {}))
        direct = tuple(
            output
            for output, variable in described
            if variable is not None
            and variable.type == "Float64"
            and variable.causality in {"output", "local"}
            and variable.changes
            and variable.feedthrough != ()
        )
        if direct:
            found[name] = _Question(tuple(own), direct)
    return found


def _answer(
    system: ResolvedSystem,
    sections: Mapping[str, InstanceSection],
    name: str,
    asked: _Question,
    findings: Findings,
) -> Measured:
    """What the user says, or what is measured."""
    section, own, config = sections[name], system.instances[name], system.config
    if (given := section.feedthrough) is not None:
        place = f"instances.{name}.feedthrough"
        for output, inputs in given.items():
            ends: list[tuple[str, Causality]] = [(output, "output"), *((one, "input") for one in inputs)]
            for variable, causality in ends:
                described = own.description.variable_of(variable)
                if described is None or described.causality not in {causality, "local"}:
                    others = [known.name for known in own.description.with_causality(causality)]
                    expected, near = f"one of its {causality}s: {listed(others)}", nearest(variable, others)
                    findings.add(f"{place}.{output}", f"'{variable}'", expected, near)
        return Measured({output: dict(inputs) for output, inputs in given.items()})
    if key_of(section) not in _MEASURED:
        return Measured(failure=f"an instance of the kind `{key_of(section)}` is not opened a second time")
    if config.process_of(section).is_sandboxed:
        return Measured(failure="it may only be opened in its sandbox")
    start_values = {variable: to_plain(value) for variable, value in own.start_values.items()}
    at = Path(own.fmu), placed(section), own.description, config.limits
    return measured(*at, system.grid.start_time, start_values, asked.inputs, asked.outputs)
