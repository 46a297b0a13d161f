"""What a node got from outside is given again by points, whichever attempt of the run has written it."""

from __future__ import annotations

from pathlib import Path

from fmu_mesh.wire.journal import NodeJournal
from fmu_mesh.wire.messages import SetValue


def test_values_of_several_attempts_are_given_by_points(tmp_path: Path) -> None:
    """The first attempt was ahead of its rows; the second one got values at points before its last ones."""
    journal = NodeJournal(str(tmp_path / "gain.journal"))
    for point, value in ((310, 1.0), (320, 2.0), (313, 3.0), (310, 4.0)):
        journal.keep(SetValue("gain", "k", value, point, None, "key", "who"))
    journal.close()

    again = NodeJournal(str(tmp_path / "gain.journal"))
    given = again.given()

    assert [(point, value) for _, point, _, value in given["gain"]] == [(310, 1.0), (310, 4.0), (313, 3.0), (320, 2.0)]
    assert again.last_point == 320
