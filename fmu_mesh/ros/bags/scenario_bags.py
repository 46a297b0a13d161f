"""The values of a scenario that come from bags: the same messages at the same times as `fmu_mesh.ros.bags.playing`."""

from __future__ import annotations

from collections.abc import Mapping

from ...config.findings import Findings
from ...config.loading import LoadedConfig
from ...config.scenario_section import ScenarioSource, ScenarioValues
from ...errors import ConfigurationError
from ...system.scenario import BagValues, is_bag
from ...text import listed, nearest
from ...variables.model_description import ModelDescription, Value
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
        places = [f"{source.prefix}values.{reference}" for reference in entries]
        try:
            with Bag(source.resolve(file)) as bag:
                choices = _choices(entries, bag, source.prefix, findings)
                if not choices:
                    continue
                topics = topics_for(loaded, descriptions, bag, choices)
                samples = timed(bag.samples(topics, "log" if stamps == "log" else "header"), start)
        except ConfigurationError as error:
            of_topic = error.message.startswith("`topics=...`: ")
            place = f"{places[0]}.{'topic' if of_topic else 'file'}"
            expected = error.hint or ("another field" if of_topic else "a bag that can be read")
            findings.add(place, error.message.removeprefix("`topics=...`: ").rstrip("."), expected.rstrip("."))
            continue
        pairs: dict[str, list[tuple[float, Value]]] = {}
        for time, sample in samples:
            pairs.setdefault(f"{sample.instance}.{sample.variable}", []).append((time, sample.value))
        for reference, place in zip(entries, places, strict=True):
            if own := pairs.get(reference):
                times, values_ = zip(*own, strict=True)
                found[reference] = BagValues(times, values_)
            elif reference in {f"{port.instance}.{port.variable.name}" for topic in topics for port in topic.ports}:
                findings.add(f"{place}.topic", f"'{entries[reference].topic}' without a message", "a topic with some")
    return found


def _choices(entries: Mapping[str, ScenarioValues], bag: Bag, prefix: str, findings: Findings) -> list[str]:
    """What `fmu-mesh play --topic` would be given for these entries, without those whose topic is not in the bag."""
    choices = []
    for reference, values in entries.items():
        topic = "/" + (values.topic or "").partition(":")[0].lstrip("/")
        if topic in bag.topics:
            choices.append(f"{values.topic}={reference}")
            continue
        found = f"the unknown topic '{topic}' of '{values.file}'"
        expected = f"one of {listed(sorted(bag.topics))}"
        findings.add(f"{prefix}values.{reference}.topic", found, expected, nearest(topic, bag.topics))
    return choices
