"""Which code may run: that of the user's own configuration; any other only where the user allows it."""

from __future__ import annotations

import grp
import json
import os
import pwd
import sys
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.run import allowed_code
from fmu_mesh.sweeps.planned_sweep import continued_sweep
from fmu_mesh.sweeps.sweep_folder import SweepFolder
from fmu_mesh.sweeps.sweeping import ExecutorSweep
from tests.helpers import FMUS, write_config

CODE = """\
open("ran", "w").close()
import fmu_mesh

@fmu_mesh.component(y=fmu_mesh.Output())
def wave(time, k=1.0):
    return k * time
"""
REFUSED = "Python code, in {}; expected a file of your own, or `allow_code=True`"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wave.py").write_text(CODE, encoding="utf-8")


def config_with(**section: str) -> Path:
    instances = {"wave": {"python": "wave.py:wave", **section}}
    return write_config(Path(), instances=instances, connections=(), stop_time=0.01)


@pytest.mark.parametrize("interpreter", [{}, {"interpreter": sys.executable}], ids=["own", "another"])
def test_a_rerun_runs_code_only_if_it_is_allowed(interpreter: dict[str, str]) -> None:
    fmu_mesh.load(config_with(**interpreter)).run(processes=bool(interpreter))
    Path("ran").unlink()
    told: list[str] = []

    with pytest.raises(fmu_mesh.ConfigurationError) as refused:
        fmu_mesh.rerun("pair.csv")

    assert REFUSED.format("the result 'pair.csv'") in str(refused.value)
    assert not Path("ran").exists()
    apart = bool(interpreter)
    assert len(fmu_mesh.rerun("pair.csv", allow_code=True, on_notice=told.append, processes=apart).times) == 11
    by = f" with {sys.executable}" if interpreter else ""
    runs = f"instance 'wave' runs {Path.cwd()}/wave.py:wave{by}, because of `allow_code=True`"
    assert told == [f"{runs} (Python code, in the result 'pair.csv')"]


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")
def test_what_runs_from_a_converted_file_of_another_user_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    config = config_with()
    os.chown(config, 54321, 54321)

    assert main(["convert", str(config), "own.yaml"]) == 0

    told = f"instance 'wave' runs {Path.cwd()}/wave.py:wave, which this file may name, as it is your own"
    assert f"warning: own.yaml: {told} (Python code, in a file of the user 54321)" in capsys.readouterr().err
    assert not Path("ran").exists()


def test_the_folder_of_a_sweep_cannot_allow_its_own_code() -> None:
    fmu_mesh.sweep(config_with(), {"wave.k": [1.0, 2.0]}, folder="swept", allow_code=True).close()
    noted = json.loads(Path("swept/sweep.json").read_text(encoding="utf-8"))
    assert noted["options"]["allow_code"]
    Path("ran").unlink()

    with pytest.raises(fmu_mesh.ConfigurationError, match="Python code, in the sweep in '/"):
        continued_sweep(Path("swept"))

    assert not Path("ran").exists()
    assert continued_sweep(Path("swept"), allow_code=True).wanted.options["allow_code"]


def test_no_variant_of_a_foreign_sweep_brings_code() -> None:
    config = write_config(Path(), instances={"gain": {"fmu": "Gain"}}, connections=(), stop_time=0.01)
    fmu_mesh.sweep(config, {"gain.k": [1.0, 2.0]}, folder="swept", reduce=["last(gain.y)"]).close()
    own = SweepFolder(Path("swept").absolute())
    wanted = json.loads(own.wanted_file.read_text(encoding="utf-8"))
    code = {"python": f"{Path('wave.py').absolute()}:wave"}
    wanted |= {"names": ["instances.gain"], "variants": [[{"fmu": str(FMUS / "Gain.fmu")}], [code]]}
    own.wanted_file.write_text(json.dumps(wanted), encoding="utf-8")
    for rows in Path("swept").glob("rows*"):
        rows.unlink()

    with ExecutorSweep(continued_sweep(Path("swept"))) as sweep:
        result = sweep.wait()

    assert [row.exit_code for row in result.failed] == [2]
    assert "Python code, in the sweep in" in result.failed[0].message
    assert not Path("ran").exists()


@pytest.mark.parametrize(("place", "mode"), [("wave.py", 0o646), (".", 0o777), ("..", 0o777)])
def test_code_that_others_can_write_is_refused(tmp_path: Path, place: str, mode: int) -> None:
    inner = tmp_path / "outer" / "inner"
    inner.mkdir(parents=True)
    os.chdir(inner)
    Path("wave.py").write_text(CODE, encoding="utf-8")
    config = config_with()
    Path(place).chmod(mode)

    with pytest.raises(fmu_mesh.ConfigurationError) as refused:
        fmu_mesh.load(config).plan()

    there = (inner / place).resolve()
    assert f"other users can write '{there}', which has mode {mode:04o}" in str(refused.value)
    assert f"(`chmod go-w {there}`), or `allow_code=True`" in str(refused.value)
    assert not Path("ran").exists()
    Path(place).chmod(mode | 0o1000 if Path(place).is_dir() else 0o644)  # in a sticky folder, only owners replace files
    fmu_mesh.load(config).plan()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another group")
@pytest.mark.parametrize(("group", "refused"), [(0, False), (54321, False), (54322, True)])
def test_a_group_may_write_code_if_it_is_private(group: int, refused: bool) -> None:  # noqa: FBT001  a column
    config = config_with()
    os.chown("wave.py", 54321, group)  # Debian and Ubuntu give each user a group of the same number
    Path("wave.py").chmod(0o664)

    wrong = fmu_mesh.load(config).check().findings

    assert [finding.path for finding in wrong] == (["instances.wave.python"] if refused else [])


def test_a_group_of_the_users_name_is_private_unless_it_has_members(monkeypatch: pytest.MonkeyPatch) -> None:
    names = type("Entry", (), {"pw_name": "ann", "gr_name": "ann", "gr_mem": ["ann"]})
    shared = type("Entry", (), {"gr_name": "ann", "gr_mem": ["ann", "bob"]})
    monkeypatch.setattr(pwd, "getpwuid", lambda _uid: names)
    found = []

    for group in (names, shared):
        monkeypatch.setattr(grp, "getgrgid", lambda _gid, group=group: group)
        found.append(allowed_code._is_private(2000, 1000))

    assert found == [True, False]
