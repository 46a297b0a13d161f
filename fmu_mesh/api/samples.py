"""Values of a running mesh as a program gets them, and its end."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from ..errors import ConfigurationError, UnknownName, from_report
from ..variables.value_conversion import from_plain
from ..wire.client.mesh_client import MeshClient
from ..wire.client.readings import Reading, Target
from ..wire.views import GOING_ON, VariableView

if TYPE_CHECKING:
    from .result import Result

__all__ = ["Sample", "Watch", "follow_to_end", "sample_of", "target_of", "targets_of"]

_FOREVER_S = 1e9


class Sample(NamedTuple):
    """One value of a variable.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
        >>> with mesh.start(record="memory", paused=True) as run:
        ...     run.samples("pendulum.a")
        [Sample(name='pendulum.a', value=1.3, point=0, time=0.0, unit='rad')]

    Attributes:
        name: `instance.variable`.
        value: a number, truth value, text or bytes; an array as a numpy array.
        point: the communication point of the value.
        time: the simulation time of this point in s.
        unit: the unit, as FMI writes it; None without one.
    """

    name: str
    value: Any
    point: int
    time: float
    unit: str | None


class Watch(Iterator[Sample]):
    """The values of variables as they come, from when it was made until the mesh ends, or until it is closed."""

    def __init__(self, client: MeshClient, targets: Sequence[Target]) -> None:
        self._targets = {target.key: target for target in targets}
        self._stack = ExitStack()
        self._readings = self._stack.enter_context(client.watch(targets))
        weakref.finalize(self, self._stack.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __next__(self) -> Sample:
        reading = next(self._readings, None)
        if reading is None:
            self.close()
            raise StopIteration
        return sample_of(reading, self._targets[reading.key].variable)

    def close(self) -> None:
        """End it; may be called twice."""
        self._stack.close()


def targets_of(client: MeshClient, *names: str) -> list[Target]:
    """The variables that names or patterns mean (`*`: any characters, `?`: one, `re:...`: a regular expression).

    Raises:
        UnknownName: there is none.
    """
    try:
        return client.targets(*names)
    except ConfigurationError as error:
        raise UnknownName(error.message, hint=error.hint) from error


def target_of(client: MeshClient, name: str, *, to_set: bool = False) -> Target:
    """The one variable that a name or a pattern means; for an unknown name, ``to_set`` suggests what can be set.

    Raises:
        UnknownName: there is none, or there are several.
    """
    try:
        return client.target(name, to_set=to_set)
    except ConfigurationError as error:
        raise UnknownName(error.message, hint=error.hint) from error


def sample_of(reading: Reading, view: VariableView) -> Sample:
    """A value as it came over the wire as a sample."""
    value = from_plain(reading.value, view.type, view.shape)
    return Sample(f"{reading.instance}.{reading.variable}", value, reading.point, reading.time, reading.unit)


def follow_to_end(client: MeshClient, future: Future[Result]) -> None:
    """Follow a mesh that somebody else has started to its end, and tell the future how it has ended."""
    from .result import Result  # noqa: PLC0415  not for those who only look

    try:
        file, last = client.info().result_file, None
        with client.statuses(_FOREVER_S) as statuses:
            for status in statuses:
                if last is not None and status.resets != last.resets and status.state in GOING_ON:
                    file = client.info().result_file
                last = status
        if last is not None and last.error is not None:
            future.set_exception(from_report(last.error))
        else:
            future.set_result(Result(client.keys.mesh, file=Path(file) if file is not None else None))
    except BaseException as error:  # noqa: BLE001 whoever waits gets it
        future.set_exception(error)
