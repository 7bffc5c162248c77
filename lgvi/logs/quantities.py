"""Units of signals, and the axes of bodies and of space."""

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ..modules.units import FACTORS, standard_spelling

UNITS_OF_QUANTITIES = {
    "angular_velocity": "rad/s",
    "specific_force": "m/s²",
    "magnetic_field": "T",
    "position": "m",
    "direction": "1",
    "attitude": "rad",
    "body_torque": "N m",
    "rotor_momentum": "rad/s",
    "rotor_speed": "rad/s",
}

# From axes of a body to forward, left, up, and from axes of space to east, north, up.
BODY_AXES = {"FLU": np.eye(3), "FRD": np.diag([1.0, -1.0, -1.0])}
SPACE_AXES = {
    "ENU": np.eye(3),
    "NED": np.array([[0, 1.0, 0], [1, 0, 0], [0, 0, -1]]),
    "NWU": np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]),
}


def factor_between(unit: str, to: str) -> float | None:
    """The factor from a unit, perhaps with a number before it, to one of the library, if any.

    With a number counts have a unit: `"0.061 deg/s"` are counts of 0.061 deg/s.
    """
    number, _, rest = unit.strip().partition(" ")
    try:
        size, unit = float(number), rest
    except ValueError:
        size = 1.0
    unit = standard_spelling(unit)
    factor = 1.0 if unit == to else FACTORS.get(to, {}).get(unit)
    return None if factor is None or not 0 < size < math.inf else size * factor


def between_axes(
    axes: Mapping[str, Float[np.ndarray, "3 3"]], source: str, target: str
) -> Float[np.ndarray, "3 3"]:
    """The matrix from one set of axes to another, which are the same or known here."""
    return np.eye(3) if source == target else axes[target].T @ axes[source]
