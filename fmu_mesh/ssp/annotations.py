"""What the annotations of other tools say about a simulation: step sizes, and with them the algorithm.

SSP has no step size and no algorithm. OMSimulator and libcosim write their own, and both exchange values between steps
of equal length: all components step with the values of the last communication point, which is `jacobi`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, Final

from lxml import etree

from .grammar import PATTERNS, number_of
from .problems import Problems
from .system_structure import Annotation

__all__ = ["OPEN_MODELICA", "OPEN_SIMULATION_PLATFORM", "base_step_size", "common_solvers", "step_size_hint"]

OPEN_MODELICA: Final = "org.openmodelica"
OPEN_SIMULATION_PLATFORM: Final = "com.opensimulationplatform"
_STEP_SIZES: Final = {
    OPEN_MODELICA: ("FixedStepMaster", "stepSize"),
    OPEN_SIMULATION_PLATFORM: ("FixedStepAlgorithm", "baseStepSize"),
}


def base_step_size(annotations: Iterable[Annotation], problems: Problems) -> tuple[float, Annotation] | None:
    """The step size of a whole system in s, and the annotation that says it; None if none does.

    Args:
        annotations: those of the root system, of its default experiment and of its description.
        problems: collects step sizes that are none.
    """
    for annotation in annotations:
        element, attribute = _STEP_SIZES.get(annotation.type, ("", ""))
        for found in _elements(annotation, element):
            value = _positive(found.get(attribute))
            if value is not None:
                return value, annotation
            problems.add(
                annotation.place, f"{element} with {attribute} '{found.get(attribute)}'", "a step size > 0 in s"
            )
    return None


def common_solvers(annotations: Iterable[Annotation]) -> Iterator[tuple[str, Annotation]]:
    """The solvers that OMSimulator is to use for all FMUs of a system together, and their annotations."""
    for annotation in annotations:
        if annotation.type == OPEN_MODELICA:
            for local in ("VariableStepSolver", "FixedStepSolver"):
                for _found in _elements(annotation, local):
                    yield local, annotation


def step_size_hint(annotations: Iterable[Annotation], problems: Problems) -> tuple[float, Annotation] | None:
    """The step size that libcosim is to use for one component in s, and its annotation; None if there is none."""
    for annotation in annotations:
        if annotation.type == OPEN_SIMULATION_PLATFORM:
            for found in _elements(annotation, "StepSizeHint"):
                value = _positive(found.get("value"))
                if value is not None:
                    return value, annotation
                problems.add(annotation.place, f"StepSizeHint '{found.get('value')}'", "a step size > 0 in s")
    return None


def _elements(annotation: Annotation, local: str) -> Iterator[Any]:
    """The elements with this local name inside an annotation, whatever their namespace is."""
    if not local or not annotation.xml:
        return
    # The file was parsed safely; this is a part of it, written by the same library.
    root = etree.fromstring(b"<content>" + annotation.xml + b"</content>")
    for element in root.iter():
        if isinstance(element.tag, str) and etree.QName(element).localname == local:
            yield element


def _positive(text: str | None) -> float | None:
    if text is None or not PATTERNS["number"].fullmatch(text.strip()):
        return None
    value = number_of(text.strip())
    return value if math.isfinite(value) and value > 0.0 else None
