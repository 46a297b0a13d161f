"""A package as users have it: names that are no names of instances, a nested system, a file of values, two variants."""

from __future__ import annotations

from tests.ssp.packages import (
    Files,
    bound,
    component,
    connection,
    connector,
    description,
    element,
    fmus,
    parameter,
    parameter_file,
    parameter_set,
    system,
    unit,
)

__all__ = ["INSTANCES", "SHIP", "without_times"]

INSTANCES = ("DP-32-Controller", "Pendulum", "Plant--49--46--32-Integrator")
"""The instances of the package, in the order of its elements."""

_STEP_SIZE = element(
    "ssc:Annotation",
    '<oms:FixedStepMaster xmlns:oms="urn:oms" stepSize="0.01"/>',
    type="org.openmodelica",
)


def _description(name: str, gain: float) -> str:
    controller = component(
        "DP Controller",
        "Gain",
        connector("u", "input"),
        connector("k", "parameter"),
        connector("y", "output"),
        bindings=[bound(parameter_set(parameter("k", gain)))],
    )
    pendulum = component(
        "Pendulum",
        "DampedPendulum",
        connector("a", "output", unit="rad"),
        connector("l", "parameter", unit="m"),
        bindings=[bound("resources/values.ssv")],
    )
    plant = system(
        "Plant",
        component("1. Integrator", "Integrator", connector("u", "input"), connector("y", "output")),
        connectors=[connector("force", "input"), connector("position", "output")],
        connections=[
            connection(".force", ".").replace('endConnector=""', 'endElement="1. Integrator" endConnector="u"'),
            connection(".", ".position").replace(
                'startConnector=""', 'startElement="1. Integrator" startConnector="y"'
            ),
        ],
    )
    root = system(
        "root",
        controller,
        pendulum,
        plant,
        connectors=[connector("out", "output")],
        connections=[
            connection("Pendulum.a", "DP Controller.u"),
            connection("DP Controller.y", "Plant.force"),
            connection("Plant.position", ".out"),
        ],
    )
    units = [unit("rad", rad=1), unit("m", m=1)]
    return description(root, name=name, units=units, annotations=[_STEP_SIZE])


SHIP: Files = {
    "SystemStructure.ssd": _description("DP ship", 2.0),
    "VarB.ssd": _description("Variant B", 3.0),
    "resources/values.ssv": parameter_file(parameter("l", 2.0, unit="m"), units=[unit("m", m=1)]),
    **fmus("Gain", "DampedPendulum", "Integrator"),
}


def without_times(files: Files) -> Files:
    """The package without a step size, a stop time and an algorithm."""
    text = (
        str(files["SystemStructure.ssd"]).replace(_STEP_SIZE, "").replace('<ssd:DefaultExperiment stopTime="1.0"/>', "")
    )
    return {**files, "SystemStructure.ssd": text}
