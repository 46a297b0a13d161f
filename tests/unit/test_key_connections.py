"""Entries of `connections` with a Zenoh key: what is wrong with them is said before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

import fmu_mesh
from fmu_mesh.errors import ConfigurationError, Finding
from tests.fmus.helpers import NO_COMPILER, build_test_fmu
from tests.helpers import FMUS


def checked(tmp_path: Path, *connections: object) -> Sequence[Finding]:
    """What is wrong with a gain and an FMU with arrays and all types."""
    if NO_COMPILER is not None:
        pytest.skip(NO_COMPILER)
    config = {
        "mesh": "live",
        "simulation": {"stop_time": 1.0, "step_size": 0.1},
        "instances": {
            "gain": {"fmu": str(FMUS / "Gain.fmu")},
            "other": {"fmu": str(FMUS / "Gain.fmu")},
            "all": {"fmu": str(build_test_fmu("AllTypes3", tmp_path))},
        },
        "connections": list(connections),
    }
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(config))
    error = fmu_mesh.load(tmp_path / "live.yaml").check().error
    return error.findings if error is not None else ()


IN: dict[str, Any] = {"key": "plant/u", "to": "gain.u"}
OUT: dict[str, Any] = {"from": "gain.y", "key": "twin/y"}
CDR = {"encoding": "cdr", "type": "std_msgs/msg/Float64"}

WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    ({**IN, "key": "plant/*/u"}, "one key, or `take: newest` as well"),
    ({**IN, "key": "plant/**", "take": "newest", "wait": True, "time": "t"}, "true for a key with a wildcard"),
    ({**IN, "key": "/plant"}, "a Zenoh key such as plant/pump/flow"),
    ({**IN, "key": "plant//u"}, "a Zenoh key such as plant/pump/flow"),
    ({**IN, "key": "plant/u?x"}, "a Zenoh key such as plant/pump/flow"),
    ({**IN, "to": "gain.v"}, "the unknown variable 'v'"),
    ({**IN, "to": "gain.y"}, "an input that is not connected, or a tunable parameter"),
    ({**IN, "to": "all.float64_array_in[1,1]"}, "an element of an array"),
    ({**IN, "field": "a..b"}, "a path such as sensors[0].value"),
    ({**IN, "field": "a[x]"}, "a path such as sensors[0].value"),
    ({**IN, "time": "t["}, "a path such as sensors[0].value"),
    ({**IN, "delay": 0.1}, "`time: timestamp`, or a field with the time"),
    ({**IN, "interpolation": "linear"}, "`time: timestamp`, or a field with the time"),
    ({**IN, "origin": "first"}, "`time: timestamp`, or a field with the time"),
    ({**IN, "time": "t", "origin": "noon"}, "first, seconds, or a time such as"),
    ({**IN, "time": "t", "delay": -1.0}, "a time >= 0 in s"),
    ({**IN, "encoding": "cdr"}, "`encoding: cdr` without a type"),
    ({**IN, "type": "std_msgs/msg/Float64"}, "a type for `encoding: auto`"),
    ({**IN, **CDR, "time": "stamp"}, "arrival, timestamp or header.stamp"),
    ({**IN, **CDR, "type": "std_msgs/msg/Flowt64"}, "std_msgs/msg/Flowt64"),
    ({**IN, **CDR, "field": "nothing"}, "nothing"),
    ({**IN, "encoding": "float64", "field": "value"}, "the field 'value' of doubles, which have none"),
    ({**IN, "encoding": "float64", "time": "t"}, "the field 't' of doubles, which have none"),
    ({**IN, "to": "all.int8_in", "encoding": "float64"}, "a Float64"),
    ({**IN, "to": "all.int8_in", "factor": 2.0}, "factor and offset of Real only"),
    ({**IN, "to": "all.int8_in", "time": "t", "interpolation": "linear"}, "inputs of type Real may be linear"),
    ({**IN, "to": "all.enumeration_in", "map": {"off": "lov"}}, "low"),
    ({**IN, "to": "all.float64_array_in", "map": {"off": 1}}, "a map for a scalar"),
    ({**IN, "map": {"off": 1}, "factor": 2.0}, "one of the two"),
    ({**IN, "unit": "furlong"}, "furlong"),
    ({**OUT, "key": "twin/*"}, "one key, without wildcards"),
    ({**OUT, "key": "fmu_mesh/live/gain/out/y"}, "not below fmu_mesh/live/"),
    ({**OUT, "every": 0.15}, "a multiple of the step size 0.1 s"),
    ({**OUT, "from": "all.int8_out", "factor": 2.0}, "factor and offset of Real only"),
    ({**OUT, "field": "data"}, "`encoding: cdr`"),
    ({**OUT, "from": "all.string_out", "encoding": "float64"}, "a Float64"),
)


@pytest.mark.parametrize(("entry", "said"), WRONG, ids=lambda one: one if isinstance(one, str) else "")
def test_a_wrong_entry_is_one_finding(entry: dict[str, Any], said: str, tmp_path: Path) -> None:
    findings = checked(tmp_path, "other.y -> all.float64_in", entry)

    assert len(findings) == 1, findings
    assert said in str(findings[0])
    assert "connections[1]" in str(findings[0])


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ((IN, {**IN, "key": "plant/v"}), "key plant/u"),
        (("other.y -> gain.u", IN), "other"),
        ((OUT, {**OUT, "from": "other.y"}), "a key of its own for each output"),
    ],
)
def test_two_entries_do_not_share_an_end(entries: tuple[object, ...], said: str, tmp_path: Path) -> None:
    findings = checked(tmp_path, *entries)

    assert len(findings) == 1, findings
    assert said in str(findings[0])


def test_right_entries_have_no_finding(tmp_path: Path) -> None:
    entries = (
        {**IN, "key": "plant/*/u", "take": "newest", "field": "[name=flow].v", "time": "timestamp", "delay": 0.2},
        {"key": "plant/k", "to": "gain.k", **CDR},
        {"key": "plant/e", "to": "all.enumeration_in", "map": {"on": "high", "off": "low"}},
        {"key": "plant/a", "to": "all.float64_array_in", "encoding": "float64", "factor": 2.0},
        {"key": "plant/n", "to": "all.float32_in", "time": "t", "interpolation": "linear", "wait": True},
        OUT,
        {**OUT, "from": "all.float64_array_out[1,2]", "key": "twin/a", **CDR, "every": 0.3, "on": "change"},
        {**OUT, "from": "all.string_out", "key": "twin/s", "encoding": "text", "congestion": "block"},
    )

    assert checked(tmp_path, *entries) == ()


def test_a_run_with_a_wrong_entry_does_not_start(tmp_path: Path) -> None:
    mesh = fmu_mesh.Mesh("live", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.configure(connections=[{**IN, "key": "plant/**"}])

    with pytest.raises(ConfigurationError, match="take: newest"):
        mesh.run(output=tmp_path / "none.csv")
    assert not list(tmp_path.iterdir())
