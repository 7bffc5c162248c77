"""The discrete Moser-Veselov map as a learnable module."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.checks import as_count, as_floats, steps_of_torques
from ..core.dynamics import rigid_body_step
from ..core.moser_veselov import SolverInfo
from ..core.preprocessing import as_order, modified_inertia
from ..core.trajectory import Failure, simulate
from .body import AbstractRigidBody
from .convergence import raise_unless_converged
from .fields import float_array


class Trajectory(NamedTuple):
    """Stored states: those at the ends of all steps, or of every `save_every`-th.

    Attributes
    ----------
    R
        Attitudes (states, 3, 3), body to space, the initial one included.
    pi
        Body angular momenta (states, 3), kg m²/s, the initial one included.
    solver_info
        Of the steps from each state to the next (states-1,): the largest residual norm, and
        whether all converged.
    """

    R: Float[Array, "states 3 3"]
    pi: Float[Array, "states 3"]
    solver_info: SolverInfo


def _tolerance(value: float | None) -> float | None:
    if value is None:
        return None
    as_floats(tolerance=(value, ()))  # raises for what is no number
    if not float(value) >= 0:
        raise ValueError(
            f"Argument `tolerance` must be None or a number not below 0, but is {value!r}."
        )
    return float(value)


class MoserVeselovIntegrator(eqx.Module):
    r"""Lie-group variational integrator of the rigid body.

    A step solves $F J_d - J_d F^T = h\,\hat\pi$ and moves $R \to RF$, $\pi \to F^T\pi$,
    between two half impulses of the torque. Rotations stay rotations, and without torque
    energy and spatial momentum are conserved to rounding.

    Parameters
    ----------
    dt
        Time step, s: a scalar, or one for each step (steps,). A learnable leaf.
    newton_iters
        Newton budget of each step, static.
    tolerance
        Bound on the residual norm for a step to count as converged, kg m², static.
        `None` is the scale-aware bound of
        [`solve_F_with_info`][lgvi.solve_F_with_info], reachable in either precision.
    throw
        Raise when a step does not converge (static). If False, the trajectory is returned
        as it is and `solver_info` tells.
    order
        Order of accuracy in `dt`, static: 2, and without torque also 4, 6, 8, 10 or 12, at the same
        cost. Only order 2 is strictly symplectic.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    J. Moser, A. P. Veselov, Commun. Math. Phys. 139 (1991), doi:10.1007/BF02352494.
    T. Lee, M. Leok, N. H. McClamroch, "Lie group variational integrators for the full
    body problem", Comput. Methods Appl. Mech. Eng. 196 (2007),
    doi:10.1016/j.cma.2007.01.017.
    """

    dt: Float[Array, "*steps"] = eqx.field(converter=float_array("dt"))
    newton_iters: int = eqx.field(
        default=8, static=True, converter=lambda value: as_count("newton_iters", value, 1)
    )
    tolerance: float | None = eqx.field(default=None, static=True, converter=_tolerance)
    throw: bool = eqx.field(default=True, static=True)
    order: int = eqx.field(default=2, static=True, converter=as_order)

    def __check_init__(self):
        if not isinstance(self.throw, bool):
            raise TypeError(f"Argument `throw` must be True or False, but is {self.throw!r}.")
        if self.dt.ndim > 1:
            raise ValueError(
                f"Argument `dt` must have shape () or (steps,), but its shape is {self.dt.shape}."
            )

    def step(
        self,
        body: AbstractRigidBody,
        R: Float[ArrayLike, "3 3"],
        pi: Float[ArrayLike, "3"],
        torque_k: Float[ArrayLike, "3"] | None = None,
        torque_next: Float[ArrayLike, "3"] | None = None,
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"], SolverInfo]:
        """Advance attitude and momentum by one step, for loops of your own.

        Parameters
        ----------
        body
            The body.
        R
            Attitude (3, 3), body to space.
        pi
            Body angular momentum (3,), kg m²/s.
        torque_k, torque_next
            Body-frame torques (3,) at the start and the end of the step, N m. `None` is
            no torque.

        Returns
        -------
        R_next, pi_next : Array
            The state at the end of the step.
        info : SolverInfo
            Of the solve.

        Raises
        ------
        ValueError
            If `dt` has one value for each step: `step` needs a scalar. If there are torques and
            `order` is more than 2.
        RuntimeError
            If `throw` and the step did not converge; from inside a compiled function too.
        """
        if self.dt.ndim:
            raise ValueError(
                f"`step` needs a scalar `dt`, but its shape is {self.dt.shape}; "
                "use `simulate` for steps of different sizes."
            )
        pi, J = as_floats(pi=(pi, (3,)), J=(_inertia(body), (3, 3)))
        self._refuse_torques(torque_k=torque_k, torque_next=torque_next)
        if self.order > 2:
            J = modified_inertia((J + J.T) / 2, pi, self.dt, self.order)
        torque_k = jnp.zeros_like(pi) if torque_k is None else jnp.asarray(torque_k)
        torque_next = jnp.zeros_like(pi) if torque_next is None else torque_next
        result = rigid_body_step(
            R, pi, J, torque_k, torque_next, self.dt, self.newton_iters, self.tolerance
        )
        if not self.throw:
            return result
        info = result[2]
        impulse = pi + self.dt / 2 * torque_k
        failure = Failure(jnp.zeros((), int), info.residual_norm, self.dt, impulse)
        return raise_unless_converged(result, info.converged, body, failure)

    def simulate(
        self,
        body: AbstractRigidBody,
        R0: Float[ArrayLike, "3 3"],
        pi0: Float[ArrayLike, "3"],
        *,
        steps: int | None = None,
        body_torques: Float[ArrayLike, "states 3"] | None = None,
        save_every: int = 1,
    ) -> Trajectory:
        """Trajectory from an initial state, without torque or under prescribed ones.

        Parameters
        ----------
        body
            The body.
        R0
            Initial attitude (3, 3), body to space.
        pi0
            Initial body angular momentum (3,), kg m²/s.
        steps
            Number of steps, static. Needed where neither `dt` nor `body_torques` has one
            entry for each.
        body_torques
            Body-frame torques (steps+1, 3) at the times of all states, N m.
        save_every
            Store the initial state and then every so many steps the next one, static. It
            must divide the number of steps. Memory, also that of derivatives, is then that of
            what is given and stored, and of up to 2000 steps.

        Returns
        -------
        Trajectory
            Unpacks as `Rs, pis, info`.

        Raises
        ------
        ValueError
            If the number of steps is not given, or given twice differently, or not a multiple
            of `save_every`. If there are torques and `order` is more than 2.
        RuntimeError
            If `throw` and a step did not converge, naming the first one; from inside a
            compiled function too.
        """
        steps = self._number_of_steps(steps, body_torques)
        save_every = as_count("save_every", save_every, 1)
        if steps % save_every:
            raise ValueError(
                f"Argument `save_every` must divide the number of steps, which is {steps}, but is "
                f"{save_every}."
            )
        self._refuse_torques(body_torques=body_torques)
        settings = self.newton_iters, self.tolerance, save_every, self.order
        R, pi, info, failure = simulate(
            R0, pi0, _inertia(body), body_torques, self.dt, steps, *settings
        )
        result = Trajectory(R, pi, info)
        if self.throw and failure is not None:
            return raise_unless_converged(result, info.converged, body, failure)
        return result

    def _refuse_torques(self, **torques: ArrayLike | None) -> None:
        for name, torque in torques.items():
            if torque is not None and self.order > 2:
                raise ValueError(
                    f"Argument `{name}` needs an integrator of order 2, but `order` is "
                    f"{self.order}: more would need the torque between the ends of a step."
                )

    def _number_of_steps(self, steps: int | None, body_torques: ArrayLike | None) -> int:
        given = {}
        if steps is not None:
            given["`steps`"] = as_count("steps", steps, 0)
        if self.dt.ndim:
            given["the length of `dt`"] = self.dt.shape[0]
        if body_torques is not None:
            given["the length of `body_torques` less one"] = steps_of_torques(body_torques)
        if not given:
            raise ValueError(
                "Argument `steps` must be given when `dt` is a scalar and there is no "
                "`body_torques`, but it is None."
            )
        if len(set(given.values())) > 1:
            counts = ", ".join(f"{name} is {count}" for name, count in given.items())
            raise ValueError(f"The number of steps must be given consistently, but {counts}.")
        return next(iter(given.values()))


def _inertia(body: AbstractRigidBody) -> Array:
    if not isinstance(body, AbstractRigidBody):
        raise TypeError(f"Argument `body` must be a body such as `RigidBody`, but is {body!r}.")
    return body.inertia
