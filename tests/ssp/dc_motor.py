"""The steady state of a DC motor with a constant voltage and a constant torque on its shaft, in closed form."""

from __future__ import annotations

__all__ = ["steady_state"]


def steady_state(
    *, voltage: float, torque: float, resistance: float, constant: float, damping: float
) -> tuple[float, float]:
    """The angular velocity in rad/s and the current in A at which nothing changes any more.

    The circuit and the shaft are (L and J do not matter where both derivatives are 0)::

        L I' = U - R I - k w          0 = U - R I - k w
        J w' = k I + M - d w          0 = k I + M - d w

    The second one gives I = (d w - M) / k. In the first one, U = R (d w - M) / k + k w, so that::

        w = (k U + R M) / (k^2 + R d)

    Args:
        voltage: U in V.
        torque: M in N.m, that of a load is negative.
        resistance: R in Ohm.
        constant: k in N.m/A.
        damping: d in N.m.s/rad.
    """
    speed = (constant * voltage + resistance * torque) / (constant**2 + resistance * damping)
    return speed, (damping * speed - torque) / constant
