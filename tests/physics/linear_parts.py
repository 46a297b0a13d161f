"""Parts of coupled linear systems with exact solutions, as components: `x' = A x + B u, y = C x + D u`.

A part takes its step exactly for an input that is constant over it, so all error of a mesh of parts is that of the
coupling. The output `s` is the first state.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import fmu_mesh

__all__ = ["COUPLED", "Coupled", "diagonal", "exponential"]

Array = NDArray[np.float64]


def exponential(matrix: Array) -> Array:
    """The exponential of a matrix: a series for a small multiple of it, squared again and again."""
    squarings = max(0, int(np.ceil(np.log2(max(1e-16, np.abs(matrix).sum(1).max()))))) + 4
    term = result = np.eye(len(matrix))
    for number in range(1, 18):
        term = term @ matrix / 2**squarings / number
        result = result + term
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)


class Matrices(NamedTuple):
    """A part; `x` is its first state, and `free` has values for inputs that nothing feeds."""

    a: list[list[float]]
    b: list[list[float]]
    c: list[list[float]]
    d: list[list[float]]
    x: list[float]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    free: dict[str, float] = {}  # noqa: RUF012  never changed


class LinearPart(fmu_mesh.Component):
    """A part; its subclasses have the matrices and the variables."""

    matrices: ClassVar[Matrices]
    s = fmu_mesh.Output(depends_on=())

    def initialize(self) -> None:
        self.state = np.array(self.matrices.x)
        self._factors: dict[float, Array] = {}
        self._give()

    def step(self, _time: float, step_size: float) -> None:
        if step_size not in self._factors:
            n, m = np.shape(self.matrices.b)
            both = np.zeros((n + m, n + m))
            both[:n, :n], both[:n, n:] = self.matrices.a, self.matrices.b
            self._factors[step_size] = exponential(both * step_size)[:n]
        with np.errstate(all="ignore"):  # a coupling that is not stable ends the run by its row
            self.state = self._factors[step_size] @ np.concatenate([self.state, self._inputs])
        self._give()

    def get_state(self) -> dict[str, list[float]]:
        return {"state": self.state.tolist(), "inputs": self._inputs.tolist()}

    def set_state(self, state: dict[str, list[float]]) -> None:  # type: ignore[override]  # what `get_state` gives
        self.state = np.array(state["state"])
        for name, value in zip(self.matrices.inputs, state["inputs"], strict=True):
            setattr(self, name, value)
        self._give()

    @property
    def _inputs(self) -> Array:
        return np.array([getattr(self, name) for name in self.matrices.inputs])

    def _give(self) -> None:
        with np.errstate(all="ignore"):
            y = np.array(self.matrices.c) @ self.state + np.array(self.matrices.d) @ self._inputs
        for name, value in zip(self.matrices.outputs, y, strict=True):
            setattr(self, name, float(value))
        self.s = float(self.state[0])


def part(name: str, own: Matrices) -> type[LinearPart]:
    """The component of a part."""
    depends = [tuple(i for i, factor in zip(own.inputs, row, strict=True) if factor) for row in own.d]
    members: dict[str, Any] = {one: fmu_mesh.Input(own.free.get(one, 0.0)) for one in own.inputs}
    members |= {one: fmu_mesh.Output(depends_on=on) for one, on in zip(own.outputs, depends, strict=True)}
    return type(name, (LinearPart,), members | {"matrices": own, "__module__": __name__})


class Coupled(NamedTuple):
    """Two parts, the connections between them, and until when they run in s."""

    one: Matrices
    two: Matrices
    links: tuple[str, ...]
    stop_time: float

    def exact(self, step_size: float) -> Array:
        """The first states of both parts at all points: the whole is one linear system. Shape (points, 2)."""
        parts = self.one, self.two
        a, b, c, d = (diagonal([getattr(own, name) for own in parts]) for name in "abcd")
        inputs = [f"{name}.{one}" for name, own in zip(("one", "two"), parts, strict=True) for one in own.inputs]
        outputs = [f"{name}.{one}" for name, own in zip(("one", "two"), parts, strict=True) for one in own.outputs]
        link = np.zeros((len(inputs), len(outputs)))
        for source, target in (one.split(" -> ") for one in self.links):
            link[inputs.index(target), outputs.index(source)] = 1.0
        constant = np.array([own.free.get(one, 0.0) for own in parts for one in own.inputs])
        solved = np.linalg.inv(np.eye(len(inputs)) - link @ d)
        n = len(a)
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n] = a + b @ solved @ link @ c, b @ solved @ constant
        move, state = exponential(whole * step_size), np.array([*self.one.x, *self.two.x, 1.0])
        rows = [state]
        for _ in range(round(self.stop_time / step_size)):
            rows.append(move @ rows[-1])
        return np.array(rows)[:, [0, len(self.one.x)]]


def diagonal(blocks: Sequence[ArrayLike]) -> Array:
    """Two blocks on the diagonal of one matrix."""
    first, second = (np.array(block, float) for block in blocks)
    result = np.zeros((len(first) + len(second), first.shape[1] + second.shape[1]))
    result[: len(first), : first.shape[1]], result[len(first) :, first.shape[1] :] = first, second
    return result


def _masses(kc: float, dc: float, k1: float, d1: float, k2: float, d2: float, x1: float, x2: float) -> Coupled:
    """Two masses of 1 kg, each with a spring and a damper to the ground, and both between them."""
    one = Matrices([[0, 1], [-k1, -d1]], [[0], [1]], [[1, 0], [0, 1]], [[0], [0]], [x1, 0.0], ("F",), ("x", "v"))
    two = Matrices(
        [[0, 1], [-(k2 + kc), -(d2 + dc)]], [[0, 0], [kc, dc]], [[kc, dc]], [[-kc, -dc]], [x2, 0.0], ("x", "v"), ("F",)
    )
    return Coupled(one, two, ("two.F -> one.F", "one.x -> two.x", "one.v -> two.v"), 10.0)


def _ladder(gain: float) -> Coupled:
    """Two circuits, whose loop of voltage and current has a gain."""
    one = Matrices([[-1]], [[1, -1]], [[1]], [[0, gain]], [0.0], ("V", "i"), ("v",), {"V": 1.0})
    two = Matrices([[-2]], [[2]], [[-1]], [[1]], [0.0], ("v",), ("i",))
    return Coupled(one, two, ("one.v -> two.v", "two.i -> one.i"), 5.0)


def _controlled() -> Coupled:
    """A PI controller, whose output depends directly on its input, and a plant of first order."""
    one = Matrices([[0]], [[1, -1]], [[1]], [[2, -2]], [0.0], ("r", "y"), ("u",), {"r": 1.0})
    two = Matrices([[-2]], [[2]], [[1]], [[0]], [0.0], ("u",), ("y",))
    return Coupled(one, two, ("one.u -> two.u", "two.y -> one.y"), 10.0)


def _thermal(conductance: float) -> Coupled:
    """Two heat capacities with a conductance between them."""
    g = conductance
    one = Matrices([[0]], [[1, -1]], [[1]], [[0, 0]], [1.0], ("p", "q"), ("T",), {"p": 1.0})
    two = Matrices([[-(g + 0.5) / 2]], [[g / 2]], [[-g]], [[g]], [0.0], ("T",), ("q",))
    return Coupled(one, two, ("one.T -> two.T", "two.q -> one.q"), 5.0)


COUPLED: Final = {
    "SoftMasses": _masses(10.0, 1.0, 10.0, 1.0, 100.0, 2.0, 1.0, 1.0),
    "MediumMasses": _masses(1e3, 10.0, 10.0, 1.0, 100.0, 2.0, 1.0, 1.0),
    "StiffMasses": _masses(1e5, 1e3, 10.0, 1.0, 100.0, 2.0, 1.0, 1.0),
    "DualMass": _masses(10.0, 0.5, 10.0, 0.2, 20.0, 0.3, 0.0, 0.5),
    "Ladder": _ladder(-0.5),
    "SteepLadder": _ladder(-2.0),
    "Controlled": _controlled(),
    "Thermal": _thermal(1.0),
    "HotThermal": _thermal(1000.0),
}
for _name, _own in COUPLED.items():
    globals().update({f"{_name}1": part(f"{_name}1", _own.one), f"{_name}2": part(f"{_name}2", _own.two)})
