"""Frames of a rigid body: velocities into its axes, and a force at its origin as a force at its centre of mass.

A rotation is the nine numbers of a row-major matrix whose columns are the body's axes in world axes, as MuJoCo's
`xmat` has them: it takes a vector from body axes to world axes. The products are written out on plain floats, so that
every machine adds them in the same order.
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["Vector", "relative_velocity", "to_body", "to_world", "wrench_at_center"]

Vector = tuple[float, float, float]


def to_world(rotation: Sequence[float], vector: Sequence[float]) -> Vector:
    """A vector in body axes as the same vector in world axes."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = vector
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def to_body(rotation: Sequence[float], vector: Sequence[float]) -> Vector:
    """A vector in world axes as the same vector in body axes."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = vector
    return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def relative_velocity(rotation: Sequence[float], velocity: Sequence[float], wind: Sequence[float]) -> Vector:
    """Velocity of a body against the medium in body axes, from both in world axes; all in m/s."""
    return to_body(rotation, (velocity[0] - wind[0], velocity[1] - wind[1], velocity[2] - wind[2]))


def wrench_at_center(
    rotation: Sequence[float], lever: Sequence[float], force: Sequence[float], moment: Sequence[float]
) -> tuple[Vector, Vector]:
    """A force (N) and moment (N m) in body axes at a body's origin, as both in world axes at its centre of mass.

    ``lever`` goes from the centre of mass to the origin in world axes, in m.
    """
    fx, fy, fz = acting = to_world(rotation, force)
    mx, my, mz = to_world(rotation, moment)
    lx, ly, lz = lever
    return acting, (mx + (ly * fz - lz * fy), my + (lz * fx - lx * fz), mz + (lx * fy - ly * fx))
