"""The discrete Moser-Veselov map as a learnable module."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.dynamics import rigid_body_step
from ..core.step.modified_inertia import as_order, modified_inertia, turns_less_than_a_right_angle
from ..core.step.solution import SolverInfo
from ..core.trajectory.convergence import Failure
from ..core.trajectory.simulation import Method, simulate
from ..core.typed_arrays import as_count, as_floats
from .arguments import (
    as_static_tolerance,
    first_momentum,
    inertia_of,
    refuse_high_order,
    require_composition,
)
from .body import AbstractRigidBody
from .centre_of_mass import centre_of_mass_of, check_path
from .convergence_error import is_possible, raise_unless_converged
from .fields import float_array
from .forces.law import Force
from .mass.mass_properties import MassProperties
from .printing import show
from .schedule import schedule_of_steps, schedule_of_times
from .torques.forcing import Controller, forcing_of
from .torques.law import Torque
from .trajectory import Trajectory
from .varying_body import VaryingRigidBody


def _as_step(value: ArrayLike | None) -> Array | None:
    return None if value is None else float_array("dt")(value)


class MoserVeselovIntegrator(eqx.Module):
    r"""Lie-group variational integrator of the rigid body.

    A step solves $F J_d - J_d F^T = h\,\hat\pi$ and moves $R \to RF$, $\pi \to F^T\pi$,
    between two half impulses of the torque. Rotations stay rotations, and without torque
    energy and spatial momentum are conserved to rounding; with rotors the momentum is.

    Parameters
    ----------
    dt
        Time step, s: a scalar, or one for each step (steps,). A learnable leaf. `None` for an
        integrator whose simulations are all at given `times`.
    newton_iters
        Newton budget of each step, static.
    tolerance
        Bound on the residual norm for a step to count as converged, kg m², static.
        `None` is the scale-aware bound of
        [`solve_F_with_info`][lgvi.solve_F_with_info], reachable in either precision.
    throw
        Raise when a step does not converge (static). If False, the trajectory is returned
        as it is, and `solver_info.converged` tells which steps failed.
    order
        Order of accuracy in `dt`, static: 2, 4, 6 or 8, for a free body without rotors also 10 or
        12. For a free body every order costs the same, and only order 2 is strictly symplectic.
        Otherwise a step of order 4 is composed of five steps of order 2, of order 6 of nine and
        of order 8 of seventeen; see also `force_gradient`.
    force_gradient
        A step of order 4 without rotors, under a controller or a torque law that depends on the
        attitude, is two free motions between three impulses, one of which uses the derivative of
        the torque (static). If False the step is composed of steps of order 2: strictly symplectic
        for a torque that has a potential, but less accurate and slower.

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

    dt: Float[Array, "*steps"] | None = eqx.field(default=None, converter=_as_step)
    newton_iters: int = eqx.field(
        default=8, static=True, converter=lambda value: as_count("newton_iters", value, 1)
    )
    tolerance: float | None = eqx.field(default=None, static=True, converter=as_static_tolerance)
    throw: bool = eqx.field(default=True, static=True)
    order: int = eqx.field(default=2, static=True, converter=as_order)
    force_gradient: bool = eqx.field(default=True, static=True)

    def __check_init__(self):
        for name in ("throw", "force_gradient"):
            if not isinstance(value := getattr(self, name), bool):
                raise TypeError(f"Argument `{name}` must be True or False, but is {value!r}.")
        if self.dt is not None and self.dt.ndim > 1:
            raise ValueError(
                f"Argument `dt` must have shape () or (steps,), but its shape is {self.dt.shape}."
            )

    def __repr__(self) -> str:
        return show(self)

    def step(
        self,
        body: AbstractRigidBody,
        R: Float[ArrayLike, "3 3"],
        pi: Float[ArrayLike, "3"],
        torque_k: Float[ArrayLike, "3"] | None = None,
        torque_next: Float[ArrayLike, "3"] | None = None,
        *,
        torque: Torque | None = None,
        t: Float[ArrayLike, ""] | None = None,
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
        torque
            Torque law, as for `simulate`, instead of the torques; of any order up to 8.
        t
            Time at the start of the step, s, for a law that depends on time; 0 by default.

        Returns
        -------
        R_next, pi_next : Array
            The state at the end of the step.
        info : SolverInfo
            Report of the solve.

        Raises
        ------
        ValueError
            If `dt` is None, or has one value for each step: `step` needs a scalar. If there are
            torques of the start and the end and `order` is more than 2, or a law beside them.
        RuntimeError
            If `throw` and the step did not converge, `R` is not a rotation, or the inertia is not
            symmetric and positive definite; from inside a compiled function too, without values.
        """
        dt = self.dt
        if dt is None or dt.ndim:
            words = (
                "it is None"
                if dt is None
                else f"its shape is {dt.shape}; use `simulate` for steps of different sizes"
            )
            raise ValueError(f"`step` needs a scalar `dt`, but {words}.")
        J, rotor = inertia_of(body), body.rotor_momentum
        refuse_high_order(self.order, torque_k=torque_k, torque_next=torque_next)
        if torque is not None or (rotor is not None and self.order > 2):
            if torque_k is not None or torque_next is not None:
                raise ValueError(
                    "Arguments `torque_k` and `torque_next` must be None where there is a `torque`."
                )
            path = self.simulate(body, R, pi, steps=1, torque=torque, t0=t)
            return path.R[1], path.pi[1], jax.tree.map(lambda x: x[0], path.solver_info)
        pi, J = as_floats(pi=(pi, (3,)), J=(J, (3, 3)))
        usable = jnp.array(True)
        if self.order > 2:
            J = (J + J.T) / 2
            usable = turns_less_than_a_right_angle(J, pi, dt)
            J = modified_inertia(J, pi, dt, self.order)
        torques = {"torque_k": torque_k, "torque_next": torque_next}
        torque_k, torque_next = (
            jnp.zeros_like(pi) if torque is None else as_floats(**{name: (torque, (3,))})[0]
            for name, torque in torques.items()
        )
        R_next, pi_next, info = rigid_body_step(
            R,
            pi,
            J,
            torque_k,
            torque_next,
            dt,
            self.newton_iters,
            self.tolerance,
            rotor_momentum=rotor,
        )
        usable &= is_possible(R, body.inertia)
        info = info._replace(converged=info.converged & usable)
        result = R_next, pi_next, info
        if not self.throw:
            return result

        def first_failure():
            of_body = pi + dt / 2 * torque_k - (0 if rotor is None else rotor)
            finite = jnp.all(jnp.isfinite(pi_next))  # the residual does not show a torque of NaN
            residual_norm = jnp.where(finite, info.residual_norm, jnp.nan)
            return Failure(jnp.zeros((), int), residual_norm, dt, of_body)

        return raise_unless_converged(
            result, info.converged, body, ("R", R), first_failure, "a smaller `dt`"
        )

    def simulate(
        self,
        body: AbstractRigidBody,
        R0: Float[ArrayLike, "3 3"],
        pi0: Float[ArrayLike, "3"] | None = None,
        *,
        omega0: Float[ArrayLike, "3"] | None = None,
        steps: int | None = None,
        times: Float[ArrayLike, " times"] | None = None,
        substeps: int = 1,
        torque: Torque | None = None,
        controller: Controller | None = None,
        t0: Float[ArrayLike, ""] | None = None,
        body_torques: Float[ArrayLike, "states 3"] | None = None,
        save_every: int | None = None,
        force: Force | None = None,
        mass: Float[ArrayLike, ""] | MassProperties | None = None,
        gravity: Float[ArrayLike, "3"] | None = None,
        x0: Float[ArrayLike, "3"] | None = None,
        v0: Float[ArrayLike, "3"] | None = None,
    ) -> Trajectory:
        """Trajectory from an initial state: steps of `dt`, or the states at given `times`.

        Parameters
        ----------
        body
            The body.
        R0
            Initial attitude (3, 3), body to space: a rotation, to 1e-6 (1e-3 in float32).
        pi0
            Initial body angular momentum (3,), kg m²/s: that of rotors too.
        omega0
            Initial angular velocity (3,), body frame, rad/s, instead of `pi0`.
        steps
            Number of steps, static. Needed where neither `dt`, nor `body_torques`, nor the body's
            `rotor_momentum` or `inertia` has one entry for each step.
        times
            Times (states,), s, of the states to compute, increasing or decreasing; the first is
            that of the initial state. There must then be no `steps`, `t0` or `save_every`, and the
            integrator's `dt` is not used.
        substeps
            Number of equal steps from each of `times` to the next, static. From 100,000 steps on
            the memory is that of `save_every`.
        torque
            Torque law: a module such as [`UniformGravity`][lgvi.UniformGravity], a sum of laws,
            or any function of the time, s, the attitude (3, 3) and, if it takes three arguments,
            the body-frame angular velocity (3,), rad/s, that gives the body-frame torque (3,),
            N m. A function is compiled with the numbers that it reads, as by `jax.jit`:
            numbers that change belong in an Equinox module, or among the arguments of a function
            that you compile by `jax.jit`.
        controller
            Feedback: a function of the time, s, the attitude (3, 3) and the body angular
            momentum (3,) at the start of each step, which gives a body-frame torque (3,),
            N m. It is held for the step (zero-order hold) and added to other torques.
        t0
            Initial time, s, 0 by default.
        body_torques
            Body-frame torques (steps+1, 3) at the ends of all steps, N m, instead of a torque law
            and a controller. With `times` that is substeps*(states-1)+1 torques; a
            [`SampledTorque`][lgvi.SampledTorque] interpolates between others.
        save_every
            Store the initial state, and then one state every `save_every` steps, static; 1 by
            default. It must divide the number of steps. The memory, for derivatives too, is then
            that of the arguments, of the stored states and of up to 2000 steps.
        force
            Force law: a module such as [`AirDrag`][lgvi.AirDrag], a sum of laws, or any function of
            the time, s, the attitude (3, 3), the angular velocity (3,), body frame, rad/s, and the
            velocity of the centre of mass (3,), space frame, m/s, that gives the force (3,) at the
            centre of mass, body frame, N. Needs `mass`. To it come the forces of the `torque` laws
            that have one, such as a [`Thruster`][lgvi.Thruster], where there is a `mass`.
        mass
            Mass, kg, above 0, or [`MassProperties`][lgvi.MassProperties], of which it is taken.
        gravity
            Acceleration of gravity (3,), space frame, m/s²; zero by default.
        x0, v0
            Position (3,), m, and velocity (3,), m/s, of the centre of mass at the start, space
            frame; zero by default. With any of `force`, `mass`, `gravity`, `x0` and `v0` the
            trajectory has `x` and `v`. They are of order 2 in the step, whatever `order` is.

        Returns
        -------
        Trajectory
            The stored states and their times. Unpacks as `Rs, pis, info`.

        Raises
        ------
        ValueError, TypeError
            If not one of `pi0` and `omega0` is given. If the number of steps is not given, or given
            inconsistently, or not a multiple of `save_every`. If there is neither a `dt` nor
            `times`, `times` are not in order, or there are `times` and `steps`, `t0` or
            `save_every` too. If torque arguments exclude each
            other or do not fit the order, or torques are not of shape (3,). If there is a `force`
            without a `mass`, or the mass is not above 0.
        RuntimeError
            If `throw` and a step did not converge, naming the first one; if `throw` and `R0` is
            not a rotation, or the inertia is not symmetric and positive definite (if not `throw`,
            no step has converged); if the trajectory leaves
            the times of a sampled torque (if not `throw`, the states are then NaN and the
            steps have not converged). From inside a compiled function too, without values.
        """
        varies = isinstance(body, VaryingRigidBody)
        inertia, rotor = body.inertia if varies else inertia_of(body), body.rotor_momentum
        pi0 = first_momentum(body, pi0, omega0)
        substeps = as_count("substeps", substeps, 1)
        if times is not None:
            not_allowed = {"steps": steps, "t0": t0, "save_every": save_every}
            plan = schedule_of_times(times, substeps, body_torques, rotor, inertia, **not_allowed)
        elif substeps > 1:
            raise ValueError(f"Argument `substeps` must be 1 without `times`, but is {substeps}.")
        else:
            plan = schedule_of_steps(self.dt, steps, t0, save_every, body_torques, rotor, inertia)
        sampled = rotor if rotor is not None and rotor.ndim > 1 else None
        varying = inertia if varies else None
        refuse_high_order(
            self.order, body_torques=body_torques, rotor_momentum=sampled, inertia=varying
        )
        acted_on = torque is not None or controller is not None
        if acted_on or rotor is not None:
            require_composition(self.order)
        forcing, prescribed = None, False
        if acted_on:
            if body_torques is not None:
                raise ValueError(
                    "Argument `body_torques` must be None if there is a `torque` or a "
                    "`controller`: use a `SampledTorque`."
                )
            forcing, prescribed = forcing_of(
                torque, controller, body, self.order, plan.all_times, self.throw
            )
            if varies and not prescribed:
                raise ValueError(
                    "Where the inertia of the body varies, torques must depend on nothing but "
                    "time, in the body frame, but these depend on the motion."
                )
        settings = self.newton_iters, self.order, self.force_gradient, plan.save_every
        centre = centre_of_mass_of(force, torque, mass, gravity, x0, v0, plan.all_times, self.throw)
        R, pi, info, failure, path = simulate(
            R0,
            pi0,
            inertia,
            plan.dt,
            plan.steps,
            Method(*settings, saves_memory=times is None, prescribed=prescribed),
            self.tolerance,
            body_torques=body_torques,
            rotor_momentum=rotor,
            forcing=forcing,
            centre=centre,
            t0=plan.start,
        )
        possible = is_possible(R0, inertia)
        info = info._replace(converged=info.converged & possible)
        if self.throw:
            converged = jnp.all(info.converged) & possible  # of no steps too
            shorter_steps = "a smaller `dt`" if times is None else "more `substeps`"
            R, pi, info = raise_unless_converged(
                (R, pi, info), converged, body, ("R0", R0), lambda: failure, shorter_steps
            )
        t = plan.stored_times(pi)
        if path is None:
            return Trajectory(R, pi, info, t)
        info, path = check_path(info, path, t, self.throw)
        return Trajectory(R, pi, info, t, path.x, path.v)
