"""A body with a damper: a wheel, or a ring of fluid, that friction couples to it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..core.kernels.matrix_properties import is_positive_definite, is_symmetric
from ..core.kernels.vectors import matmul
from ..core.trajectory.damped import simulate_damped
from ..core.typed_arrays import Shape, as_count, as_floats
from .convergence_error import describe_impossible, is_possible
from .errors import error_if
from .fields import float_array, require_shape
from .printing import show


class DampedTrajectory(eqx.Module):
    """Stored states of a body with a damper.

    Attributes
    ----------
    R
        Attitudes (states, 3, 3), body to space, the initial one included.
    pi
        Total angular momenta (states, 3), body frame, kg m²/s.
    spin
        Speeds (states,) of the wheel relative to the body, rad/s.
    t
        Times (states,), s.
    converged
        Whether all steps from a stored state to the next converged (states-1,).
    """

    R: Float[Array, "states 3 3"]
    pi: Float[Array, "states 3"]
    spin: Float[Array, " states"]
    t: Float[Array, " states"]
    converged: Array

    def __repr__(self) -> str:
        return show(self)


class DampedBody(eqx.Module):
    r"""A body with a damper: a wheel on a shaft with friction, or a slug of fluid in a ring.

    The torque of friction is $-f\,\Omega$ for a speed $\Omega$ of the wheel relative to the body,
    about the axis $a$. The total momentum, which nothing but a torque from outside changes in
    space, and the energy, which falls by $f\,\Omega^2$ in each second, are

    $$\pi = J\omega + I\Omega a,\qquad
      T = \tfrac12\,\omega\cdot J\omega + I\Omega\,a\cdot\omega + \tfrac12 I\Omega^2.$$

    So almost every motion ends in a spin about the axis of the largest moment, such as the flat
    spin of a long spacecraft, as long as the nutation turns the wheel: one along the axis of a
    symmetric body takes nothing.

    Parameters
    ----------
    inertia
        Inertia $J$ (3, 3) about the centre of mass with the wheel locked, body frame, kg m²:
        symmetric positive definite, also less $I\,aa^T$. A learnable leaf.
    axis
        Axis $a$ (3,) of the wheel, body frame, a learnable leaf, whose length, above zero, has no
        effect.
    wheel_inertia
        Spin inertia $I$ of the wheel, kg m², above zero, a learnable leaf.
    friction
        Friction $f$ of the shaft, N m s, not below zero, a learnable leaf.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    P. C. Hughes, *Spacecraft Attitude Dynamics*, Wiley 1986, chapter 5.
    """

    inertia: Float[Array, "3 3"] = eqx.field(converter=float_array("inertia"))
    axis: Float[Array, "3"] = eqx.field(converter=float_array("axis"))
    wheel_inertia: Float[Array, ""] = eqx.field(converter=float_array("wheel_inertia"))
    friction: Float[Array, ""] = eqx.field(converter=float_array("friction"))

    def __check_init__(self):
        require_shape("inertia", self.inertia, (3, 3))
        require_shape("axis", self.axis, (3,))
        require_shape("wheel_inertia", self.wheel_inertia, ())
        require_shape("friction", self.friction, ())

    def __repr__(self) -> str:
        return show(self)

    def angular_velocity(
        self, pi: Float[ArrayLike, "3"], spin: Float[ArrayLike, ""]
    ) -> Float[Array, "3"]:
        r"""Angular velocity $\omega = J^{-1}(\pi - I\Omega a)$ (3,), body frame, rad/s."""
        pi, spin, J, a, inertia, _ = self._with_leaves(pi=(pi, (3,)), spin=(spin, ()))
        return jnp.linalg.solve(J, pi - inertia * spin * a)

    def angular_momentum(
        self, omega: Float[ArrayLike, "3"], spin: Float[ArrayLike, ""] = 0.0
    ) -> Float[Array, "3"]:
        r"""Total momentum $\pi = J\omega + I\Omega a$ (3,), body frame, kg m²/s."""
        omega, spin, J, a, inertia, _ = self._with_leaves(omega=(omega, (3,)), spin=(spin, ()))
        return matmul(J, omega) + inertia * spin * a

    def energy(self, pi: Float[ArrayLike, "3"], spin: Float[ArrayLike, ""]) -> Float[Array, ""]:
        """Kinetic energy of the body and the wheel, J."""
        omega = self.angular_velocity(pi, spin)
        omega, spin, J, a, inertia, _ = self._with_leaves(omega=(omega, (3,)), spin=(spin, ()))
        of_wheel = spin * jnp.sum(a * omega) + spin**2 / 2
        return jnp.sum(omega * matmul(J, omega)) / 2 + inertia * of_wheel

    def simulate(
        self,
        R0: Float[ArrayLike, "3 3"],
        pi0: Float[ArrayLike, "3"],
        spin0: Float[ArrayLike, ""] = 0.0,
        *,
        dt: Float[ArrayLike, ""],
        steps: int,
        save_every: int = 1,
        throw: bool = True,
    ) -> DampedTrajectory:
        r"""Motion without a torque from outside, by the implicit midpoint rule, of order 2.

        The momentum in space is kept to rounding, and the energy never rises, whatever the step.
        For $hf > 2I$ the speed of the wheel changes its sign in each step and falls too slowly:
        take a smaller `dt`.

        Parameters
        ----------
        R0
            Initial attitude (3, 3), body to space.
        pi0
            Initial total momentum (3,), body frame, kg m²/s.
        spin0
            Initial speed of the wheel relative to the body, rad/s.
        dt
            Time step, s, above zero.
        steps
            Number of steps, static.
        save_every
            Store one state every `save_every` steps, static; it must divide `steps`.
        throw
            Raise if a step does not converge (static). If False, `converged` tells.

        Returns
        -------
        DampedTrajectory
            The stored states.

        Raises
        ------
        ValueError, TypeError
            For a wrong shape or type, and a `save_every` that does not divide `steps`.
        RuntimeError
            If `throw`, and `R0` is not a rotation, the inertia is not symmetric and positive
            definite, with and without the wheel, another argument is not finite or has a wrong
            sign, or a step does not converge.
        """
        steps, save_every = as_count("steps", steps, 1), as_count("save_every", save_every, 1)
        if steps % save_every:
            raise ValueError(
                f"Argument `save_every` must divide the number of steps, which is {steps}, but is "
                f"{save_every}."
            )
        R, pi, spin, h, J, a, inertia, friction = self._with_leaves(
            R0=(R0, (3, 3)), pi0=(pi0, (3,)), spin0=(spin0, ()), dt=(dt, ())
        )
        without = J - inertia * a[:, None] * a[None]
        wheel = inertia * (spin + jnp.sum(a * self.angular_velocity(pi, spin).astype(pi.dtype)))
        states = simulate_damped(R, pi, wheel, without, a, inertia, friction, h, steps, save_every)
        possible = is_possible(R, J) & is_symmetric(without) & is_positive_definite(without)
        possible &= (inertia > 0) & (friction >= 0) & (h > 0) & jnp.all(jnp.isfinite(states.pi))
        converged = states.converged & possible
        of_body = states.pi - states.wheel[:, None] * a[None]
        omega = jnp.linalg.solve(without, of_body.T).T
        speed = states.wheel / inertia - jnp.sum(omega * a[None], axis=1)
        times = h * save_every * jnp.arange(steps // save_every + 1).astype(h.dtype)
        motion = DampedTrajectory(states.R, states.pi, speed, times, converged)
        if not throw:
            return motion
        values = R, J, without, inertia, friction, h, a, pi, spin, converged
        return error_if(motion, ~jnp.all(converged), _describe, lambda: values)

    def _with_leaves(self, **arguments: tuple[ArrayLike, Shape]) -> tuple[Array, ...]:
        """Arguments and leaves in their common type, with an axis of length one."""
        *values, J, axis, inertia, friction = as_floats(
            **arguments,
            inertia=(self.inertia, (3, 3)),
            axis=(self.axis, (3,)),
            wheel_inertia=(self.wheel_inertia, ()),
            friction=(self.friction, ()),
        )
        return *values, J, axis / jnp.linalg.norm(axis), inertia, friction


def _describe(
    R: np.ndarray,
    J: np.ndarray,
    without: np.ndarray,
    inertia: np.floating,
    friction: np.floating,
    h: np.floating,
    axis: np.ndarray,
    pi: np.ndarray,
    spin: np.floating,
    converged: np.ndarray,
) -> str:
    if impossible := describe_impossible("R0", R, J):
        return impossible
    for name, value, is_right, wanted in (
        ("axis", axis, np.all(np.isfinite(axis)), "finite and not zero"),
        ("wheel_inertia", inertia, 0 < inertia < np.inf, "finite and above 0"),
        ("friction", friction, 0 <= friction < np.inf, "finite and not below 0"),
        ("dt", h, 0 < h < np.inf, "finite and above 0"),
        ("pi0", pi, np.all(np.isfinite(pi)), "finite"),
        ("spin0", spin, np.isfinite(spin), "finite"),
        (
            "wheel_inertia",
            inertia,
            is_positive_definite(without),
            "less than what the body has about the axis of the wheel",
        ),
    ):
        if not is_right:
            return f"Argument `{name}` must be {wanted}, but is {value}."
    first = int(np.argmin(converged))
    return (
        f"A step after stored state {first} did not converge: take a smaller `dt`, by which the "
        "body turns by less than a quarter of a turn, or use `throw=False` and look at `converged`."
    )
