"""The master sleeps while it waits: it would take a processor from the nodes that it waits for."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_mesh.errors import DeadlineExceeded
from fmu_mesh.master.master import Master
from fmu_mesh.master.mesh_server import MasterSettings
from fmu_mesh.rings.host_memory import HostMemory
from fmu_mesh.wire.session import Wiring, open_session
from fmu_mesh.wire.views import LogLine, MeshStatus
from tests.helpers import write_config
from tests.planning import prepare


class Silent:
    """Takes the events of a run."""

    def status(self, status: MeshStatus) -> None:
        """Do nothing."""

    def log(self, line: LogLine) -> None:
        """Do nothing."""


def test_master_sleeps_while_no_node_has_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, limits, sleep = prepare(write_config(tmp_path, timeouts={"start": 0.3})), [], HostMemory.sleep

    def noted(memory: HostMemory, seen: int, timeout_s: float, wishes: list[tuple[object, int]]) -> None:
        limits.append(timeout_s)
        sleep(memory, seen, timeout_s, wishes)  # type: ignore[arg-type]  # as it was given

    monkeypatch.setattr(HostMemory, "sleep", noted)
    with open_session(Wiring()) as session:
        master = Master(plan, session, Silent(), MasterSettings(), lambda *_: plan)
        master.claim()
        with pytest.raises(DeadlineExceeded, match="pendulum"):
            master.run()
        master.close()

    assert limits
    assert min(limits) > 0.0
