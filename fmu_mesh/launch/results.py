"""Which kind of file the results of a run go into, by its name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..model.description import VariableType
from ..model.findings import Findings
from ..model.loading import LoadedConfig, load
from ..model.system import System
from ..record.csv_file import CsvFile
from ..record.result_file import OpenResult, ResultFile
from ..ros.bag import BagTopics, McapFile, bag_topics, is_bag

__all__ = ["check_results", "result_opener"]


def check_results(loaded: LoadedConfig, system: System) -> None:
    """Look whether what is recorded can be written into the result file.

    Raises:
        ConfigurationError: with everything that is wrong.
    """
    if is_bag(system.result_file):
        _topics(loaded, system)


def result_opener(config_file: Path, system: System) -> OpenResult:
    """What opens the result file of a run: an MCAP if it is called so, else a CSV."""
    if not is_bag(system.result_file):
        return CsvFile

    def open_bag(path: Path, columns: Sequence[tuple[str, VariableType]]) -> ResultFile:
        return McapFile(path, columns, _topics(load(config_file), system))

    return open_bag


def _topics(loaded: LoadedConfig, system: System) -> BagTopics:
    findings = Findings(str(loaded.file), loaded.lines)
    descriptions = {name: instance.description for name, instance in system.instances.items()}
    topics = bag_topics(loaded, descriptions, system.recorded, findings)
    findings.raise_any()
    assert topics is not None  # or there is a finding
    return topics
