"""`plot`: results as a picture."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..errors import ConfigurationError
from ..model.plan import Plan

__all__ = ["add_commands", "plot_results", "require_matplotlib"]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the commands of this module."""
    return


def require_matplotlib() -> None:
    """Raise ConfigurationError."""


def plot_results(result: Path, plot: Path, plan: Plan | None) -> None:
    """Plot."""
    raise ConfigurationError("not yet")
