"""The arguments of the commands for running meshes. Owns no work: `--help` imports this and little else."""

from __future__ import annotations

from pathlib import Path
from typing import Final, get_args

from ..ros.bags.play_options import PlayOptions
from ..run.options import ResetOptions
from ..wire.views import MeshState
from .arguments import (
    QUIET,
    Parsers,
    argument,
    count,
    json_switch,
    number,
    port_number,
    positive_seconds,
    reaching,
    switch,
)
from .run_options import options

__all__ = ["LEVELS", "PARSERS"]

_HOST: Final = "127.0.0.1"
_INTERVAL_S: Final = 1.0
_PATIENCE_S: Final = 60.0
"""The usual deadline of `wait` and of `play`."""
LEVELS: Final = ("ok", "warning", "discard", "error", "fatal")
"""The statuses of log messages in ascending order."""
_REFERENCE: Final = (
    "`instance.variable` or `MESH/instance.variable`, or a pattern of them (`*` any characters, `?` one, `re:` a "
    "regular expression); or a key (with wildcards of Zenoh)"
)
_WHICH: Final = "a mesh or an instance: NAME, MESH/INSTANCE, or its key"
_MESH: Final = argument("mesh", "MESH", "name or key of the mesh; default: the only one", nargs="?")
_KEYS: Final = argument("key", "KEY", _REFERENCE, nargs="+")
_QUESTION: Final = (*reaching(), json_switch())
"""The flags of a command that asks running meshes."""
_COMMAND: Final = (*_QUESTION, QUIET, _MESH)

PARSERS: Parsers = {
    "ls": (
        *_QUESTION,
        argument("name", "NAME", "a mesh, or an instance, whose variables are listed", nargs="?"),
        switch("-l", "--long", text="also list the variables of every instance"),
    ),
    "status": (*_QUESTION, argument("key", "KEY", f"{_WHICH}; default: every mesh", nargs="?")),
    "info": (*_QUESTION, argument("key", "KEY", _WHICH)),
    "get": (*_QUESTION, _KEYS),
    "set": (
        *_QUESTION,
        QUIET,
        argument("key", "KEY", "`instance.variable`, `MESH/instance.variable`, or a key"),
        argument("value", "VALUE", "a number, true, false, text, or [a, list] for an array"),
        argument("--at", "T", "simulation time in s from which on it holds", type=number),
    ),
    "watch": (*_QUESTION, _KEYS, argument("--count", "N", "end after N values", type=count)),
    "top": (
        *reaching(),
        _MESH,
        switch("--once", text="show it once and exit"),
        argument("--interval", "S", "time between two looks in s (1)", type=positive_seconds, default=_INTERVAL_S),
        argument(
            "--watch",
            "INSTANCE.VARIABLE",
            "also show the course of these variables (or patterns, such as 'arm*.x')",
            nargs="+",
            default=[],
        ),
        json_switch("JSON, one object per look"),
    ),
    "dashboard": (
        *reaching(),
        argument("mesh", "MESH", "name or key of the mesh; default: all that run", nargs="?"),
        argument("--host", "ADDRESS", f"address where the page is served ({_HOST})", default=_HOST),
        argument("--port", "N", "port of the page; 0: a free one (0)", type=port_number, default=0),
        switch("--read-only", text="show the meshes, but set and steer nothing"),
        switch("--no-browser", text="print the address only"),
    ),
    "foxglove": (
        *reaching(),
        QUIET,
        _MESH,
        argument(
            "--variables",
            "INSTANCE.VARIABLE",
            "offer only these, or patterns; default: all outputs",
            nargs="+",
            default=[],
        ),
        argument("--host", "ADDRESS", f"the address to listen at ({_HOST})", default=_HOST),
        argument("--port", "N", "the port, 0 for a free one (8765)", type=port_number, default=8765),
        switch("--steer", text="clients may set inputs and parameters"),
        argument(
            "--origin",
            "ORIGIN",
            "let pages of this origin connect, too, such as https://foxglove.example.org; may be repeated",
            action="append",
            default=[],
        ),
    ),
    "logs": (
        *_QUESTION,
        _MESH,
        argument("--instance", "NAME", "only the messages of this instance"),
        argument("--level", "STATUS", f"from this status on: {', '.join(LEVELS)} (ok)", choices=LEVELS, default="ok"),
        switch("-f", "--follow", text="also show new messages, until the mesh ends"),
        switch("--audit", text="instead, show who joined, set, commanded or was refused, each kind with its number"),
    ),
    **dict.fromkeys(("pause", "resume", "stop"), _COMMAND),
    "checkpoint": (
        *_COMMAND,
        argument("--output", "FILE", "the file; one of this name is replaced (MESH.state)", type=Path),
    ),
    "step": (*_COMMAND, argument("points", "N", "points (1)", nargs="?")),
    "reset": (*_COMMAND, options("start_values", of=ResetOptions)),
    "wait": (
        *reaching(_PATIENCE_S),
        json_switch("JSON, as `status` prints it"),
        QUIET,
        _MESH,
        argument(
            "--state",
            "STATE",
            f"{', '.join(get_args(MeshState))} (running)",
            choices=get_args(MeshState),
            default="running",
        ),
    ),
    "play": (
        *reaching(_PATIENCE_S),
        QUIET,
        argument("bag", "BAG", "an MCAP file, or the folder of a `ros2 bag`", type=Path),
        _MESH,
        options("topics", "start", "stamps", "config", of=PlayOptions),
    ),
}
