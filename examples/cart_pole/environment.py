"""The task of the cart of `configs/cart_pole.yaml`: keep the pole up.

A training program steps the mesh in its own process. From the root of the repository, one episode with random pushes:

    python examples/cart_pole/environment.py
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fmu_mesh.gym import MeshEnv, Step, Task

__all__ = ["STATE", "TASK"]

STATE = ("cart.x", "cart.der(x)", "cart.theta", "cart.der(theta)")
"""m, m/s, rad, rad/s."""

STARTS = np.array([0.5, 0.5, 0.2, 0.5])
"""Largest start values of the state."""

LIMITS = np.array([4.8, 20.0, 1.6, 20.0])
"""No episode comes so far."""

LARGEST_FORCE = 10.0
"""N."""

END_OF_TRACK = 2.4
"""m."""

FALLEN = 0.8
"""rad."""

Array = NDArray[np.float64]


def reward(step: Step) -> Array:
    """1 for each step, less what the pole and the cart are off and what the push costs; 0 when it is over."""
    off = (step["cart.theta"] / FALLEN) ** 2 + 0.5 * (step["cart.x"] / END_OF_TRACK) ** 2
    cost = off + 0.01 * (step["cart.force"] / LARGEST_FORCE) ** 2
    return np.where(is_over(step), 0.0, 1.0 - cost)


def is_over(step: Step) -> NDArray[np.bool_]:
    """Whether the pole has fallen or the cart has left its track."""
    return (np.abs(step["cart.theta"]) > FALLEN) | (np.abs(step["cart.x"]) > END_OF_TRACK)


def start_values(random: np.random.Generator, copies: int) -> dict[str, Array]:
    """A random state for each copy."""
    return dict(zip(STATE, STARTS[:, None] * random.uniform(-1.0, 1.0, (len(STATE), copies)), strict=True))


TASK = Task(
    mesh=Path(__file__).parents[2] / "configs" / "cart_pole.yaml",
    observations=dict(zip(STATE, zip(-LIMITS, LIMITS, strict=True), strict=True)),
    actions={"cart.force": (-LARGEST_FORCE, LARGEST_FORCE)},
    reward=reward,
    terminated=is_over,
    start_values=start_values,
)
"""An action from -1 to 1 stands for -10 N to 10 N, and holds for 0.02 s. An episode takes 10 s at most."""


def main() -> None:
    """Let one episode go by with random pushes."""
    with closing(MeshEnv(TASK)) as environment:
        environment.reset(seed=1)
        environment.action_space.seed(1)
        total, steps, over = 0.0, 0, False
        while not over:
            _, gained, terminated, truncated, _ = environment.step(environment.action_space.sample())
            total, steps, over = total + gained, steps + 1, terminated or truncated
    print(f"{steps} steps with random pushes: reward {total:.1f}")


if __name__ == "__main__":
    main()
