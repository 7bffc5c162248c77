"""The centre of mass in one simulation: what acts on it, and checks."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..core.step.solution import SolverInfo
from ..core.trajectory.translation import CentreOfMass, CentrePath
from ..core.typed_arrays import as_floats
from .errors import error_if
from .fields import shaped_array
from .forces.law import Force, during, require_force
from .function_of_arrays import FunctionOfArrays
from .mass.mass_properties import MassProperties
from .torques.law import Torque, as_law


class SpecificForce(eqx.Module):
    """The sum of forces over the mass (3,), body frame, m/s²: what an accelerometer feels.

    As a function of `t`, `R`, `omega` and `v`, at the centre of mass.
    """

    mass: Float[Array, ""]
    force: Force | None
    force_of_torque: Force | None

    @classmethod
    def of(cls, mass: Array, force: Force | None, torque: Torque | None) -> "SpecificForce":
        """Of a force law, and of the torque laws that have a force."""
        return cls(mass, force, None if torque is None else as_law("torque", torque).force_law)

    def __call__(self, t: Any, R: Any, omega: Any, v: Any) -> Float[Array, "3"]:
        laws = {
            "force(t, R, omega, v)": self.force,
            "torque.force_law(t, R, omega, v)": self.force_of_torque,
        }
        forces = {
            name: (law(t, R, omega, v), (3,)) for name, law in laws.items() if law is not None
        }
        v, mass, *values = as_floats(v=(v, (3,)), mass=(self.mass, ()), **forces)
        return sum(values, start=jnp.zeros_like(v)) / mass


def as_mass(mass: ArrayLike | MassProperties) -> Float[Array, ""]:
    """A mass, or that of mass properties, above 0 if its value is known.

    Raises
    ------
    ValueError, TypeError
        If it is no number above 0.
    """
    array = shaped_array("mass", mass.mass if isinstance(mass, MassProperties) else mass, ())
    if not isinstance(array, Tracer) and not 0 < float(np.asarray(array)) < np.inf:
        raise ValueError(f"Argument `mass` must be above 0 kg and finite, but is {array}.")
    return array


def centre_of_mass_of(
    force: Force | None,
    torque: Torque | None,
    mass: ArrayLike | MassProperties | None,
    gravity: ArrayLike | None,
    x0: ArrayLike | None,
    v0: ArrayLike | None,
    times: Callable[[], Array],
    throw: bool,
) -> CentreOfMass | None:
    """The centre of mass for a simulation at some times; None if no argument is about it.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or there is a force without a mass.
    RuntimeError
        If `throw` and a sampled force does not cover the times.
    """
    if all(argument is None for argument in (force, mass, gravity, x0, v0)):
        return None
    # Zeros are integers, so that the precision is that of what is known.
    x, v, gravity = (
        np.zeros(3, int) if value is None else shaped_array(name, value, (3,))
        for name, value in {"x0": x0, "v0": v0, "gravity": gravity}.items()
    )
    if force is not None:
        require_force("force", force)
        if mass is None:
            raise ValueError("Argument `mass` must be given where there is a `force`.")
        force = during(force, times, throw)
    if mass is None and torque is not None and as_law("torque", torque).force_law is not None:
        raise ValueError(
            "Argument `mass` must be given where a `torque` has a force too, and the centre of "
            "mass moves."
        )
    # Without a mass there is no force, and the fall does not depend on the mass.
    if mass is None:
        specific_force = SpecificForce(jnp.asarray(1.0), None, None)
    else:
        specific_force = SpecificForce.of(as_mass(mass), force, torque)
    return CentreOfMass(CentrePath(x, v), gravity, FunctionOfArrays(specific_force))


def check_path(
    info: SolverInfo, path: CentrePath, t: Array, throw: bool
) -> tuple[SolverInfo, CentrePath]:
    """The path with the info of the steps, which have not converged where it is not finite.

    Raises
    ------
    RuntimeError
        If `throw` and a position or a velocity is not finite.
    """
    finite, converged = _finite(path, info.converged)
    info = info._replace(converged=converged)
    if not throw:
        return info, path

    def describe(t: np.ndarray, finite: np.ndarray) -> str:
        time = t[np.argmin(finite)]
        return (
            f"The position or the velocity is not finite at {time:.6g} s: the force, or `x0`, `v0` "
            "or `gravity`, is not, or the force changes too fast with the velocity for the step: "
            "take a smaller `dt`."
        )

    return info, error_if(path, ~finite.all(), describe, lambda: (t, finite))


@jax.jit
def _finite(path: CentrePath, converged: Array) -> tuple[Array, Array]:
    """Whether each state is finite, and whether the steps to each have converged."""
    finite = jnp.all(jnp.isfinite(path.x) & jnp.isfinite(path.v), axis=1)
    return finite, converged & finite[1:]
