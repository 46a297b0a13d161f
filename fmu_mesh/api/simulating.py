"""`simulate`: one FMU, one call: its default experiment, inputs as arrays or as a table, the result as arrays.

Owns what is different from a mesh: names without the instance, times that an FMU suggests, and the forms of inputs.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from msgspec.structs import replace

from ..config.call_options import takes
from ..config.plain_values import plain
from ..errors import CallRefused, ConfigurationError
from ..run.options import SimulateOptions
from ..simtime import steps_between
from ..system.series_files import SeriesRefused, columns_of
from ..text import shown
from ..variables.model_description import ModelDescription
from .mesh_builder import Mesh
from .result import Result

__all__ = ["as_given", "experiment_of", "simulate"]

log = logging.getLogger("fmu_mesh.run")

_STEPS = 1000
"""Of a simulation whose step size nobody says."""


@takes(SimulateOptions)
def simulate(fmu: str | Path, options: SimulateOptions) -> Result:
    """Simulate one FMU to its end, as fast as possible; nothing is written, unless ``output`` names a file.

    Example:
        >>> import fmu_mesh
        >>> result = fmu_mesh.simulate("fmus/DampedPendulum.fmu", stop_time=10.0, start_values={"a": 1.3})
        >>> result["a"].shape, float(result.times[-1])
        ((5001,), 10.0)
        >>> result.plot("a").savefig("a.png")

    Args:
        fmu: the FMU.
        options: see `SimulateOptions`.

    Raises:
        CallRefused: an option is wrong, or the result does not fit into memory.
        ConfigurationError: a start value, an input or a time is wrong; carries all findings.
        LoadFailed: it is no FMU that can run here; says why.
        FmuMeshError: the run ended early; its `result` has what was recorded up to then.
    """
    mesh, run = experiment_of(fmu, options)
    try:
        return mesh.run(**run)
    except ConfigurationError as error:
        raise as_given(error, f"{mesh.name}.") from error


def as_given(error: ConfigurationError, front: str) -> ConfigurationError:
    """The error with start values and inputs as they were given: without the name of the only instance."""

    def short(text: str) -> str:
        return text.replace(f"`start_values={{'{front}", "`start_values={'", 1)

    findings = tuple(
        replace(one, file="`inputs=...`", path=one.path.removeprefix(f"scenario.values.{front}"))
        if one.path.startswith("scenario.values.")
        else replace(one, path=short(one.path))
        for one in error.findings
    )
    message = str(findings[0]) if len(findings) == 1 else short(error.message)
    return ConfigurationError(message, findings=findings, hint=error.hint)


def experiment_of(fmu: str | Path, options: SimulateOptions) -> tuple[Mesh, dict[str, Any]]:
    """A mesh of one FMU for one experiment, and the options of its run."""
    given = options.given()
    section = {key: given.pop(key) for key in ("kind", "tolerance", "solver") if key in given}
    simulation = partial(_times_of, options)
    mesh = Mesh.from_fmu(fmu, simulation=simulation, on_notice=options.on_notice or log.info, **section)
    front = f"{mesh.name}."
    if (interval := given.pop("output_interval", None)) is not None:
        step_size = cast("Any", mesh.configuration.data)["simulation"]["step_size"]
        every = steps_between(0.0, interval, step_size)
        if not every:
            text = f"`output_interval={interval!r}`: expected a whole multiple of the step size, {step_size:.12g} s"
            raise CallRefused(text, hint="Give another `step_size`.")
        mesh.record(every=every)
    inputs = input_values(given.pop("inputs", None))
    mesh.scenario({_full(name, front): values for name, values in inputs.items()})
    given["start_values"] = {_full(name, front): value for name, value in given.get("start_values", {}).items()}
    if "record" in given:
        given["record"] = [_full(name, front) for name in given["record"]]
    elif "output" not in given:
        given["record"] = "memory"
    given.pop("start_time", None)
    return mesh, given


def input_values(inputs: Any) -> dict[str, Any]:  # noqa: ANN401  whatever has values over time
    """What a scenario says for inputs in any of their forms, by their names.

    Example:
        >>> input_values({"u": ([0.0, 1.0], [2.0, 3.0]), "k": 5.0})
        {'u': {'times': [0.0, 1.0], 'values': [2.0, 3.0], 'interpolation': 'auto'}, 'k': 5.0}

    Raises:
        CallRefused: it is none of them.
    """
    if isinstance(inputs, str | Path):
        path = Path(inputs).absolute()
        try:
            names = columns_of(path)
        except SeriesRefused as refused:
            raise CallRefused(f"`inputs`: {refused}; expected {refused.expected}") from refused
        time = _time_of(names)
        table = {"file": str(path), "time": time, "interpolation": "auto"}
        return {name: {**table, "column": name} for name in names if name != time}
    if hasattr(inputs, "to_records"):  # a data frame; its index is the time, unless it has a column of that name
        inputs = inputs.to_records(index="time" not in inputs)
    if isinstance(inputs, np.ndarray) and inputs.dtype.names:
        time = _time_of(inputs.dtype.names)
        return {name: _over_time(inputs[time], inputs[name]) for name in inputs.dtype.names if name != time}
    if not isinstance(inputs, Mapping | None):
        expected = "a structured array or a data frame with times, a mapping, or the path of a table"
        raise CallRefused(f"`inputs` is {shown(inputs)}; expected {expected}")
    found = {}
    for name, values in (inputs or {}).items():
        if hasattr(values, "to_numpy"):  # a series
            values = values.index, values.to_numpy()  # noqa: PLW2901  the same in another form
        is_pair = isinstance(values, tuple) and len(values) == 2 and all(np.ndim(one) for one in values)
        found[name] = _over_time(*values) if is_pair else values
    return found


def _time_of(names: Sequence[str]) -> str:
    return "time" if "time" in names else names[0]


def _over_time(times: Any, values: Any) -> dict[str, Any]:  # noqa: ANN401  whatever is like an array
    return {"times": plain(np.asarray(times)), "values": plain(np.asarray(values)), "interpolation": "auto"}


def _times_of(given: SimulateOptions, description: ModelDescription) -> dict[str, float]:
    """The times of an experiment; where nobody says them, it takes 1 s in 1000 steps."""
    default = description.default_experiment
    start = given.start_time if given.start_time is not None else default.start_time or 0.0
    stop = given.stop_time if given.stop_time is not None else default.stop_time
    stop = stop if stop is not None else start + 1.0
    known = (given.step_size, description.step_size, given.output_interval, (stop - start) / _STEPS)
    step = next(step for step in known if step is not None)
    return {"start_time": start, "stop_time": stop, "step_size": step}


def _full(name: str, front: str) -> str:
    """A name or a pattern with its instance, which may be there already."""
    kind, variable = re.fullmatch(r"((?:in|local|param):)?(.*)", name, re.DOTALL).groups("")  # type: ignore[union-attr]  # any text matches
    return kind + (variable if variable.startswith(front) else front + variable)
