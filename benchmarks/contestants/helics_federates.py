"""HELICS: one federate per FMU, each in a process of its own, and a broker in this one.

A value published at the time of point k reaches the others at k + 1, so the coupling is Jacobi. One-way, the source
depends on nobody and runs ahead; coupled, every federate also receives from the one it feeds, so that they wait for
each other. Option `core`: `tcp` or `zmq`, HELICS's default.
"""

from __future__ import annotations

import socket
from multiprocessing.connection import Connection
from time import perf_counter

import helics  # type: ignore[import-not-found] # of the peers

from benchmarks.contestants.entry import main, nodes, versions
from benchmarks.contestants.fmu import opened
from benchmarks.task import Outcome, Task

__all__: list[str] = []


def run(task: Task) -> Outcome:
    """Broker; timed from the first federate's entry into the executing mode to the last one's last step."""
    count, core = len(task.system.members), task.options["core"]
    port = _free_port()
    broker = helics.helicsCreateBroker(core, "", f"-f {count} --port={port} --loglevel=error")
    try:
        with nodes(_federate, [(task, index, core, port) for index in range(count)]) as pipes:
            ends = [pipe.recv() for pipe in pipes]
        helics.helicsBrokerWaitForDisconnect(broker, 5000)
    finally:
        helics.helicsCloseLibrary()
    seconds = max(end for _, end, _ in ends) - min(start for start, _, _ in ends)
    names = [member.column for member in task.system.members]
    return Outcome(seconds, dict(zip(names, (last for _, _, last in ends), strict=True)), versions("helics", "fmpy"))


def _federate(pipe: Connection, task: Task, index: int, core: str, port: int) -> None:
    system = task.system
    info = helics.helicsCreateFederateInfo()
    helics.helicsFederateInfoSetCoreTypeFromString(info, core)
    helics.helicsFederateInfoSetCoreInitString(info, f"--federates=1 --broker_address=127.0.0.1 --brokerport={port}")
    helics.helicsFederateInfoSetTimeProperty(info, helics.HELICS_PROPERTY_TIME_PERIOD, system.step_size)
    helics.helicsFederateInfoSetFlagOption(info, helics.HELICS_FLAG_UNINTERRUPTIBLE, True)  # noqa: FBT003 - its API
    federate = helics.helicsCreateValueFederate(f"federate_{index}", info)
    publication = helics.helicsFederateRegisterGlobalPublication(
        federate, f"out_{index}", helics.HELICS_DATA_TYPE_DOUBLE, ""
    )
    source = system.source_of(index)
    subscription = None if source is None else helics.helicsFederateRegisterSubscription(federate, f"out_{source}", "")
    if source is None and task.options["coupled"] == "yes":
        helics.helicsFederateRegisterSubscription(federate, f"out_{index + 1}", "")
    with opened(task, index) as instance:
        helics.helicsFederateEnterExecutingMode(federate)
        start = perf_counter()
        fmu, inputs, outputs, step_size = instance.fmu, instance.inputs, instance.outputs, system.step_size
        publish, get = helics.helicsPublicationPublishDouble, helics.helicsInputGetDouble
        request = helics.helicsFederateRequestTime
        newest, value = task.initial_inputs[index], 0.0
        for point in range(task.points):
            if subscription is not None:
                if point:
                    newest = get(subscription)
                fmu.setReal(inputs, [newest])
            fmu.doStep(currentCommunicationPoint=point * step_size, communicationStepSize=step_size)
            value = fmu.getReal(outputs)[0]
            publish(publication, value)
            request(federate, (point + 1) * step_size)
        pipe.send((start, perf_counter(), value))
    helics.helicsFederateDisconnect(federate)
    helics.helicsFederateFree(federate)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


if __name__ == "__main__":
    main(run)
