"""The options of `Run.play`. Owns no work: the help of the command imports this."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from ...config.call_options import CallOptions, Option

__all__ = ["PlayOptions"]


class PlayOptions(CallOptions, frozen=True, kw_only=True):
    """How a bag is played."""

    topics: Annotated[
        Sequence[str],
        Option(
            "topics and their inputs; default: the topics that the mesh subscribes to",
            "--topic",
            "TOPIC[:FIELD]=INSTANCE.VARIABLE",
        ),
    ] = ()
    start: Annotated[
        float | None, Option("simulation time of the first message in s; default: its stamp", "--start", "T")
    ] = None
    stamps: Annotated[
        Literal["header", "log"],
        Option("use header stamps where messages have them, or log times", "--stamps", "header|log"),
    ] = "header"
    config: Annotated[
        str | Path | None, Option("the configuration, if that of the mesh is not on this host", "--config", "CONFIG")
    ] = None
    timeout: Annotated[
        float, Option("how long the mesh may take to the next message, in s (60)")  # a flag of all that reach a mesh
    ] = 60.0
