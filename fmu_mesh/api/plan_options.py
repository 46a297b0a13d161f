"""Where results in memory are while a run goes on, and the section `record` as a program says it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..config.plain_values import plain
from ..run.run_plan import RunPlan
from ..system.records import IN_MEMORY
from ..wire.runtime import run_name, runtime_folder

__all__ = ["memory_file", "memory_of", "with_record"]

_MEMORY = "memory."


def with_record(section: Any, variables: Sequence[str], keys: Mapping[str, Any], *, also: bool) -> Any:  # noqa: ANN401  as a file has it
    """The section `record` with another first file, or with one more.

    Args:
        section: what it was: a mapping or a list of mappings.
        variables: what the file gets; all outputs if there are none.
        keys: other keys of its section; None leaves what the section says.
        also: whether it is one more file.
    """
    given = {"from" if key == "start" else key: plain(value) for key, value in keys.items() if value is not None}
    given["variables"] = list(variables) or None
    sections = section if isinstance(section, list) else [section]
    if also:  # a file that is there already gets another section
        return [
            *(one for one in sections if not (isinstance(one, dict) and one.get("file") == given.get("file"))),
            given,
        ]
    changed = {**(sections[0] if sections and isinstance(sections[0], dict) else {}), **given}
    return [changed, *sections[1:]] if isinstance(section, list) else changed


def memory_file() -> Path:
    """The file for results that stay in memory; the run makes its folder, and removes it.

    If this process is killed, the next run of this user removes them.
    """
    return runtime_folder() / f"{_MEMORY}{run_name()}" / f"rows{IN_MEMORY}"


def memory_of(plan: RunPlan) -> Path | None:
    """The file for results that stay in memory; None if they go where the configuration says."""
    file = Path(plan.plan.system.result_file or "")
    own = file.suffix == IN_MEMORY and file.parent.name.startswith(_MEMORY) and file.parent.parent == runtime_folder()
    return file if own else None
