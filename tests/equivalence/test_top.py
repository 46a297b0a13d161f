"""`top` looks at a running mesh until it ends."""

from __future__ import annotations

import json

from tests.helpers import FMUS, Place, wait_until, write_config


def test_top_shows_all_instances_until_the_mesh_ends(place: Place) -> None:
    mesh = place.start("run", "--name", "one", "--no-progress", FMUS / "Gain.fmu")
    config = write_config(place.folder, stop_time=3600.0, simulation={"real_time_factor": 1.0, "step_size": 0.01})
    pair = place.start("launch", config, "--no-progress")
    wait_until(lambda: '"state":"running"' in place.run("status", "pair", "--json").output, "a running mesh")

    several = place.run("top", "--once")
    once = place.run("top", "pair", "--once", "--json")
    following = place.start("top", "pair", "--interval", "0.1")
    wait_until(lambda: following.output.count("pendulum") >= 2, "two looks")
    place.run("stop", "pair")

    assert several.wait() == 2
    assert "2 meshes are running: one, pair" in several.message
    look = json.loads(once.output)
    assert {view["instance"] for view in look["instances"]} == {"delay", "pendulum"}
    assert all(view["running_time"] > 0.0 for view in look["instances"])
    assert following.wait() == 0
    assert following.output.endswith("mesh 'pair' has ended\n")
    assert pair.wait() == 130
    place.run("stop", "one")
    assert mesh.wait() == 0  # it has no stop time
    assert place.run("top").wait() == 2
    place.assert_nothing_left()


def test_watched_variables_have_a_line_and_a_value_in_json(place: Place) -> None:
    config = write_config(place.folder, stop_time=3600.0, simulation={"real_time_factor": 1.0, "step_size": 0.01})
    place.start("launch", config, "--no-progress")
    assert place.run("wait").wait() == 0

    once = place.run("top", "--once", "--watch", "pendulum.a", "delay.*")
    as_json = place.run("top", "--once", "--json", "--watch", "pendulum.a")
    unknown = place.run("top", "--watch", "pendulum.b")
    following = place.start("top", "--interval", "0.1", "--watch", "pendulum.a", "--json")
    wait_until(lambda: following.output.count("\n") >= 3, "three looks")
    place.run("stop")

    names = [line.split()[0] for line in once.output.splitlines() if "." in line.partition(" ")[0]]
    assert names[0] == "pendulum.a"
    assert {"delay.x", "delay.y"} < {*names}
    [value] = json.loads(as_json.output)["values"]
    assert (value["name"], value["unit"]) == ("pendulum.a", "rad")
    assert unknown.wait() == 2
    assert "instance 'pendulum' has no variable 'b'" in unknown.message
    assert following.wait() == 0
    points = [json.loads(line)["values"][0]["point"] for line in following.output.splitlines()]
    assert points == sorted(points)
    assert points[-1] > points[0]
