"""The audit: who joined, set, commanded or was refused, in `mesh/audit` and in the metadata of results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fmu_mesh import Result
from fmu_mesh.wire.keys import Keys
from fmu_mesh.wire.values import encode_origin
from tests.helpers import DEADLINE_S, Place, wait_until, write_config

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
    assert said == [("set", "rig", 2, 0), ("set", "joystick", 1, 0), ("refused", "", 1, 0)]
    if record["file"] is not None:
        *first, last = Result.read(config.with_suffix(".csv")).metadata["audit"]["entries"]
        assert first == told
        assert (last["what"], last["text"]) == ("commanded", "resume")
