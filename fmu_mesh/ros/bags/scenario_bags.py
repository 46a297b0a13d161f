"""The values of a scenario that come from bags: the same messages at the same times as `fmu_mesh.ros.bags.playing`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.scenario_section import ScenarioSource, ScenarioValues
from ...errors import ConfigurationError
from ...system.scenario import BagValues, is_bag
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Value
from ..messages.topics import Topic
from .bag import Bag, timed, topics_for

__all__ = ["bag_values"]

_Key = tuple[str, str, float | None]
"""File, stamps, and the time of the first message."""


def bag_values(
    source: ScenarioSource, loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Findings
) -> dict[str, BagValues]:
    """Read the bags of a scenario; the result has the values by `instance.variable`, in the order of their times.

    Args:
        source: the scenario.
        loaded: the configuration, whose section `ros` has the message types.
        descriptions: the model descriptions by instance name. What refers to no variable of them is left out.
        findings: where everything goes that is wrong with a bag.
    """
    wanted: dict[_Key, dict[str, ScenarioValues]] = {}
    for reference, values in source.config.values.items():
        instance, _, name = reference.partition(".")
        known = instance in descriptions and descriptions[instance].variable(name) is not None
        if isinstance(values, ScenarioValues) and values.file and values.topic and is_bag(values) and known:
            key = values.file, values.stamps or "header", values.start
            wanted.setdefault(key, {})[reference] = values
    found: dict[str, BagValues] = {}
    for (file, stamps, start), entries in wanted.items():
        places = {reference: f"{source.prefix}values.{reference}" for reference in entries}
        try:
            with Bag(source.resolve(file)) as bag:
                find = partial(topics_for, loaded, descriptions, bag)
                topics = _topics(entries, bag, find, source.prefix, findings)
                samples = timed(bag.samples(topics, "log" if stamps == "log" else "header"), start)
        except ConfigurationError as error:
            _add(f"{next(iter(places.values()))}.file", error, "a bag that can be read", findings)
            continue
        pairs: dict[str, list[tuple[float, Value]]] = {}
        for time, sample in samples:
            pairs.setdefault(f"{sample.instance}.{sample.variable}", []).append((time, sample.value))
        for reference, place in places.items():
            if own := pairs.get(reference):
                times, values_ = zip(*own, strict=True)
                found[reference] = BagValues(times, values_)
            elif reference in {f"{port.instance}.{port.variable.name}" for topic in topics for port in topic.ports}:
                findings.add(f"{place}.topic", f"'{entries[reference].topic}' without a message", "a topic with some")
    return found


def _add(place: str, error: ConfigurationError, expected: str, findings: Findings) -> None:
    found = error.message.removeprefix("`topics=...`: ").rstrip(".")
    findings.add(place, found, (error.hint or expected).rstrip("."))


def _topics(
    entries: Mapping[str, ScenarioValues],
    bag: Bag,
    find: Callable[[list[str]], list[Topic]],
    prefix: str,
    findings: Findings,
) -> list[Topic]:
    """The topics of all entries, each as for `fmu-mesh play --topic`, and a finding for each entry without one."""
    topics: list[Topic] = []
    for reference, values in entries.items():
        topic, place = "/" + (values.topic or "").partition(":")[0].lstrip("/"), f"{prefix}values.{reference}.topic"
        if topic not in bag.topics:
            found, expected = f"the unknown topic '{topic}' of '{values.file}'", f"one of {listed(sorted(bag.topics))}"
            findings.add(place, found, expected, nearest(topic, bag.topics))
            continue
        try:
            topics += find([f"{values.topic}={reference}"])
        except ConfigurationError as error:
            _add(place, error, "another field", findings)
    return topics
