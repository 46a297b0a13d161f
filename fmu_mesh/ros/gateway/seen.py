"""A running mesh as the wire shows it, in the form in which a configuration's parts are known."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from ...variables.model_description import Causality, ModelDescription, Variability, Variable
from ...variables.value_types import FMI2_TYPES, VariableType
from ...wire.views import InstanceInfo, VariableView

__all__ = ["descriptions_of"]


def descriptions_of(infos: Mapping[str, InstanceInfo]) -> dict[str, ModelDescription]:
    """The model descriptions of instances that may run on another host, as far as topics need them."""
    return {name: _description(info) for name, info in infos.items()}


def _description(info: InstanceInfo) -> ModelDescription:
    return ModelDescription(
        model_name=info.model_name,
        model_identifier=info.model_name,
        fmi_version=info.fmi_version,
        kind="co_simulation",
        guid="",
        variables=tuple(_variable(view) for view in info.variables),
    )


def _variable(view: VariableView) -> Variable:
    return Variable(
        name=view.name,
        value_reference=0,
        type=msgspec.convert(FMI2_TYPES.get(view.type, view.type), VariableType),
        causality=msgspec.convert(view.causality, Causality),
        variability=msgspec.convert(view.variability, Variability),
        unit=view.unit,
        description=view.description,
        declared_type=view.type,
        shape=view.shape,
    )
