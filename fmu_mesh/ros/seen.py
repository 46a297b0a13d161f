"""A running mesh as the wire shows it, in the form in which a configuration's parts are known."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from ..model.description import ModelDescription, Variable
from ..wire.views import InstanceInfo

__all__ = ["descriptions_of"]


def descriptions_of(infos: Mapping[str, InstanceInfo]) -> dict[str, ModelDescription]:
    """The model descriptions of instances that may run on another host, as far as topics need them."""
    return {name: _description(info) for name, info in infos.items()}


def _description(info: InstanceInfo) -> ModelDescription:
    variables = tuple(
        msgspec.convert(
            {
                "name": view.name,
                "value_reference": 0,
                "type": view.type,
                "causality": view.causality,
                "variability": view.variability,
                "unit": view.unit,
                "description": view.description,
            },
            Variable,
        )
        for view in info.variables
    )
    return ModelDescription(
        model_name=info.model_name,
        model_identifier=info.model_name,
        fmi_version=info.fmi_version,
        kind="co_simulation",
        guid="",
        variables=variables,
    )
