"""Initialization Mode over the wire: values become known level by level, here and in other nodes (FMI 2.0, 4.2.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection

from ..errors import DeadlineExceeded
from ..model.elements import element_of, merged, scaled
from ..model.plan import Link, NodePlan
from ..model.types import Value
from ..wire.frames import initial_values, needed_levels
from .stepping import Runner

__all__ = ["Initialization"]


class Initialization:
    """Sets inputs and gets outputs while all instances of a node are in Initialization Mode.

    Args:
        plan: the node's plan.
        wait: waits at most so many seconds for something to arrive, and takes it.
    """

    def __init__(self, plan: NodePlan, wait: Callable[[float], None]) -> None:
        self._plan = plan
        self._wait = wait
        self._links = {link.source: link for link in plan.links_in}
        self._own = {instance.name: instance for instance in plan.instances}
        self._known: dict[tuple[str, str], Value] = {}

    def take(self, link: Link, level: int, data: bytes) -> None:
        """Take an INITIAL message of another node."""
        for name, value in initial_values(link, level, data).items():
            self._known[(link.source, name)] = value

    def run(self, runners: Collection[Runner]) -> None:
        """Propagate all connected values; every instance must be in Initialization Mode.

        Raises:
            DeadlineExceeded: the initial value of another node did not come in time.
            FmuError: an FMU refused a value.
        """
        end = time.monotonic() + self._plan.timeouts.initialize
        for level in sorted({level for runner in runners for level in runner.plan.initialization.values()}):
            for runner in runners:
                if level in runner.plan.initialization.values():
                    self._set_inputs(runner, level, end)
                    self._get_outputs(runner, level)
        for runner in runners:
            self._set_inputs(runner, None, end)

    def _set_inputs(self, runner: Runner, below: int | None, end: float) -> None:
        """Set the inputs whose sources are known below a level (None: all)."""
        values: dict[str, Value] = {}
        for feed in runner.plan.feeds:
            for source, target, factor, offset in feed.columns:
                early = below is None or self._level_of(feed.source, source) < below
                if early and target not in runner.plan.held:
                    values[target] = scaled(self._value(feed.source, source, end), factor, offset)
        if values:
            runner.instance.set_values(merged(values, runner.plan.inputs, runner.instance.get_values))

    def _level_of(self, instance: str, variable: str) -> int:
        if instance in self._own:
            own = self._own[instance]
            return own.initialization[own.outputs.column(variable).name]
        link = self._links[instance]
        return link.levels[link.layout.columns.index(link.layout.column(variable))]

    def _value(self, instance: str, variable: str, end: float) -> Value:
        """The initial value of an output, or of an element of it."""
        layout = self._own[instance].outputs if instance in self._own else self._links[instance].layout
        column = layout.column(variable)
        while (instance, column.name) not in self._known:
            left_s = end - time.monotonic()
            if left_s <= 0:
                text = f"its initial value did not come within {self._plan.timeouts.initialize:g} s"
                raise DeadlineExceeded(text, instance=instance, variable=variable)
            self._wait(left_s)
        return element_of(self._known[(instance, column.name)], column, variable)

    def _get_outputs(self, runner: Runner, level: int) -> None:
        """Get the outputs that are known at a level now, and send them to the nodes that need them."""
        names = [name for name, own in runner.plan.initialization.items() if own == level]
        values = dict(zip(names, runner.instance.get_values(names), strict=True))
        self._known.update({(runner.name, name): value for name, value in values.items()})
        for link in runner.out_links:
            if level in needed_levels(link.link):
                link.send_initial(level, values)
