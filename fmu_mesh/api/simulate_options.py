"""The options of `simulate`. Owns no work: the help of the command imports this."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from ..config.call_options import CallOptions, Option
from ..run.options import MEMORY_LIMIT, MemoryLimit, Number, OnEvent, OnNotice, OnProgress, Output, Processes, Values

__all__ = ["SimulateOptions"]


class SimulateOptions(CallOptions, frozen=True, kw_only=True):
    """What `simulate` takes; times that are None are those of the FMU's default experiment."""

    start_time: Annotated[Number, Option("time at which it starts, in s", "--start-time", "S")] = None
    stop_time: Annotated[Number, Option("time at which it ends, in s", "--stop-time", "S")] = None
    step_size: Annotated[Number, Option("communication step size in s", "--step-size", "S")] = None
    output_interval: Annotated[
        Number, Option("time between two rows in s, a whole multiple of the step size", "--output-interval", "S")
    ] = None
    kind: Annotated[
        Literal["auto", "co_simulation", "model_exchange"],
        Option("which kind of the FMU to use; auto: co-simulation if it has both", "--kind", "KIND"),
    ] = "auto"
    tolerance: Annotated[Number, Option("relative tolerance of a co-simulation FMU", "--tolerance", "X")] = None
    solver: Annotated[
        Mapping[str, Any] | None, Option("of model exchange: name, relative_tolerance and maximum_step_size")
    ] = None
    start_values: Annotated[Values, Option("start values by variable", "--set", "VARIABLE=VALUE")] = None
    inputs: Annotated[
        object, Option("inputs over time: a table; in Python also an array, a frame or a mapping", "--inputs", "FILE")
    ] = None
    record: Annotated[
        Sequence[str] | None, Option("variables or patterns; default: all outputs", "--record", "NAME")
    ] = None
    output: Output = None
    processes: Processes = True
    memory_limit: MemoryLimit = MEMORY_LIMIT
    on_progress: OnProgress = None
    on_event: OnEvent = None
    on_notice: OnNotice = None
