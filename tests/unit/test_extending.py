"""A package outside this repository adds a kind of instance, as `docs/extending.md` says; and what can go wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

from fmu_mesh import plugins
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.instances import registry
from tests.helpers import Launched, Place
from tests.planning import parse

ROOT = Path(__file__).resolve().parents[2]
GROUP = "fmu_mesh.instances"

MESH = f"""\
mesh: tabled
simulation: {{stop_time: 1.0, step_size: 0.01}}
instances:
  wave: {{table: wave.csv, between: linear, step_size: 0.02, start_values: {{factor: 2.0}}}}
  steps: {{table: wave.csv}}
  gain: {{fmu: {ROOT}/fmus/Gain.fmu, start_values: {{k: 3.0}}}}
connections: [wave.height -> gain.u]
record: {{file: result.csv}}
"""
TABLE = "time,height,width\n0,0,1\n0.25,1,2\n0.75,-1,3\n1,0,4\n"
FMU_ONLY = "mesh: m\nsimulation: {stop_time: 1, step_size: 0.1}\ninstances: {a: {fmu: a.fmu}}\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the example package is installed in."""
    folder = tmp_path_factory.mktemp("installed")
    options: list[str | Path] = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", folder]
    pip: list[str | Path] = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", *options]
    subprocess.run([*pip, ROOT / "examples" / "extension"], check=True, timeout=240)
    return folder


@pytest.fixture
def mesh(place: Place, installed: Path) -> Path:
    """A configuration with tables, in a place where their package is installed."""
    place.environment["PYTHONPATH"] = os.pathsep.join([str(installed), *filter(None, [os.environ.get("PYTHONPATH")])])
    (place.folder / "wave.csv").write_text(TABLE, encoding="utf-8")
    config = place.folder / "mesh.yaml"
    config.write_text(MESH, encoding="utf-8")
    return config


def changed(config: Path, old: str, new: str) -> None:
    text = config.read_text(encoding="utf-8")
    assert old in text
    config.write_text(text.replace(old, new), encoding="utf-8")


def findings(launched: Launched) -> str:
    assert launched.wait() == 2, launched.output
    return launched.errors


def test_check_shows_an_instance_of_another_package(place: Place, mesh: Path) -> None:
    done = place.run("check", mesh)

    assert done.wait() == 0, done.errors
    assert "wave   wave.csv (a table)" in done.output
    assert "wave.height -> gain.u" in done.output
    assert f"OK: {mesh} can run." in done.output


def test_a_distributed_run_equals_a_run_in_one_process(place: Place, mesh: Path) -> None:
    files = [place.folder / "distributed.csv", place.folder / "local.csv"]

    distributed = place.run("launch", mesh, "--no-progress", "--output", files[0])
    local = place.run("launch", mesh, "--no-progress", "--local", "--output", files[1])

    assert (distributed.wait(), local.wait()) == (0, 0), distributed.errors + local.errors
    assert files[0].read_bytes() == files[1].read_bytes()
    header, *rows = files[0].read_text(encoding="utf-8").splitlines()
    assert header == "time,wave.height,wave.width,steps.height,steps.width,gain.y"
    assert rows[0] == "0.0,0.0,2.0,0.0,1.0,0.0"
    assert rows[50] == "0.5,0.0,5.0,1.0,2.0,0.0"  # wave: linear, times its factor; steps: held
    assert rows[26] == "0.26,1.92,4.04,1.0,2.0,5.76"


def test_a_running_instance_of_another_package_can_be_looked_at_and_set(place: Place, mesh: Path) -> None:
    launched = place.start("launch", mesh, "--no-progress", "--paused")
    assert place.run("wait", "tabled", "--state", "paused").wait() == 0

    info = place.run("info", "wave")
    done = place.run("set", "wave.factor", "4")
    resumed = place.run("resume", "tabled")

    assert "wave (source)" in info.output
    assert (done.wait(), resumed.wait(), launched.wait()) == (0, 0, 0), done.errors + launched.errors
    assert (place.folder / "result.csv").read_text(encoding="utf-8").splitlines()[-1].startswith("1.0,0.0,16.0,")


@pytest.mark.usefixtures("mesh")
def test_the_schema_has_the_section_of_another_package(place: Place) -> None:
    done = place.run("schema")

    definitions = json.loads(done.output)["$defs"]
    references = json.dumps(definitions["Config"]["properties"]["instances"])
    assert "TableConfig" in references
    assert definitions["TableConfig"]["required"] == ["table"]
    assert "Between two rows" in definitions["TableConfig"]["properties"]["between"]["description"]


def test_an_unknown_field_in_the_section_of_another_package_has_usual_finding(place: Place, mesh: Path) -> None:
    changed(mesh, "between: linear", "between_: linear")
    assert (
        "mesh.yaml:4: instances.wave.between_: an unknown key; expected one of table, between, start_values, "
        "step_size, group, host, not_finite. Did you mean 'between'?"
    ) in findings(place.run("check", mesh))


