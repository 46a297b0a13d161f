"""Trains a small network that balances the pole of `fmus/CartPole.fmu`, and writes it as `policy.onnx`.

The method is the cross-entropy method: draw networks around a mean, let all of them balance from random starts,
and move the mean to the best ones. It needs numpy only, and onnx to write the file. From the root of the repository:

    python examples/cart_pole/train.py --output policy.onnx
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

Array = NDArray[np.float64]

STEP_SIZE = 0.02
"""s, as in `balance.yaml`."""

STARTS = np.array([0.5, 0.5, 0.2, 0.5])
"""Largest start values of x, der(x), theta, der(theta) in m, m/s, rad, rad/s."""

LARGEST_FORCE = 10.0
"""N."""

HIDDEN = 8
SHAPES = ((4, HIDDEN), (HIDDEN,), (HIDDEN, 1))
SIZES = [int(np.prod(shape)) for shape in SHAPES]

CANDIDATES, BEST, EPISODES, STEPS = 64, 12, 24, 400


def main() -> None:
    """Train, and write the best network."""
    parser = argparse.ArgumentParser(description="Train a policy for CartPole.fmu.")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name("policy.onnx"))
    parser.add_argument("--generations", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    mean = trained(options.generations, np.random.default_rng(options.seed))
    onnx.save(as_onnx(mean), options.output)
    print(f"{options.output}: {options.output.stat().st_size} bytes")


def trained(generations: int, random: np.random.Generator) -> Array:
    """The parameters of a network after so many generations."""
    mean, spread = np.zeros(sum(SIZES)), np.ones(sum(SIZES))
    for generation in range(generations):
        candidates = mean + spread * random.standard_normal((CANDIDATES, len(mean)))
        starts = STARTS * random.uniform(-1.0, 1.0, (EPISODES, 4))
        costs = cost(candidates, starts)
        best = candidates[np.argsort(costs)[:BEST]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.1 * 0.95**generation
        if generation % 10 == 9:
            print(f"generation {generation + 1}: cost {cost(mean[None], starts)[0]:.4f}")
    return mean


def cost(candidates: Array, starts: Array) -> Array:
    """The mean cost of each candidate over all starts and steps."""
    state = np.broadcast_to(starts, (len(candidates), *starts.shape))
    total = np.zeros(state.shape[:2])
    fallen = np.zeros(state.shape[:2], dtype=bool)
    for _ in range(STEPS):
        force = forces(candidates, state)
        state = np.where(fallen[..., None], state, runge_kutta(state, force))
        fallen |= (np.abs(state[..., 2]) > 0.8) | (np.abs(state[..., 0]) > 2.4)
        total += np.where(fallen, 2.0, 4.0 * state[..., 2] ** 2 + 0.2 * state[..., 0] ** 2 + 1e-4 * force**2)
    return np.asarray(total.mean(axis=1) / STEPS)


def forces(candidates: Array, state: Array) -> Array:
    """The force in N of each candidate in each of its episodes."""
    first, bias, second = parts(candidates)
    hidden = np.tanh(state @ first + bias[:, None, :])
    return np.asarray(LARGEST_FORCE * np.tanh((hidden @ second)[..., 0]))


def parts(candidates: Array) -> list[Array]:
    """The parameters as matrices, of shape (candidates, ...)."""
    pieces = np.split(candidates, np.cumsum(SIZES)[:-1], axis=-1)
    return [piece.reshape(*candidates.shape[:-1], *shape) for piece, shape in zip(pieces, SHAPES, strict=True)]


def runge_kutta(state: Array, force: Array) -> Array:
    """The states one step later, while the force is held."""
    k1 = rates(state, force)
    k2 = rates(state + 0.5 * STEP_SIZE * k1, force)
    k3 = rates(state + 0.5 * STEP_SIZE * k2, force)
    k4 = rates(state + STEP_SIZE * k3, force)
    return state + STEP_SIZE / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


def rates(state: Array, force: Array) -> Array:
    """How fast the states change, with the default parameters of the FMU (docs/models/CartPole.md)."""
    pole_mass, mass, length, gravity = 0.1, 1.1, 0.5, 9.81
    _, velocity, angle, turning = np.moveaxis(state, -1, 0)
    sine, cosine = np.sin(angle), np.cos(angle)
    push = (force + pole_mass * length * turning**2 * sine) / mass
    turn = (gravity * sine - cosine * push) / (length * (4.0 / 3.0 - pole_mass * cosine**2 / mass))
    return np.stack([velocity, push - pole_mass * length * turn * cosine / mass, turning, turn], axis=-1)


def as_onnx(mean: Array) -> onnx.ModelProto:
    """The network with one input of four elements and one output: observation and force."""
    weights = dict(zip(("first", "bias", "second"), (piece.astype(np.float32) for piece in parts(mean)), strict=True))
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
