"""The audit: who joined, set, commanded or was refused, in `mesh/audit` and in the metadata of results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh
from msgspec.structs import asdict

import fmu_mesh
from fmu_mesh import Result
from fmu_mesh.wire.keys import Keys
from fmu_mesh.wire.values import encode_origin
from tests.helpers import DEADLINE_S, Place, wait_until, write_config
from tests.key_meshes import client, key_lines, put_values, stepped_router, written

KEYS = Keys("fmu_mesh", "pair")


def paused(place: Place, record: dict[str, str | None]) -> tuple[Any, Path]:
    config = write_config(
        place.folder, instances={"gain": {"fmu": "Gain"}}, connections=(), stop_time=0.2, record=record
    )
    launched = place.start("launch", config, "--paused", "--no-progress")
    wait_until(lambda: place.run("status", "pair", "--json").output.count("paused"), "a mesh at rest")
    return launched, config


def audit_of(session: zenoh.Session) -> list[dict[str, Any]]:
    [reply] = session.get(KEYS.mesh_key("audit"), timeout=DEADLINE_S)
    assert reply.ok is not None
    found: list[dict[str, Any]] = json.loads(reply.ok.payload.to_bytes())["entries"]
    return found


def set_gain(session: zenoh.Session, value: float, who: str) -> None:
    replies = session.get(
        KEYS.setting("gain", "k"), payload=json.dumps(value), attachment=encode_origin(None, who), timeout=DEADLINE_S
    )
    assert all(reply.ok is not None for reply in replies)


@pytest.mark.parametrize("record", [{"file": "pair.csv"}, {"file": None}])
def test_the_audit_says_who_has_done_what(place: Place, record: dict[str, str | None]) -> None:
    launched, config = paused(place, record)
    with place.session() as session:
        for value in (2.0, 3.0):
            set_gain(session, value, "rig")
        set_gain(session, 4.0, "joystick")
        list(session.get(KEYS.command, payload=b"nonsense", timeout=DEADLINE_S))
        told = audit_of(session)
    assert place.run("resume", "pair").wait() == 0
    assert launched.wait() == 0, launched.story()

    said = [(own["what"], own["who"], own.get("number", 1), own["point"]) for own in told]
    # Values and commands come on threads of their own.
    assert sorted(said) == [("refused", "", 1, 0), ("set", "joystick", 1, 0), ("set", "rig", 2, 0)]
    if record["file"] is not None:
        *first, last = Result.read(config.with_suffix(".csv")).metadata["audit"]["entries"]
        assert first == told
        assert (last["what"], last["text"]) == ("commanded", "resume")


def test_what_a_node_refuses_is_in_audit_log_and_result(place: Place) -> None:
    launched, config = paused(place, {"file": "pair.csv"})
    wrong = {"gain/set/k": (b"nothing", "it is no JSON value"), "gain/set/z": (b"1", "'gain' has no variable 'z'")}
    with place.session() as session:
        for _ in range(3):
            for key, (payload, _reason) in wrong.items():
                [reply] = session.get(
                    f"{KEYS.root}/{key}", payload=payload, attachment=encode_origin(None, "rig"), timeout=DEADLINE_S
                )
                assert reply.err is not None
        session.put(f"{KEYS.root}/gain/in/y", b"1")

        def told() -> list[dict[str, Any]]:
            found = audit_of(session)
            return found if {own["key"].rpartition("/")[2] for own in found} == {"k", "z", "y"} else []

        entries = {own["key"].removeprefix(f"{KEYS.root}/"): own for own in wait_until(told, "three kinds of refusals")}
    log = place.run("logs", "pair").output
    assert place.run("resume", "pair").wait() == 0
    assert launched.wait() == 0, launched.story()

    for key, (_payload, reason) in wrong.items():
        assert (entries[key]["what"], entries[key]["who"], entries[key]["number"]) == ("refused", "rig", 3)
        assert reason in entries[key]["text"]
        assert reason in log
    assert entries["gain/in/y"]["text"] == "'gain' has no variable 'y' under 'in'"
    noted = Result.read(config.with_suffix(".csv")).metadata["audit"]["entries"]
    assert [own for own in noted if own["what"] == "refused"] == [*entries.values()]


def test_logs_show_each_entry_and_with_an_option_all_of_them(place: Place) -> None:
    launched, _ = paused(place, {"file": None})
    with place.session() as session:
        for value in (2.0, 3.0):
            set_gain(session, value, "rig\x1b[2J")
    with fmu_mesh.attach(connect=place.note().endpoints) as run:
        for _ in range(3):
            run.step(2)
        run.pause()
        seen = run.audit()
    log = [line for line in place.run("logs").output.splitlines() if line.startswith("mesh ")]
    audit = place.run("logs", "--audit").output.splitlines()
    entries = [json.loads(line) for line in place.run("logs", "--audit", "--json").output.splitlines()]
    assert place.run("stop", "pair").wait() == 0
    launched.wait()

    key = f"{KEYS.root}/gain/set/k"
    assert f" set: gain.k at {key}" in log[0]
    assert sum(": step at" in line for line in log) == 1
    assert [(own["what"], own["text"], own.get("number", 1)) for own in entries] == [
        ("set", "gain.k", 2),
        ("commanded", "step", 3),
        ("commanded", "pause", 1),
    ]
    assert " at point 0: rig" in audit[0]
    assert audit[0].endswith(f"[2J set: gain.k at {key} (2 times, the last at point 0)")
    assert "(3 times, the last at point 4)" in audit[1]
    assert "\x1b" not in "".join(audit)
    assert [own.text for own in seen.entries] == [own["text"] for own in entries]
    assert asdict(seen)["left_out"] == 0


def test_values_by_the_key_of_another_program_are_one_entry(place: Place) -> None:
    with stepped_router(place) as (_, endpoint):
        config = written(
            place,
            "fed",
            {"gain": {"fmu": "Gain"}},
            [{"key": "plant/flow", "to": "gain.u", "wait": True}],
            zenoh={"connect": [endpoint]},
        )
        launched = place.start("launch", config, "--no-progress")
        with client(endpoint) as session:
            put_values(session, "plant/flow", [float(number) for number in range(250)])
            launched.wait()

    entries = Result.read(config.with_suffix(".csv")).metadata["audit"]["entries"]

    [entry] = [own for own in entries if own["what"] == "set"]
    assert (entry["who"], entry["key"], entry["text"]) == ("", "plant/flow", "gain.u")
    assert entry["number"] == len(key_lines(config.with_suffix(".csv"))) >= 200
