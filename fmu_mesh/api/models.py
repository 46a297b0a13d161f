"""What a model is, before it is part of a mesh."""

from __future__ import annotations

from pathlib import Path

import msgspec

from ..config.instance_sections import KIND
from ..errors import CallRefused
from ..instances.registry import KINDS, describe
from ..text import listed
from ..variables.model_description import ModelDescription

__all__ = ["inspect"]


def inspect(path: str | Path, *, kind: str | None = None) -> ModelDescription:
    """Read what a model declares: its variables, capabilities and default experiment. Nothing of it is run.

    Example:
        >>> import fmu_mesh
        >>> pendulum = fmu_mesh.inspect("fmus/DampedPendulum.fmu")
        >>> pendulum.fmi_version, pendulum.default_experiment.step_size
        ('2.0', 0.002)
        >>> [variable.name for variable in pendulum.with_causality("output")]
        ['a', 'der(a)', 'der(a,2)']
        >>> pendulum.variable("l").unit
        'm'

    Args:
        path: the file of the model.
        kind: the kind of instance, as its key in a configuration; default: the kind with the ending of the file,
            otherwise an FMU.

    Raises:
        LoadFailed: it is no such model; says why.
        CallRefused: no installed package offers this kind.
    """
    names = KINDS.names()
    chosen = kind if kind is not None else Path(path).suffix.removeprefix(".")
    if kind is not None and kind not in names:
        raise CallRefused(f"no installed package offers the kind of instance '{kind}'; there are {listed(names)}")
    key = chosen if chosen in names else names[0]
    section = msgspec.convert({KIND: key, key: str(path)}, KINDS.section(key))
    return describe(Path(path).absolute(), section)
