"""Placeholder."""
from __future__ import annotations
import argparse
from typing import Any
def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    return
