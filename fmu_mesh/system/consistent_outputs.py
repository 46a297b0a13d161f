"""Outputs that depend directly on inputs, made consistent at each point (`loops: solved`): the formula of each.

An output is `y + D (u* - u)`, see `fmu_mesh.system.coupling_rule`; the consistent inputs u* follow from such outputs.
So all of them are the solution of one linear system. It is solved here once, with the values of the rows as unknowns.
"""

# In plain floats, and not by LAPACK: a process that is started by hand on another host makes the same plan, and must
# come to the same bits.

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final, TypeVar

from ..config.findings import Findings
from ..text import listed
from .connections import Connection
from .coupling_rule import Consistent, Term

__all__ = ["Feedthrough", "consistent_outputs", "element_pairs", "solve"]

Feedthrough = Mapping[str, Mapping[str, Mapping[str, float]]]
"""By instance, output and input: the derivative of the output by the input at the same point."""

Output = tuple[str, str]
Column = tuple[str, str]

_SINGULAR: Final = 1e-12

Key = TypeVar("Key")


def element_pairs(connection: Connection) -> Iterator[tuple[str, str]]:
    """The names of the elements that a connection connects: of its source, and of its target."""
    c = connection
    sources = (c.source_name,) if c.source_index else c.source.elements
    targets = (c.target_name,) if c.target_index else c.target.elements
    return zip(sources, targets, strict=True)


def consistent_outputs(
    connections: Sequence[Connection],
    feedthrough: Feedthrough,
    step_points: Mapping[str, int],
    findings: Findings,
) -> dict[Output, Consistent]:
    """The formula of each output that depends directly on a connected input.

    Values of an instance with another step size belong to other points, so an output depends on them as it is. A
    finding names the outputs whose values do not follow from each other.
    """
    fed: dict[tuple[str, str], tuple[Output, Connection]] = {}
    for c in connections:
        floats = c.source.type == c.target.type == "Float64" and not c.initial_only and not c.map
        if floats and step_points[c.source_instance] == step_points[c.target_instance]:
            for source, target in element_pairs(c):
                fed[c.target_instance, target] = (c.source_instance, source), c
    direct = {
        (instance, output): {name: value for name, value in inputs.items() if value and (instance, name) in fed}
        for instance, outputs in feedthrough.items()
        for output, inputs in outputs.items()
    }
    direct = {output: inputs for output, inputs in direct.items() if inputs}
    unknown = sorted(direct)
    matrix = [[1.0 if row == column else 0.0 for column in unknown] for row in unknown]
    known: list[dict[Column | None, float]] = []  # what each row is equal to; None: the constant
    for number, output in enumerate(unknown):
        right: dict[Column | None, float] = {output: 1.0}
        for name, value in direct[output].items():
            before, c = fed[output[0], name]
            _add(right, (output[0], name), -value)
            _add(right, None, value * c.offset)
            if before in direct:
                matrix[number][unknown.index(before)] -= value * c.factor
            else:
                _add(right, before, value * c.factor)
        known.append(right)
    if (loop := solve(matrix, known)) is not None:
        names = listed([".".join(unknown[number]) for number in loop])
        found = f"solved, and the values of {names} do not follow from each other: their loop has the gain 1"
        findings.add("simulation.loops", found, "delayed, or a system without this loop")
        return {}
    return {output: _formula(right) for output, right in zip(unknown, known, strict=True)}


def _add(sums: dict[Key, float], column: Key, value: float) -> None:
    sums[column] = sums.get(column, 0.0) + value


def _formula(sums: Mapping[Column | None, float]) -> Consistent:
    columns = sorted(column for column, factor in sums.items() if column is not None and factor)
    return Consistent(sums.get(None, 0.0), tuple(Term(*column, sums[column]) for column in columns))


def solve(matrix: list[list[float]], right: list[dict[Key, float]]) -> list[int] | None:
    """Bring the matrix to the identity by the steps of Gauss and Jordan, and do the same with the right sides.

    Both in place; then each right side is that of the variable with its number.
    Returns the numbers of the rows that are left if there is no solution.
    """
    left = [*range(len(matrix))]
    for column in range(len(matrix)):
        pivot = max(left, key=lambda row: abs(matrix[row][column]))
        if abs(matrix[pivot][column]) <= _SINGULAR:
            return [row for row in left if any(matrix[row])] or left
        left.remove(pivot)
        divisor = matrix[pivot][column]
        matrix[pivot] = [value / divisor for value in matrix[pivot]]
        right[pivot] = {name: value / divisor for name, value in right[pivot].items()}
        for row, values in enumerate(matrix):
            if row != pivot and (factor := values[column]):
                matrix[row] = [a - factor * b for a, b in zip(values, matrix[pivot], strict=True)]
                for name, value in right[pivot].items():
                    _add(right[row], name, -factor * value)
    order = [next(column for column, value in enumerate(values) if value) for values in matrix]
    right[:] = [right[order.index(column)] for column in range(len(matrix))]
    return None
