"""A further run of a mesh with other start values, by the same processes or instances: what it may change."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from .. import files
from ..config.instance_sections import InstanceSection
from ..config.loading import PlainConfig
from ..errors import ConfigurationError, LoadFailed
from ..instances.registry import content
from ..system.plan import Plan
from ..system.run_metadata import configuration_of
from ..variables.model_description import Variable
from ..variables.value_conversion import ValueRefused, to_plain, to_value
from ..variables.value_types import PlainValue
from .options import PlanOptions
from .preparing import KnownModels, planned
from .run_plan import RunPlan

__all__ = ["OtherStartValues", "check_reset", "planned_reset"]


class OtherStartValues:
    """Decides whether start values of a further run, or of a reset, change nothing else of its plan.

    That is so if each is a value of a variable that is no structural parameter and has another start value in the plan,
    and if the plan uses start values for nothing else: no loop is iterated in Initialization Mode, there is no scenario
    and no state to begin with, and the instance has no input with a timeout or a key. The files of the models have to
    be as they were when the run was planned, unless nothing is loaded again.

    Args:
        run: the run.
        plan: plans it again for a reset, with these start values besides; None: from the configuration of the run.
        loads: whether models may be loaded again.

    Attributes:
        run: the run.
    """

    def __init__(
        self,
        run: RunPlan,
        plan: Callable[[Mapping[str, PlainValue]], RunPlan] | None = None,
        *,
        loads: bool = True,
    ) -> None:
        self.run, self._plan_again = run, plan or self._planned
        self._resets: dict[frozenset[str], OtherStartValues] = {}
        items = [item for node in run.plan.nodes.values() for item in node.instances]
        system = run.plan.system
        is_fixed = run.plan.initialization.loops or system.config.scenario is not None or run.begins_with is not None
        is_fixed = is_fixed or bool(system.feedthrough)  # how outputs depend on inputs may follow from start values
        self._variables: dict[str, tuple[str, Variable, bool]] = {}
        for item in items if not (is_fixed or any(item.scenario for item in items)) else ():
            description, finite = system.instances[item.name].description, item.not_finite == "stop"
            for name in item.start_values if not (item.timeouts or item.keys_in) else ():
                variable = description.variable(name)
                if variable is not None and variable.causality != "structuralParameter":
                    self._variables[f"{item.name}.{name}"] = item.name, variable, finite
        loaded = items if loads else []
        self._models = [(Path(item.fmu), item.section, run.contents[item.name]) for item in loaded]
        self._archives = [path for path, _, _ in self._models if path.suffix == ".fmu" and path.is_file()]
        self._versions = [files.version_at(path) for path in self._archives]
        if not self._are_as_planned(self._models):
            self._variables.clear()
        self._models = [own for own in self._models if own[0] not in self._archives]

    def taken(self, start_values: Mapping[str, object]) -> dict[str, dict[str, PlainValue]] | None:
        """Those of one run, by `instance.variable`, as values by instance and variable.

        Returns:
            None: the run has to be planned, because a value changes more, or is wrong.
        """
        found = dict[str, dict[str, PlainValue]]()
        for path, value in start_values.items():
            if (known := self._variables.get(path)) is None:
                return None
            instance, variable, finite = known
            try:
                plain = to_plain(to_value(value, variable, finite=finite))
            except ValueRefused:
                return None
            found.setdefault(instance, {})[variable.name] = plain
        with suppress(OSError):
            if [files.version_at(path) for path in self._archives] == self._versions:
                return found if self._are_as_planned(self._models) else None
        return None

    def of_reset(self, start_values: Mapping[str, PlainValue]) -> tuple[Plan, Mapping[str, Mapping[str, PlainValue]]]:
        """The plan of a reset of the run to these start values, and those that the plan has not.

        It is planned once for the same variables, if that is enough.

        Raises:
            ConfigurationError: a start value is wrong, or changes the size of an array; carries all findings.
        """
        if not start_values:
            return self.run.plan, {}
        before = self._resets.get(names := frozenset(start_values))
        if before is not None and (values := before.taken(start_values)) is not None:
            return before.run.plan, values
        again = self._plan_again(start_values)
        check_reset(self.run, again)
        self._resets[names] = OtherStartValues(again, loads=False)
        return again.plan, {}

    def _planned(self, start_values: Mapping[str, PlainValue]) -> RunPlan:
        return planned_reset(self.run, start_values, 0, KnownModels.of(self.run))

    @staticmethod
    def _are_as_planned(models: Sequence[tuple[Path, InstanceSection, str]]) -> bool:
        try:
            return all(content(path, section) == known for path, section, known in models)
        except LoadFailed:
            return False


def planned_reset(run: RunPlan, start_values: Mapping[str, PlainValue], resets: int, known: KnownModels) -> RunPlan:
    """The plan of a run from its first point again, by the same processes, after so many resets.

    Args:
        run: the first run.
        start_values: the start values that differ from those of the first run, by `instance.variable`.
        resets: number of resets, this one included.
        known: its models.

    Raises:
        ConfigurationError: a start value is wrong, or more would change than values; carries all findings.
    """
    plain = PlainConfig(configuration_of(run.loaded), run.loaded.file)
    again = planned(plain, PlanOptions(start_values=dict(start_values), allow_code=True), known=known)
    check_reset(run, again)
    return replace(run, loaded=again.loaded, plan=again.plan).after_resets(resets)


def check_reset(run: RunPlan, again: RunPlan) -> None:
    """Check that a run can be reset to another plan of the same mesh.

    Raises:
        ConfigurationError: more would change than values.
    """
    if run.begins_with is not None:
        why = "it has begun with a state"
    elif _without_start_values(again) == _without_start_values(run):
        return
    elif _without_start_values(again, step_feeds=()) == _without_start_values(run, step_feeds=()):
        why = "its outputs would depend directly on inputs in another way, and its loops are solved"
    else:
        why = "it would have other sizes, or a file of it has changed"
    raise ConfigurationError(f"mesh '{run.mesh}' cannot be reset: {why}", hint="Start it again.")


def _without_start_values(run: RunPlan, **others: object) -> object:
    """What must stay as it is in a reset, because processes and their links have it; with ``others`` instead."""
    plain: dict[str, Any] = {"start_values": {}, "timeouts": (), **others}
    return run.contents, {
        name: replace(node, digest="", records=(), instances=tuple(replace(own, **plain) for own in node.instances))
        for name, node in run.plan.nodes.items()
    }
