"""Environments of Gymnasium: `MeshEnv`, one copy of a mesh, and `MeshVectorEnv`, many copies in one call.

What they do is `episodes`; this module knows what Gymnasium asks for: spaces, seeds, and how an episode begins anew.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Space
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ..errors import CallRefused
from ..text import option_text
from .episodes import Episodes, SpaceColumn
from .task import Task

__all__ = ["MeshEnv", "MeshVectorEnv"]

Array = NDArray[Any]


class MeshEnv(gymnasium.Env[Array, Array]):
    """One copy of a mesh as an environment of Gymnasium, in this process.

    `reset(options={"cart.theta": 0.1})` begins with these start values, in place of those of the task.

    Example:
        >>> task = fmu_mesh.gym.Task(
        ...     mesh="configs/cart_pole.yaml",
        ...     observations=["cart.x", "cart.theta"],
        ...     actions={"cart.force": (-10.0, 10.0)},
        ...     reward=lambda step: 1.0 - step["cart.theta"] ** 2,
        ...     terminated=lambda step: abs(step["cart.theta"]) > 0.8,
        ...     start_values=lambda random, copies: {"cart.theta": random.uniform(-0.1, 0.1, copies)},
        ... )
        >>> environment = MeshEnv(task)
        >>> observation, info = environment.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = environment.step(np.array([0.5]))
        >>> observation.shape, reward > 0.9, terminated, truncated
        ((2,), True, False, False)
        >>> environment.close()

    Args:
        task: the task.
        options: of `Mesh.batch`, such as ``step_size``.

    Raises:
        CallRefused: the task cannot be done with this mesh.
        ConfigurationError: the mesh or an option is wrong.
        FmuError: an FMU cannot be opened or initialized.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, task: Task, **options: Any) -> None:  # noqa: ANN401  as `Mesh.batch` takes them
        self.task = task
        self._episodes: Episodes | None = Episodes(task, 1, options)
        self.observation_space = _observation_space(self._episodes.observed, task)
        self.action_space = _action_space(self._episodes.acted, task)
        self._goes_on = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of the generator that start values are drawn from; None: it goes on.
            options: start values, by name.

        Returns:
            The first observation, and nothing more.
        """
        super().reset(seed=seed)
        episodes = _opened(self._episodes)
        episodes.begin(self.np_random, options or {})
        self._goes_on = True
        return episodes.observations[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Take one step.

        Args:
            action: an element of `action_space`.

        Returns:
            Observation, reward, whether the episode came to its end, whether its time is up, and ``info``: with
            ``"reason"`` if the FMU ended it.

        Raises:
            ResetNeeded: the episode is over, or has not begun.
            CallRefused: the action is not one of this task.
        """
        episodes = _opened(self._episodes)
        if not self._goes_on:
            raise ResetNeeded("call reset before step")
        done = episodes.step(np.asarray(action)[None], np.zeros(1, dtype=bool), self.np_random)
        terminated, truncated = bool(done.terminated[0]), bool(done.truncated[0])
        self._goes_on = not (terminated or truncated)
        info = {"reason": done.reasons[0]} if 0 in done.reasons else {}
        return episodes.observations[0], float(done.rewards[0]), terminated, truncated, info

    def close(self) -> None:
        """Free the FMUs. May be called twice."""
        if self._episodes is not None:
            self._episodes.close()
            self._episodes = None


