"""What is to be learned in a mesh: what is seen and done, what it is worth, and when it ends. Knows no Gymnasium."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..api.mesh_builder import Mesh

__all__ = ["Step", "Task"]

Names = Sequence[str] | Mapping[str, tuple[float, float] | None]


class Step:
    """What happened in one step of all copies: the argument of the functions of a `Task`.

    `step["cart.x"]` has the values after the step, as an array whose first dimension is the copy: (copies,) for a
    scalar. Every variable of the mesh can be read; values are in the units of the variables. An action has the value
    that its input was set to.

    Example:
        >>> import numpy as np
        >>> step = Step({"cart.x": np.array([0.1, 0.3])}, {"cart.x": np.array([0.0, 0.0])}, np.full(2, 0.02), {}.get)
        >>> ((step["cart.x"] - step.before["cart.x"]) / step.time).round(9).tolist()
        [5.0, 15.0]

    Args:
        after: values after the step, by name.
        before: see below.
        time: see below.
        read: reads any other variable.

    Attributes:
        before: the observed values before the step, by name.
        time: the simulation times in s after the step, of shape (copies,).
    """

    def __init__(
        self,
        after: Mapping[str, NDArray[Any]],
        before: Mapping[str, NDArray[Any]],
        time: NDArray[np.float64],
        read: Callable[[str], NDArray[Any]],
    ) -> None:
        self.before = before
        self.time = time
        self._after = after
        self._read = read

    def __getitem__(self, name: str) -> NDArray[Any]:
        found = self._after.get(name)
        return self._read(name) if found is None else found


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A task in a mesh, for `MeshEnv` and `MeshVectorEnv`.

    The functions work on all copies at once: what they get and return are arrays whose first dimension is the copy. An
    environment of one copy calls them with arrays of one element, so one task serves for both. Variables are named
    `instance.variable`, of all instances of the mesh.

    Example:
        >>> task = Task(
        ...     mesh="configs/cart_pole.yaml",
        ...     observations=["cart.x", "cart.theta"],
        ...     actions={"cart.force": (-10.0, 10.0)},
        ...     reward=lambda step: 1.0 - step["cart.theta"] ** 2,
        ...     terminated=lambda step: abs(step["cart.theta"]) > 0.8,
        ...     start_values=lambda random, copies: {"cart.theta": random.uniform(-0.1, 0.1, copies)},
        ... )
        >>> task.points
        1

    Attributes:
        mesh: the mesh, or the path of its file.
        observations: what is observed; any variables, also arrays, which are flattened. As a mapping: the bounds of
            each one, in its unit. Without bounds, the minimum and the maximum of the model description count.
        actions: the inputs (or tunable parameters) that an action sets, with bounds as above. Numbers with a fraction
            need both bounds, or ``scaled=False``; whole numbers need them always.
        reward: the reward of each copy for a step.
        terminated: which copies have come to an end of the task; None: none has. A copy whose FMU asks to end, or
            fails, is terminated anyway.
        start_values: the start values of that many new episodes, as arrays with one value for each, or one for all. It
            has to draw its numbers from this generator. None: all episodes begin as the mesh does.
        points: how many communication points an action holds.
        episode_time: after so many seconds of simulation time, an episode is truncated; None: at the stop time of the
            mesh. No episode goes on after the stop time.
        scaled: whether an action is between -1 and 1, where these stand for the bounds, as learning programs expect it;
            False: it has the unit of the variable. Actions beyond the bounds count as the bounds.
        dtype: of observations. Rewards and starts are computed with the values as the mesh has them.
    """

    mesh: Mesh | str | Path
    observations: Names
    actions: Names
    reward: Callable[[Step], ArrayLike]
    terminated: Callable[[Step], ArrayLike] | None = None
    start_values: Callable[[np.random.Generator, int], Mapping[str, ArrayLike]] | None = None
    points: int = 1
    episode_time: float | None = None
    scaled: bool = True
    dtype: DTypeLike = np.float32
