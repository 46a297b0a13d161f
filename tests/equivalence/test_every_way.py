"""Every system by streams, by Zenoh, and mixed: the result of processes is that of one process in every byte."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import yaml

from fmu_mesh.run.options import PlanOptions
from fmu_mesh.system.plan import RECORDER
from tests.all_systems import FEATURES, SYSTEMS, written_system
from tests.helpers import BY_STREAMS, BY_ZENOH, Launched, Place, row_count, wait_until
from tests.network_hosts import NEEDS_HOSTS, started_apart, started_hosts
from tests.plain_run import PlainRun
from tests.planning import prepare


def in_one_process(config: Path) -> bytes:
    """The result of a configuration in the plainest way."""
    output = config.with_name("local.csv")
    PlainRun(prepare(config, PlanOptions(output=output))).run()
    return output.read_bytes()


@pytest.mark.parametrize("way", [BY_STREAMS, BY_ZENOH], ids=["streams", "zenoh"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_gives_its_floats(place: Place, name: str, way: Mapping[str, bool]) -> None:
    config = written_system(name, place.folder / "system", zenoh=way)

    launched = place.run("launch", config, "--no-progress")

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == in_one_process(config)


@NEEDS_HOSTS
@pytest.mark.parametrize("name", [*FEATURES, "pendulum_delay", "cycle2", "chain8"])
def test_every_system_gives_its_floats_on_two_hosts(tmp_path: Path, name: str) -> None:
    """Nodes of one host share its memory; rows to the other host go by streams, and text by Zenoh.

    `test_cuts` does this with all examples, and cuts the network meanwhile.
    """
    with started_hosts(tmp_path) as hosts:
        configs = [written_system(name, host.folder / "own-clone" / "system") for host in hosts]
        nodes = [node for node in prepare(configs[0]).nodes if node != RECORDER]

        by_hand = started_apart(hosts, Path("system", "system.yaml"), nodes)

        assert [one.wait() for one in by_hand] == [0] * len(by_hand), "".join(one.story() for one in by_hand)
        assert configs[0].with_suffix(".csv").read_bytes() == in_one_process(configs[1])


def steered(result: Path, command: Callable[..., Launched]) -> None:
    """Set a parameter while a mesh is paused, and let it go on, pause and go on."""
    wait_until(lambda: command("set", "gain.k", "3.0", "--at", "1.5").wait() == 0, "a mesh that is there")
    wait_until(lambda: command("resume", "system").wait() == 0, "a mesh that is ready")
    wait_until(lambda: row_count(result) > 100, "100 rows")
    assert command("pause", "system").wait() == 0
    assert command("resume", "system").wait() == 0


def without_scenario(config: Path) -> bytes:
    """Take the scenario from a configuration; return the result with it."""
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    expected = in_one_process(config)
    del content["scenario"]
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    assert in_one_process(config) != expected
    return expected


@pytest.mark.parametrize("way", [BY_STREAMS, BY_ZENOH], ids=["streams", "zenoh"])
def test_pause_and_set_equal_a_scenario(place: Place, way: Mapping[str, bool]) -> None:
    config = written_system("set", place.folder / "system", lasts_s=10.0, zenoh=way)
    expected = without_scenario(config)

    launched = place.start("launch", config, "--no-progress", "--paused")
    steered(config.with_suffix(".csv"), place.start)

    assert launched.wait() == 0, launched.story()
    assert config.with_suffix(".csv").read_bytes() == expected


@NEEDS_HOSTS
def test_pause_and_set_over_two_hosts_equal_a_scenario(tmp_path: Path) -> None:
    with started_hosts(tmp_path) as (first, second):
        configs = [
            written_system("set", host.folder / "own-clone" / "system", lasts_s=10.0) for host in (first, second)
        ]
        expected, _ = map(without_scenario, configs)

        by_hand = started_apart(
            (first, second), Path("system", "system.yaml"), ["pendulum", "gain", "integral"], "--paused"
        )
        steered(
            configs[0].with_suffix(".csv"),
            lambda *command: second.start("fmu-mesh", *command, "--connect", "tcp/router:7447", "--insecure"),
        )

        assert [one.wait() for one in by_hand] == [0] * 4, "".join(one.story() for one in by_hand)
        assert configs[0].with_suffix(".csv").read_bytes() == expected
