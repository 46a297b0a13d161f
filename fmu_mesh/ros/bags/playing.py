"""Playing a bag: recorded values are set on the inputs of a running mesh, each at the point of its stamp.

Owns which sample belongs to which communication point. The mesh is paused at that point while the values are set. So
the result depends on the bag alone, and not on the speed of any process.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

from ...config.loading import LoadedConfig
from ...errors import ConfigurationError, MeshLost
from ...instances.configuration import examine_data
from ...simtime import ENDLESS, TimeGrid
from ...ssp.configuration_files import read_configuration
from ...system.scenario import BAG_STAMP_S
from ...variables.model_description import Value
from ...wire.client.mesh_client import MeshClient
from ...wire.client.readings import Target
from ...wire.client.waiting import go_on, paused_at, wait_until_at
from ...wire.views import Command, MeshInfo
from ..gateway.mapping import descriptions_of
from .bag import Bag, BagSample, timed, topics_for
from .play_options import PlayOptions

__all__ = ["Moment", "Played", "grid_of", "play", "play_bag", "running_configuration", "schedule"]


class Played(msgspec.Struct, frozen=True):
    """What has been played of a bag.

    Attributes:
        values: number of values that were set.
        topics: their topics.
        first: point of the first value.
        last: point of the last one.
        merged: number of values that were followed by another one for the same point.
        past: number of values for points that were past already, and followed by another one.
        beyond: number of values at or after the end of the simulation.
    """

    values: int
    topics: list[str]
    first: int
    last: int
    merged: int
    past: int
    beyond: int


def play_bag(client: MeshClient, bag: Bag, loaded: LoadedConfig | None, options: PlayOptions) -> Played:
    """Play a bag to a mesh.

    The configuration of the mesh is that of ``options``, else ``loaded``, else in the file that the mesh names.

    Raises:
        ConfigurationError: the bag has no message of these topics before the end of the simulation.
    """
    mesh = client.info()
    infos = {name: client.instance_info(name) for name in mesh.instances}
    step_points = {name: round(info.step_size / mesh.step_size) for name, info in infos.items()}
    if loaded is None or options.config is not None:
        loaded = running_configuration(Path(options.config or mesh.config))
    topics = topics_for(loaded, descriptions_of(infos), bag, options.topics)
    samples = bag.samples(topics, options.stamps)
    point = client.status().point
    moments, merged, beyond = schedule(samples, grid_of(mesh), step_points, start=options.start, point=point)
    names = [topic.name for topic in topics]
    if not moments and beyond:
        why = "at or after the end of the simulation" if mesh.stop_time is not None else "at no simulation time"
        raise ConfigurationError(
            f"all {beyond} values of {', '.join(names)} in '{bag.path}' are {why}.",
            hint="Say when the first one is, as with `start=0.0`.",
        )
    if not moments:
        raise ConfigurationError(f"no message of {', '.join(names)} in '{bag.path}' has a value for the mesh.")
    count, first = play(client, moments, step_points, options.timeout)
    past = sum(len(moment.values) for moment in moments) - count
    return Played(count, names, first, moments[-1].point, merged, past, beyond)


def running_configuration(path: Path) -> LoadedConfig:
    """The configuration of a mesh that runs, from a YAML file or a package of SSP; an option may have given its times.

    Raises:
        ConfigurationError: it cannot be read, or something else in it is wrong.
    """
    loaded, findings = examine_data(read_configuration(path))
    if any(finding.path.partition(".")[0] != "simulation" for finding in findings):
        findings.raise_any()
    return loaded


class Moment(msgspec.Struct, frozen=True):
    """The values that are set at one point, by (instance, variable)."""

    point: int
    values: dict[tuple[str, str], Value]


def grid_of(info: MeshInfo) -> TimeGrid:
    """The communication points of a running mesh."""
    if info.stop_time is None:
        return TimeGrid(info.start_time, info.step_size, ENDLESS)
    return TimeGrid(info.start_time, info.step_size, round((info.stop_time - info.start_time) / info.step_size))


def schedule(
    samples: Iterable[BagSample], grid: TimeGrid, step_points: Mapping[str, int], *, start: float | None, point: int = 0
) -> tuple[list[Moment], int, int]:
    """Find the point of every sample.

    A value is set at the first point of its instance that is not before its stamp. If an input has several values for
    one point, the last one is set. An instance has ``step_points`` points per step; ``start`` is that of `timed`; the
    mesh is at ``point``.

    Returns:
        The moments in order of their points, the number of samples that a later one replaced, and the number of samples
        at or after the last point, or at no time of the simulation (`TimeGrid.latest`).
    """
    moments: dict[int, dict[tuple[str, str], Value]] = {}
    merged, beyond, latest = 0, 0, grid.latest(point, streamed=False)
    for time_s, sample in timed(samples, start):
        points = step_points[sample.instance]
        point = grid.step_at(time_s, points, BAG_STAMP_S) * points
        if time_s > latest or point >= grid.last_point:
            beyond += 1
            continue
        values = moments.setdefault(point, {})
        merged += (sample.instance, sample.variable) in values
        values[sample.instance, sample.variable] = sample.value
    return [Moment(point, moments[point]) for point in sorted(moments)], merged, beyond


def play(
    client: MeshClient, moments: Sequence[Moment], step_points: Mapping[str, int], timeout_s: float
) -> tuple[int, int]:
    """Set all values on a mesh: let it run to each moment, pause it there, set the values; at the end let it run on.

    If the mesh is past a moment already, its values are set at once; for each input the last one counts. The moments
    are in the order of their points. It may stay at one point for ``timeout_s`` before it reaches the next moment.

    Returns:
        The number of values that were set, and the point of the first one.

    Raises:
        ConfigurationError: a value was refused.
        MeshLost: the mesh has ended, or another program controls it too.
        DeadlineExceeded: the mesh does not reach the next moment.
    """
    hold = paused_at(client, Command("pause"))
    together = math.lcm(*step_points.values())  # where every instance has a point of its own
    hold = go_on(client, hold, -(-hold // together) * together)
    targets: dict[tuple[str, str], Target] = {}
    first, count = hold, 0
    past = {key: value for moment in moments if moment.point <= hold for key, value in moment.values.items()}
    later = [moment for moment in moments if moment.point > hold]
    for moment in [Moment(hold, past), *later] if past else later:
        hold = go_on(client, hold, moment.point)
        for instance in {instance for instance, _ in moment.values}:
            wait_until_at(client, instance, hold, timeout_s)
        for (instance, variable), value in moment.values.items():
            key = (instance, variable)
            if key not in targets:
                targets[key] = client.target(f"{instance}.{variable}")
            answer = client.set(targets[key], value)
            if answer.point != hold:
                raise MeshLost(f"the value for point {hold} came to '{instance}.{variable}' at point {answer.point}.")
            count += 1
    client.command(Command("resume"))
    return count, first
