"""Several meshes at once, of which one is lost between two questions."""

from __future__ import annotations

from typing import Any

import pytest

from fmu_mesh.errors import DeadlineExceeded
from fmu_mesh.wire.client.reaching import Meshes


def reachable(silent: frozenset[str]) -> tuple[Meshes, Any]:
    """Meshes, and a question that the ``silent`` ones do not answer."""

    def question(name: Any) -> str:  # noqa: ANN401 stands for a client
        if name in silent:
            raise DeadlineExceeded(f"no answer from mesh '{name}'")
        return f"answer of {name}"

    return Meshes((), 1.0), question


def test_a_mesh_that_is_lost_meanwhile_keeps_nobody_from_answers_of_others() -> None:
    meshes, question = reachable(frozenset({"two"}))
    clients: Any = ["one", "two", "three"]

    answers: Any = meshes.answers(clients, question)

    assert answers == [("one", "answer of one"), ("three", "answer of three")]
    assert [str(error) for error in meshes.silent] == ["no answer from mesh 'two'"]


@pytest.mark.parametrize("clients", [["one"], ["one", "two"]])
def test_where_nobody_answers_that_is_an_error(clients: Any) -> None:  # noqa: ANN401 as above
    meshes, question = reachable(frozenset({"one", "two"}))

    with pytest.raises(DeadlineExceeded, match="no answer from mesh"):
        meshes.answers(clients, question)
