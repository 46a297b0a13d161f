"""A mesh as an environment of Gymnasium: the cart of `fmus/CartPole.fmu`, and a pole to keep up.

A training program steps the mesh in its own process (`Mesh.open`). From the root of the repository, with random pushes:

    python examples/cart_pole/environment.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

import fmu_mesh

__all__ = ["CartPole"]

STATE = ("x", "der(x)", "theta", "der(theta)")
STARTS = np.array([0.5, 0.5, 0.2, 0.5])
"""Largest start values of the state in m, m/s, rad, rad/s."""

LIMITS = np.array([4.8, 20.0, 1.6, 20.0], dtype=np.float32)
"""No episode comes so far."""

LARGEST_FORCE = 10.0
"""N."""

END_OF_TRACK = 2.4
"""m."""

FALLEN = 0.8
"""rad."""


class CartPole(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Keep the pole up, and the cart near the middle of its track.

    An observation is x, der(x), theta, der(theta). An action is the force as a part of 10 N, from -1 to 1; it is held
    for 0.02 s. The reward of a step is 1, less what the pole and the cart are off. An episode ends when the pole has
    fallen or the cart has left its track (terminated), or after 10 s (truncated).
    """

    def __init__(self, fmu: str | Path = Path(__file__).parents[2] / "fmus" / "CartPole.fmu") -> None:
        self.observation_space = Box(-LIMITS, LIMITS, dtype=np.float32)
        self.action_space = Box(-1.0, 1.0, (1,), dtype=np.float32)
        self._mesh = fmu_mesh.Mesh("cart_pole", step_size=0.02, stop_time=10.0)
        self._mesh.add("cart", fmu=str(fmu))
        self._system: fmu_mesh.System | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode from a random state, or from that of `options`, such as `{"theta": 0.1}`."""
        super().reset(seed=seed)
        self.close()
        start = dict(zip(STATE, (STARTS * self.np_random.uniform(-1.0, 1.0, len(STATE))).tolist(), strict=True))
        start |= options or {}
        self._system = self._mesh.open(start_values={f"cart.{name}": value for name, value in start.items()})
        return self._observation(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push the cart for one step."""
        system = self._running()
        system.set("cart.force", LARGEST_FORCE * float(np.clip(action[0], -1.0, 1.0)))
        system.step()
        observation = self._observation()
        x, _, theta, _ = observation.tolist()
        terminated = abs(x) > END_OF_TRACK or abs(theta) > FALLEN
        reward = 0.0 if terminated else 1.0 - (theta / FALLEN) ** 2 - 0.1 * (x / END_OF_TRACK) ** 2
        return observation, reward, terminated, system.point == system.last_point, {}

    def close(self) -> None:
        """Free the FMU."""
        if self._system is not None:
            self._system.close()
            self._system = None

    def _observation(self) -> NDArray[np.float32]:
        system = self._running()
        return np.array([system.get(f"cart.{name}") for name in STATE], dtype=np.float32)

    def _running(self) -> fmu_mesh.System:
        if self._system is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        return self._system


def main() -> None:
    """Let one episode go by with random pushes."""
    environment = CartPole()
    environment.reset(seed=1)
    environment.action_space.seed(1)
    total, steps, over = 0.0, 0, False
    while not over:
        _, reward, terminated, truncated, _ = environment.step(environment.action_space.sample())
        total, steps, over = total + reward, steps + 1, terminated or truncated
    environment.close()
    print(f"{steps} steps with random pushes: reward {total:.1f}")


if __name__ == "__main__":
    main()
