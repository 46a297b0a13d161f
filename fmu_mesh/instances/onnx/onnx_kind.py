"""ONNX models as a kind of instances: trained policies, surrogates, classifiers.

In a configuration: `policy: {onnx: policy.onnx}`. `docs/onnx.md` says what is what. The engine is imported when a model
is described or opened.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from ... import files
from ...config.base import Base
from ...config.instance_sections import (
    KIND,
    ExtrapolationOfInputs,
    Feedthrough,
    Group,
    Host,
    Inputs,
    InstanceSection,
    NotFinitePolicy,
    OnFailure,
    Process,
    StartValues,
    StepSize,
)
from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...variables.model_description import ModelDescription
from ..child_question import ask_description_of, described
from ..contract import Instance, Kind, Opening

__all__ = ["KIND_OF_ONNX_MODELS", "OnnxConfig"]


class OnnxConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="onnx"):
    """A neural network or another model in the ONNX format: its inputs and outputs are variables."""

    onnx: Annotated[str, Meta(description="Path of the ONNX model, relative to this file.")]
    start_values: StartValues = {}
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    process: Process = None
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None


class OnnxKind(Kind[OnnxConfig]):
    """Models that onnxruntime computes, on one thread of the processor."""

    section = OnnxConfig
    expected = "an ONNX model"

    def describe(
        self, path: Path, section: OnnxConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """Load the model and compute it twice, in a child process; its inputs and outputs are the variables."""
        return ask_description_of(f"onnxruntime, which loads and computes '{path}',", __name__, (str(path), limits))

    def content(self, path: Path) -> str:
        """The SHA-256 of the file: nothing else is read."""
        return files.sha256_of(path)

    def open(self, opening: Opening[OnnxConfig]) -> Instance:
        """Load the model."""
        from .onnx_instance import OnnxInstance  # noqa: PLC0415  as above
        from .onnx_model import OnnxModel  # noqa: PLC0415  as above

        try:
            model = OnnxModel(opening.path, opening.limits, opening.content)
        except LoadFailed as error:
            raise LoadFailed(error.message, instance=opening.name, hint=error.hint) from error
        return OnnxInstance(opening.name, model, opening.section.not_finite)


def answer_to(request: str) -> bytes:
    """In the child process: the description of a model, or why there is none."""
    from .onnx_model import OnnxModel  # noqa: PLC0415  onnxruntime is an extra, and slow to import

    path, limits = msgspec.json.decode(request, type=tuple[str, LimitsConfig])
    return described(lambda: OnnxModel(Path(path), limits).description)


KIND_OF_ONNX_MODELS = OnnxKind()  # what the entry point `onnx` names
