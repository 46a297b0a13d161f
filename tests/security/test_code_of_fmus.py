"""The code that FMUs bring: who has to name it until a compiler reads it, and what a sandbox keeps from it."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.fmus.helpers import FMUS, NO_COMPILER
from tests.fmus.packing import repacked, without_binaries
from tests.helpers import PAIR, Place, rows_of, write_config

pytest.importorskip("cryptography")
from fmu_mesh.wire.security.authority import Authority

pytestmark = pytest.mark.skipif(NO_COMPILER is not None, reason=str(NO_COMPILER))

SANDBOX = {"sandbox": "bubblewrap"}
NEEDS_SANDBOX = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")

_LOOKS = """
from pathlib import Path
import fmu_mesh

class Looks(fmu_mesh.Component):
    keys = fmu_mesh.Output(start=-1.0)

    def step(self, time, step_size):
        self.keys = float(sum(map(can_read, Path(__file__).parent.glob("lab/**/*key*"))))

def can_read(path):
    try:
        return "PRIVATE" in path.read_text()
    except OSError:
        return False
"""


@pytest.fixture
def ours(place: Place) -> Callable[[], int]:
    """How often a compiler was started since the last call, in a place with a cache of its own."""
    log, compiler = place.folder / "compiled", place.folder / "compiler"
    compiler.write_text(f'#!/bin/sh\necho >> "{log}"\nexec {shutil.which("cc")} "$@"\n')
    compiler.chmod(0o755)
    place.environment |= {"CC": str(compiler), "FMU_MESH_CACHE_DIR": str(place.folder / "cache")}

    def count() -> int:
        started = log.read_text().count("\n") if log.exists() else 0
        log.unlink(missing_ok=True)
        return started

    return count


def with_sources(place: Place) -> Path:
    """A configuration with an FMU that has sources only, beside it."""
    without_binaries(place.folder / "plant.fmu")
    instances = {"plant": {"fmu": "plant.fmu", "start_values": {"u": 3.0}}}
    return write_config(place.folder, instances=instances, connections=[], stop_time=0.01)


@pytest.mark.parametrize(
    ("command", "compiles"),
    [
        ("inspect plant.fmu", 0),
        ("new .", 0),
        ("new plant.fmu", 1),
        ("check pair.yaml", 1),
        ("launch pair.yaml --no-progress", 1),
        ("simulate plant.fmu --stop-time 0.1 --step-size 0.01 --no-progress", 1),
    ],
)
def test_a_compiler_reads_only_what_was_named(
    place: Place, ours: Callable[[], int], command: str, compiles: int
) -> None:
    shutil.copy(FMUS / "Gain.fmu", place.folder)
    with_sources(place)

    done = place.run(*command.split())

    assert done.wait() == 0, done.story()
    assert ours() == compiles


@pytest.mark.parametrize("line", ["launch pair.yaml --set plant.", "inspect plant.fmu --variables "])
def test_completion_compiles_nothing(place: Place, ours: Callable[[], int], line: str) -> None:
    with_sources(place)
    offered, typed = place.folder / "offered", f"fmu-mesh {line}"
    place.environment |= {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(offered)}
    place.environment |= {"COMP_LINE": typed, "COMP_POINT": str(len(typed)), "COMP_TYPE": "9"}

    place.run()

    assert any(one.strip("=").rpartition(".")[2] == "k" for one in offered.read_text().split("\v"))
    assert ours() == 0


@pytest.mark.parametrize(
    ("make", "command", "source"),
    [
        ("convert pair.yaml pair.ssp", "check pair.ssp", "a package of SSP"),
        ("launch pair.yaml --no-progress", "rerun pair.csv --no-progress", "the result 'pair.csv'"),
        (
            "sweep pair.yaml --vary plant.u=1:2:2 --folder swept --no-progress",
            "sweep swept --no-progress",
            "the sweep in",
        ),
    ],
    ids=["package", "result", "sweep"],
)
def test_what_comes_from_elsewhere_is_compiled_only_if_it_is_allowed(
    place: Place, ours: Callable[[], int], make: str, command: str, source: str
) -> None:
    with_sources(place)
    made = place.run(*make.split())
    assert made.wait() == 0, made.story()
    assert place.run(*command.split()).wait() == 0  # it is in the cache
    shutil.rmtree(place.folder / "cache")
    ours()

    refused = place.run(*command.split())

    assert refused.wait() == 2, refused.story()
    assert f"instances.plant.fmu: sources to compile, in {source}" in refused.errors
    assert "expected a binary for this platform, or `--allow-code`" in refused.errors
    assert ours() == 0
    allowed = place.run(*command.split(), "--allow-code")
    assert allowed.wait() == 0, allowed.story()
    assert "plant.fmu' has no binary for this platform" in allowed.errors
    assert ours() == 1


@NEEDS_SANDBOX
def test_sources_are_compiled_in_the_sandbox_of_their_node(place: Place) -> None:
    config, name, secret = with_sources(place), "sources/Gain.c", place.folder / "secret"
    secret.write_text("")
    place.environment["FMU_MESH_CACHE_DIR"] = str(place.folder / "cache")
    assert place.run("launch", config, "--no-progress").wait() == 0
    expected = rows_of(config.with_suffix(".csv"))
    shutil.rmtree(place.folder / "cache")
    with zipfile.ZipFile(place.folder / "plant.fmu") as archive:
        looking = f'#if __has_include("{secret}")\n#error the secret is there\n#endif\n'.encode() + archive.read(name)
    plain = (place.folder / "plant.fmu").rename(place.folder / "plain.fmu")
    repacked(place.folder / "plant.fmu", source=plain, keep=lambda own: own != name, add={name: looking})

    outside = place.run("check", config)
    inside = place.run("launch", config, "--set-config", "process.sandbox=bubblewrap", "--no-progress")

    assert outside.wait() == 2
    assert "the secret is there" in outside.errors
    assert inside.wait() == 0, inside.story()
    assert rows_of(config.with_suffix(".csv")) == expected
    assert not list((place.folder / "cache").rglob("*.so"))
    place.assert_nothing_left()


@NEEDS_SANDBOX
@pytest.mark.parametrize("sandboxed", [True, False])
def test_a_sandbox_has_no_key_of_a_certificate(place: Place, *, sandboxed: bool) -> None:
    lab = Authority.made(place.folder / "lab")
    lab.add("host1", "node", 1.0, ["localhost"])
    lab.add("alice", "operator", 1.0)
    (place.folder / "looks.py").write_text(_LOOKS)
    instances = {**PAIR, "looks": {"python": "looks.py:Looks"}}
    plain = write_config(place.folder, instances=instances, name="plain")
    sections: dict[str, Any] = {"process": SANDBOX} if sandboxed else {}
    listening, security = {"listen": ["tls/127.0.0.1:0"]}, {"folder": "lab/host1"}
    boxed = write_config(place.folder, instances=instances, zenoh=listening, security=security, **sections)
    assert place.run("launch", plain, "--no-progress").wait() == 0

    launched = place.run("launch", boxed, "--no-progress")

    assert launched.wait() == 0, launched.story()
    assert "tls/127.0.0.1:" in launched.errors
    rows, expected = rows_of(boxed.with_suffix(".csv")), rows_of(plain.with_suffix(".csv"))
    assert rows[-1][-1] == (0.0 if sandboxed else 3.0)
    assert expected[-1][-1] == 3.0
    assert [row[:-1] for row in rows] == [row[:-1] for row in expected]
    place.assert_nothing_left()
