"""FMUs inside archives: the result is that of the same FMUs as files, and nothing is left of them."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import yaml

import fmu_mesh
from tests.equivalence.reference import reference_of
from tests.equivalence.test_equivalence import (
    CHAPTER,
    GAUSS_SEIDEL,
    assert_result,
    in_this_process,
    launched,
    rewritten,
    shortened,
)
from tests.fmus.packing import without_binaries
from tests.helpers import FMUS, Place


def test_fmus_inside_an_archive_and_inside_archive_in_it_give_same_floats(place: Place) -> None:
    config = rewritten(CHAPTER, place.folder, shortened(800, GAUSS_SEIDEL))
    reference = reference_of(config, {"pendulum.a -> delay.x": 0})
    plain = in_this_process(place, config)
    _pack(config)

    content = launched(place, config)

    assert_result(content, reference)
    assert content == plain == in_this_process(place, config)
    place.assert_nothing_left()


def test_nodes_that_are_started_manually_open_the_archive_themselves(place: Place) -> None:
    config = rewritten(CHAPTER, place.folder, shortened(400, GAUSS_SEIDEL))
    plain = in_this_process(place, config)
    _pack(config)
    nodes = yaml.safe_load(config.read_text(encoding="utf-8"))["instances"]
    output = place.folder / "result.csv"

    started = [
        place.start("master", config, "--output", output),
        *(place.start("node", config, name) for name in nodes),
    ]

    assert [process.wait() for process in started] == [0] * len(started), place.story()
    assert output.read_bytes() == plain
    place.assert_nothing_left()


def test_the_source_of_an_fmu_inside_an_archive_is_compiled_for_run(place: Place) -> None:
    place.environment["FMU_MESH_CACHE_DIR"] = str(place.folder / "cache")
    bare = without_binaries(place.folder / "bare.fmu").read_bytes()
    with zipfile.ZipFile(place.folder / "system.ssp", "w") as archive:
        archive.writestr("resources/gain.fmu", bare)

    # A mesh of this one FMU, with its own step size.
    ran = place.run("run", place.folder / "system.ssp/resources/gain.fmu", "--stop-time", "0.1", "--step-size", "0.01")

    assert ran.wait() == 0, ran.errors
    assert "compiling its sources" in ran.errors


def test_inspect_shows_an_fmu_inside_an_archive(place: Place) -> None:
    with zipfile.ZipFile(place.folder / "system.ssp", "w") as archive:
        archive.write(FMUS / "Gain.fmu", "resources/gain.fmu")
    path = place.folder / "system.ssp/resources/gain.fmu"

    shown = json.loads(place.run("inspect", path, "--json").output)
    missing = place.run("inspect", place.folder / "system.ssp/resources/gian.fmu")

    plain: Any = fmu_mesh.inspect(FMUS / "Gain.fmu")
    assert (shown["sha256"], shown["bytes"], shown["runs_here"]) == (plain.sha256, plain.bytes, True)
    assert missing.wait() == 2
    assert "Did you mean 'resources/gain.fmu'?" in missing.errors


def _pack(config: Path) -> None:
    """Move the FMUs of a configuration into an archive: the last one into an archive inside it."""
    content = yaml.safe_load(config.read_text(encoding="utf-8"))
    *first, last = content["instances"].values()
    with zipfile.ZipFile(config.with_name("inner.ssp"), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(last["fmu"], "resources/last.fmu")
    with zipfile.ZipFile(config.with_name("system.ssp"), "w") as archive:
        for number, instance in enumerate(first):
            archive.write(instance["fmu"], f"resources/{number}.fmu")
            instance["fmu"] = f"system.ssp/resources/{number}.fmu"
        archive.write(config.with_name("inner.ssp"), "resources/inner.ssp")
    last["fmu"] = "system.ssp/resources/inner.ssp/resources/last.fmu"
    config.with_name("inner.ssp").unlink()
    config.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