def test_a_slip_in_the_key_of_another_package_is_suggested(place: Place, mesh: Path) -> None:
    changed(mesh, "steps: {table", "steps: {tables")
    assert "instances.steps.tables: an unknown key; expected one of table, between" in findings(
        place.run("check", mesh)
    )


def test_a_model_that_another_package_cannot_read_is_a_finding_about_file(place: Place, mesh: Path) -> None:
    changed(mesh, "steps: {table: wave", "steps: {table: waves")
    told = findings(place.run("check", mesh))
    assert "mesh.yaml:5: instances.steps.table: the table" in told
    assert "expected a CSV file whose first column is `time`" in told
    assert "wave.csv" in told.partition("Did you mean")[2]


def test_another_content_of_its_file_is_another_model(place: Place, mesh: Path) -> None:
    program = "import sys, fmu_mesh; print(fmu_mesh.load(sys.argv[1]).plan().plan.digest)"

    def digest() -> str:
        done = place.start_command([sys.executable, "-c", program, str(mesh)])
        assert done.wait() == 0, done.errors
        return done.output

    before = digest()
    elsewhere = place.folder / "elsewhere.csv"
    elsewhere.write_text(TABLE, encoding="utf-8")
    changed(mesh, "steps: {table: wave.csv", "steps: {table: elsewhere.csv")
    assert digest() == before

    elsewhere.write_text(TABLE.replace("-1", "-2"), encoding="utf-8")
    assert digest() != before


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("table", "json:dumps", ["packages 'fmu-mesh-extension' and 'rival'", "both offer 'table'"]),
        ("broken", "no_such_module:KIND", ["'broken'", "package 'rival'", "No module named 'no_such_module'"]),
        ("broken", "json:dumps", ["'broken'", "'fmu_mesh.instances'", "no kind", "docs/extending.md"]),
    ],
    ids=["a key twice", "a broken package", "something else"],
)
def test_a_package_that_cannot_be_used_is_named(
    place: Place, mesh: Path, name: str, value: str, told: list[str]
) -> None:
    info = place.folder / "rival" / "rival-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rival\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {value}\n", encoding="utf-8")
    place.environment["PYTHONPATH"] += os.pathsep + str(info.parent)
    changed(mesh, "steps: {table", f"steps: {{{name}")

    errors = findings(place.run("check", mesh))

    assert [part for part in told if part.replace(" and ", ", ") not in errors.replace(" and ", ", ")] == [], errors


@pytest.fixture
def forgotten() -> Iterator[Callable[[], None]]:
    """Nothing of the installed packages is known from an earlier test, or in a later one."""

    def forget() -> None:
        plugins._own.cache_clear()
        registry._names.cache_clear()

    forget()
    yield forget
    forget()


@pytest.mark.usefixtures("forgotten")
def test_other_packages_are_looked_for_only_where_a_key_is_not_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    scanned: list[object] = []

    def entry_points(**selected: str) -> list[metadata.EntryPoint]:
        scanned.append(selected)
        return []

    monkeypatch.setattr(metadata, "entry_points", entry_points)

    parse(FMU_ONLY, Path("a.yaml"))
    assert scanned == []
    with pytest.raises(ConfigurationError, match="no key of an installed kind of instance; expected one of the keys"):
        parse(FMU_ONLY.replace("fmu:", "orrery:"), Path("a.yaml"))
    assert scanned == [{"group": GROUP}]


@pytest.mark.usefixtures("forgotten")
def test_installation_older_than_its_source_is_told_how_to_install_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(plugins, "_FILE", "no_such_package-*.dist-info/entry_points.txt")

    with pytest.raises(ConfigurationError, match="older than its source") as caught:
        parse(FMU_ONLY, Path("a.yaml"))
    assert caught.value.hint == f"Install it again, as you did before, from {ROOT}."


def test_a_configuration_is_read_without_the_engines_of_its_kinds() -> None:
    program = (
        "import sys; from pathlib import Path; from fmu_mesh.config.loading import read_text\n"
        "from fmu_mesh.instances.configuration import examine_data\n"
        f"text = {FMU_ONLY!r}.replace('}}}}', '}}, b: {{mujoco: b.xml}}, c: {{gazebo_classic: c.sdf}}}}')\n"
        "examine_data(read_text(text, Path('a')))[1].raise_any()\n"
        "print([name for name in ('fmpy', 'mujoco', 'lxml', 'fmu_mesh.instances.fmi.opening',"
        " 'fmu_mesh.instances.mujoco.mujoco_world', 'fmu_mesh.instances.gazebo.gazebo_world') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
