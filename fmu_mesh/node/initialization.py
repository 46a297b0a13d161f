"""Initialization Mode over the wire: values become known level by level, here and in other nodes (FMI 2.0, 4.2.3)."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection

from ..errors import DeadlineExceeded
from ..model.description import Value
from ..model.plan import Link, NodePlan
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
        self._known: dict[tuple[str, str], float | int] = {}

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
                    value = self._value(feed.source, source, end)
                    values[target] = value if (factor, offset) == (1.0, 0.0) else value * factor + offset
        if values:
            runner.instance.set_values(values)

    def _level_of(self, instance: str, variable: str) -> int:
        if instance in self._own:
            return self._own[instance].initialization[variable]
        link = self._links[instance]
        return link.levels[link.layout.names.index(variable)]

    def _value(self, instance: str, variable: str, end: float) -> float | int:
        while (instance, variable) not in self._known:
            left_s = end - time.monotonic()
            if left_s <= 0:
                text = f"its initial value did not come within {self._plan.timeouts.initialize:g} s"
                raise DeadlineExceeded(text, instance=instance, variable=variable)
            self._wait(left_s)
        return self._known[(instance, variable)]

    def _get_outputs(self, runner: Runner, level: int) -> None:
        """Get the outputs that are known at a level now, and send them to the nodes that need them."""
        names = [name for name, own in runner.plan.initialization.items() if own == level]
        numbers: dict[str, float | int] = {
            name: value
            for name, value in zip(names, runner.instance.get_values(names), strict=True)
            if not isinstance(value, str)
        }
        self._known.update({(runner.name, name): value for name, value in numbers.items()})
        for link in runner.out_links:
            if level in needed_levels(link.link):
                link.send_initial(level, numbers)
