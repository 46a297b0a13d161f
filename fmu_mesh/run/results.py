"""Which kind of file the results of a run go into, by its name, and what is there after its process was killed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ..config.findings import Findings
from ..config.loading import LoadedConfig
from ..errors import ConfigurationError
from ..files import open_alone
from ..recorder.csv_file import CsvFile, cut_after_last_row
from ..recorder.noted import NotedFile, noted
from ..recorder.result_file import OpenResult, ResultFile
from ..ros.bags.recording import BagTopics, McapFile, bag_topics, is_bag
from ..system.system import System
from ..variables.model_description import VariableType

__all__ = ["check_results", "result_opener", "rows_left", "what_is_kept"]


def check_results(loaded: LoadedConfig, system: System) -> None:
    """Look whether what is recorded can be written into the result file.

    Raises:
        ConfigurationError: with everything that is wrong.
    """
    if is_bag(system.result_file):
        _topics(loaded, system)


def result_opener(loaded: LoadedConfig, system: System, folder: Path | None = None) -> OpenResult:
    """What opens the result file of a run: an MCAP if it is called so, else a CSV.

    Args:
        loaded: the configuration.
        system: what it means.
        folder: of the run, where somebody asks `rows_left` if this process is killed.
    """

    def open_result(path: Path, columns: Sequence[tuple[str, VariableType]]) -> ResultFile:
        file = McapFile(path, columns, _topics(loaded, system)) if is_bag(path) else CsvFile(path, columns)
        return NotedFile(file, folder) if folder is not None else file

    return open_result


def rows_left(result_file: str, folder: Path) -> int:
    """Rows in the result file of the run in ``folder``, whose master was killed; cuts off what follows the last row."""
    path, kept = Path(result_file), noted(folder)
    if path.exists() and not path.is_file():
        return 0  # a device keeps nothing
    with suppress(ConfigurationError, OSError), open_alone(path):  # nobody else may write it now; removes what it left
        if kept is not None and path.is_file():
            return kept.rows if is_bag(path) else cut_after_last_row(path, kept)
    return 0


def what_is_kept(result_file: str | None, rows: int) -> str | None:
    """What is told of a run that ended early and left rows; a device keeps none."""
    if not rows or result_file is None or not Path(result_file).is_file():
        return None
    return f"What was recorded up to then ({rows} rows) is in '{result_file}'."


def _topics(loaded: LoadedConfig, system: System) -> BagTopics:
    findings = Findings(str(loaded.file), loaded.lines)
    descriptions = {name: instance.description for name, instance in system.instances.items()}
    topics = bag_topics(loaded, descriptions, system.recorded, findings)
    findings.raise_any()
    assert topics is not None  # or there is a finding
    return topics
