"""The section `simulation` of a configuration file: its times, and how values go from instance to instance."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from fmu_mesh.config.base import NOT_NEGATIVE, POSITIVE, Base
from fmu_mesh.config.instance_sections import EXTRAPOLATIONS, Extrapolation

__all__ = ["MAX_WINDOW", "SimulationConfig"]

MAX_WINDOW = 1_000_000
"""In points. A ring holds one row per point of the window."""


class SimulationConfig(Base, frozen=True, kw_only=True):
    """When the simulation starts and stops, and how instances are synchronized."""

    start_time: Annotated[float, Meta(description="Time of communication point 0 in s.")] = 0.0
    stop_time: Annotated[
        float | None,
        Meta(
            description="Time of the last communication point in s: start_time plus a multiple of step_size; "
            "null: the run goes on until it is stopped."
        ),
    ]
    step_size: Annotated[
        float,
        Meta(
            description="Base communication step size in s; greater than 0.",
            extra_json_schema=POSITIVE,
            examples=[0.002],
        ),
    ]
    algorithm: Annotated[
        Literal["jacobi", "gauss_seidel"],
        Meta(
            description="jacobi: every connection has a delay of one point. gauss_seidel: only the connections that "
            "close a cycle have one."
        ),
    ] = "gauss_seidel"
    window: Annotated[
        Literal["auto"] | Annotated[int, Meta(ge=1, le=MAX_WINDOW)],
        Meta(
            description="How many points a node may run ahead of the slowest; 1 is strict lockstep; "
            "auto: up to 262144 points, fewer for many instances or large rows."
        ),
    ] = "auto"
    real_time_factor: Annotated[
        float,
        Meta(
            description="Simulation time per wall-clock time; 1: real time; 2: twice as fast; 0: as fast as possible.",
            extra_json_schema=NOT_NEGATIVE,
        ),
    ] = 0.0
    update_period: Annotated[
        float,
        Meta(
            ge=0,
            description="With a real_time_factor: points that are due are stepped together, once per this wall-clock "
            "time in s; 0: each point when it is due.",
        ),
    ] = 0.0
    catch_up: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(
            description="With a real_time_factor: largest lag behind the wall clock in s; beyond it, points are "
            "counted as overruns; null: no limit."
        ),
    ] = None
    not_finite: Annotated[
        Literal["stop", "record"],
        Meta(
            description="stop: an output that is NaN or infinite ends the run at its point, and no such value may be "
            "set; record: it is recorded as it is. An instance can have its own `not_finite`."
        ),
    ] = "stop"
    loops: Annotated[
        Literal["delayed", "solved"],
        Meta(
            description="delayed: an output that depends directly on an input belongs to the input of the step before "
            "it; solved: all outputs at a point are made consistent, by what they depend on directly."
        ),
    ] = "delayed"
    extrapolation: Annotated[
        Extrapolation,
        Meta(description=f"For connections and instances without an own `extrapolation`. {EXTRAPOLATIONS}"),
    ] = "hold"
    defects: Annotated[
        bool,
        Meta(
            description="true: what each input was assumed to be over a step is compared with what came; the largest "
            "differences are in the summary, and all are in the metadata of the result."
        ),
    ] = False
