"""Trains a small network that balances the pole of `fmus/CartPole.fmu`, and writes it as `policy.onnx`.

The method is the cross-entropy method: draw networks around a mean, let all of them balance from random starts, and
move the mean to the best ones. All episodes of a generation are copies of one vector environment, which are stepped in
one call. The method needs numpy only, and onnx to write the file. From the root of the repository:

    python examples/cart_pole/train.py --output policy.onnx
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from environment import LARGEST_FORCE, TASK
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from fmu_mesh.gym import MeshVectorEnv

Array = NDArray[np.float64]

HIDDEN = 8
SHAPES = ((4, HIDDEN), (HIDDEN,), (HIDDEN, 1))
SIZES = [int(np.prod(shape)) for shape in SHAPES]


class Effort(NamedTuple):
    """How much is tried.

    Attributes:
        generations: how often the mean moves.
        candidates: networks in a generation.
        best: how many of them the mean moves to.
        episodes: starts that each of them balances from.
        steps: of an episode of the training, 0.02 s each.
    """

    generations: int = 60
    candidates: int = 24
    best: int = 5
    episodes: int = 4
    steps: int = 300


def main() -> None:
    """Train, write the network, and show what it is worth."""
    parser = argparse.ArgumentParser(description="Train a policy for CartPole.fmu.")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name("policy.onnx"))
    parser.add_argument("--generations", type=int, default=Effort().generations)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    network = trained(Effort(generations=options.generations), options.seed)
    onnx.save(as_onnx(network), options.output)
    print(f"{options.output}: {options.output.stat().st_size} bytes")
    print(f"reward of an episode: {worth(network):.1f} with the network, {worth(None):.1f} with random pushes")


def trained(effort: Effort, seed: int) -> Array:
    """The parameters of a network that was trained."""
    random = np.random.default_rng(seed)
    mean, spread = np.zeros(sum(SIZES)), np.ones(sum(SIZES))
    with closing(MeshVectorEnv(TASK, effort.candidates * effort.episodes)) as environments:
        for generation in range(effort.generations):
            networks = mean + spread * random.standard_normal((effort.candidates, len(mean)))
            starts = TASK.start_values(random, effort.episodes)
            # All networks balance from the same starts: it is the network that makes the difference.
            starts = {name: np.tile(values, effort.candidates) for name, values in starts.items()}
            act = acting(np.repeat(networks, effort.episodes, axis=0))
            rewards = (
                episode_rewards(environments, act, effort.steps, starts).reshape(effort.candidates, -1).mean(axis=1)
            )
            best = networks[np.argsort(-rewards)[: effort.best]]
            mean, spread = best.mean(axis=0), best.std(axis=0) + 0.1 * 0.95**generation
            if generation % 10 == 9:
                print(f"generation {generation + 1}: reward {rewards.max():.1f} of {effort.steps}")
    return mean


def worth(network: Array | None, episodes: int = 100, seed: int = 1) -> float:
    """The mean reward of episodes of 10 s; None: of random pushes."""
    with closing(MeshVectorEnv(TASK, episodes)) as environments:
        environments.action_space.seed(seed)
        act = acting(network[None]) if network is not None else lambda _: environments.action_space.sample()
        starts = TASK.start_values(np.random.default_rng(seed), episodes)
        return float(episode_rewards(environments, act, 500, starts).mean())


def episode_rewards(
    environments: MeshVectorEnv, act: Callable[[Array], Array], steps: int, starts: dict[str, Array]
) -> Array:
    """The sum of the rewards of the first episode of each copy, over so many steps at most."""
    observations, _ = environments.reset(options=starts)
    total, goes_on = np.zeros(environments.num_envs), np.ones(environments.num_envs, dtype=bool)
    for _ in range(steps):
        observations, rewards, terminated, truncated, _ = environments.step(act(observations))
        total += np.where(goes_on, rewards, 0.0)
        goes_on &= ~(terminated | truncated)
        if not goes_on.any():
            break
    return total


def acting(networks: Array) -> Callable[[Array], Array]:
    """What each network does, or one network everywhere: observations of shape (copies, 4) to actions (copies, 1)."""
    first, bias, second = parts(networks)
    return lambda seen: np.tanh(np.tanh(seen[:, None, :] @ first + bias[:, None, :]) @ second)[:, 0]


def parts(networks: Array) -> list[Array]:
    """The parameters as matrices, of shape (networks, ...)."""
    pieces = np.split(networks, np.cumsum(SIZES)[:-1], axis=-1)
    return [piece.reshape(*networks.shape[:-1], *shape) for piece, shape in zip(pieces, SHAPES, strict=True)]


def as_onnx(network: Array) -> onnx.ModelProto:
    """The network with one input of four elements and one output: observation and force."""
    names = ("first", "bias", "second")
    weights = dict(zip(names, (piece.astype(np.float32) for piece in parts(network)), strict=True))
    weights["scale"] = np.array(LARGEST_FORCE, dtype=np.float32)
    nodes = [
        helper.make_node("MatMul", ["observation", "first"], ["product"]),
        helper.make_node("Add", ["product", "bias"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["hidden"]),
        helper.make_node("MatMul", ["hidden", "second"], ["answer"]),
        helper.make_node("Tanh", ["answer"], ["part"]),
        helper.make_node("Mul", ["part", "scale"], ["force"]),
    ]
    graph = helper.make_graph(
        nodes,
        "cart_pole_policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", 4])],
        [helper.make_tensor_value_info("force", TensorProto.FLOAT, ["batch", 1])],
        [numpy_helper.from_array(array, name) for name, array in weights.items()],
        doc_string="x, der(x), theta, der(theta) of CartPole.fmu to the force on the cart in N",
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return model


if __name__ == "__main__":
    main()
