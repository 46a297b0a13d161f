"""Following a mesh: what is its end, and what is not."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from fmu_mesh.errors import DeadlineExceeded
from fmu_mesh.wire.client.following import Follower
from fmu_mesh.wire.keys import Keys
from fmu_mesh.wire.session import Wiring, open_session
from tests.helpers import DEADLINE_S

KEYS = Keys("fmu_mesh", "pair")
AGAIN = cast("zenoh.Sample", SimpleNamespace(kind=zenoh.SampleKind.PUT))
"""What Zenoh tells a client a second time, now and then: that the token is there."""


def test_mesh_announced_twice_has_not_ended_and_its_end_is_one(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/mesh.sock"
    with open_session(Wiring(listen=(endpoint,))) as mesh, open_session(Wiring("client", connect=(endpoint,))) as tool:
        token = mesh.liveliness().declare_token(KEYS.master)
        with Follower[int](tool, KEYS) as follower:
            assert follower.there.wait(DEADLINE_S)

            follower._token_changed(AGAIN)
            follower.arrived.put(1)

            with pytest.raises(DeadlineExceeded):
                assert list(follower.to_the_last(time.monotonic())) == [1]

            token.undeclare()
            assert list(follower.to_the_last()) == []