class MeshVectorEnv(VectorEnv[Array, Array, Array]):
    """Many copies of a mesh as a vector environment of Gymnasium: a step of all copies is one call of a batch.

    An episode that is over begins anew in the next step (`AutoresetMode.NEXT_STEP`): this step returns its first
    observation and a reward of 0, and its action does not count. One generator draws all start values, as the seed of
    `reset` says. `reset(options={"cart.theta": angles})` begins with these start values.

    Example:
        >>> task = fmu_mesh.gym.Task(
        ...     mesh="configs/cart_pole.yaml",
        ...     observations=["cart.x", "cart.theta"],
        ...     actions={"cart.force": (-10.0, 10.0)},
        ...     reward=lambda step: 1.0 - step["cart.theta"] ** 2,
        ...     terminated=lambda step: abs(step["cart.theta"]) > 0.8,
        ... )
        >>> environments = MeshVectorEnv(task, num_envs=3)
        >>> observations, infos = environments.reset(seed=1, options={"cart.theta": [0.0, 0.1, 0.79]})
        >>> observations, rewards, terminated, truncated, infos = environments.step(np.zeros((3, 1)))
        >>> observations.shape, terminated.tolist()
        ((3, 2), [False, False, False])
        >>> environments.close()

    Args:
        task: the task.
        num_envs: how many copies.
        options: of `Mesh.batch`, such as ``step_size``.

    Raises:
        CallRefused: the task cannot be done with this mesh.
        ConfigurationError: the mesh or an option is wrong.
        FmuError: an FMU cannot be opened or initialized.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as above
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, task: Task, num_envs: int, **options: Any) -> None:  # noqa: ANN401  as `Mesh.batch` takes them
        if num_envs < 1:
            raise CallRefused(f"{option_text('num_envs', num_envs)}: expected 1 or more")
        self.task = task
        self.num_envs = num_envs
        self._episodes: Episodes | None = Episodes(task, num_envs, options)
        self.single_observation_space = _observation_space(self._episodes.observed, task)
        self.single_action_space = _action_space(self._episodes.acted, task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over: NDArray[np.bool_] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode in all copies.

        Args:
            seed: of the generator that start values are drawn from; None: it goes on.
            options: start values, by name: one for all copies, or an array with one for each.

        Returns:
            The first observations, of shape (num_envs, elements), and nothing more.
        """
        super().reset(seed=seed)
        episodes = _opened(self._episodes)
        episodes.begin(self.np_random, options or {})
        self._over = np.zeros(self.num_envs, dtype=bool)
        return episodes.observations, {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Take one step in all copies.

        Args:
            actions: an element of `action_space`: the first dimension is the copy.

        Returns:
            Observations, of shape (num_envs, elements), and of shape (num_envs,) each: rewards, which episodes came to
            their end, and which ones are out of time. At last ``infos``: with ``"reason"`` and the mask ``"_reason"``,
            if an FMU ended an episode.

        Raises:
            ResetNeeded: reset was not called.
            CallRefused: an action is not one of this task.
        """
        episodes = _opened(self._episodes)
        if self._over is None:
            raise ResetNeeded("call reset before step")
        done = episodes.step(actions, self._over, self.np_random)
        self._over = done.terminated | done.truncated
        infos: dict[str, Any] = {}
        for copy, reason in done.reasons.items():
            infos = self._add_info(infos, {"reason": reason}, copy)
        return episodes.observations, done.rewards, done.terminated, done.truncated, infos

    def close_extras(self) -> None:
        """Free the FMUs; `close` calls it once."""
        if self._episodes is not None:
            self._episodes.close()
            self._episodes = None


def _opened(episodes: Episodes | None) -> Episodes:
    if episodes is None:
        raise ClosedEnvironmentError("this environment is closed; make a new one")
    return episodes


def _observation_space(columns: tuple[SpaceColumn, ...], task: Task) -> Space[Array]:
    sizes = [column.size for column in columns]
    low = np.repeat([column.low for column in columns], sizes).astype(task.dtype)
    high = np.repeat([column.high for column in columns], sizes).astype(task.dtype)
    return Box(low, high, dtype=low.dtype.type)


def _action_space(columns: tuple[SpaceColumn, ...], task: Task) -> Space[Any]:
    sizes = [column.size for column in columns]
    low = np.repeat([column.low for column in columns], sizes)
    high = np.repeat([column.high for column in columns], sizes)
    if columns[0].is_whole:
        start, counts = low.astype(np.int64), (high - low + 1.0).astype(np.int64)
        return Discrete(int(counts[0]), start=int(start[0])) if len(low) == 1 else MultiDiscrete(counts, start=start)
    if task.scaled:
        low, high = np.full_like(low, -1.0), np.full_like(high, 1.0)
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)
