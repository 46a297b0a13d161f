"""How many files and functions a reader meets who follows one value; `python -m tests.walks --names` lists them."""

from __future__ import annotations

import pytest

from tests.walks import WALKS, walked

# They only get smaller, but for functions that say whose rows a node steps with (row streams), which solver a model has
# here (in the digest), who looks after the process (a context for each call took longer than the call), whether a mesh
# can start again, how an input changes within a step, on what outputs depend directly, which values go from node to
# node (a module of its own), and in which sandbox a model is loaded; and of an error, on which host it happened, and
# whether the run ends with it. The error takes some functions more or fewer, as its processes hear of it in another
# order.
MOST = {
    "start value": (34, 97),
    "SSP parameter": (42, 116),
    "error of a component": (29, 62),
}


@pytest.mark.parametrize("name", WALKS)
def test_the_way_of_a_value_does_not_get_longer(name: str) -> None:
    files, functions = walked(name)

    most_files, most_functions = MOST[name]
    assert len(files) <= most_files, "\n".join(files)
    assert len(functions) <= most_functions, "\n".join(functions)


def test_a_walk_begins_with_the_file_and_ends_at_the_fmu() -> None:
    functions = walked("start value").functions

    assert "config/loading.py: read_text" in functions
    assert [name for name in functions if name.startswith("instances/fmi/") and name.endswith("enter_initialization")]
