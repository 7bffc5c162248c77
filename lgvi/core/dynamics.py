r"""Rigid-body motion: one forced step and whole trajectories.

A step of size $h$ is a half impulse, a free step and a half impulse, with body-frame
torques $\tau$ and $F$ the relative rotation of
[`solve_F_with_info`][lgvi.solve_F_with_info]:

$$\pi_k^+ = \pi_k + \tfrac h2\tau_k,\quad R_{k+1} = R_k F,\quad
  \pi_{k+1}^- = F^T\pi_k^+,\quad \pi_{k+1} = \pi_{k+1}^- + \tfrac h2\tau_{k+1}.$$

It is second order and symmetric. Without torque it conserves the energy and the spatial
momentum $R\pi$ exactly, and is symplectic.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .kernels.finite import multiply, product
from .step.modified_inertia import as_order
from .step.solution import SolverInfo, solve_F_with_info
from .trajectory.simulation import Method, simulate
from .typed_arrays import as_count, as_floats, steps_of_torques


def rigid_body_step(
    R: Float[ArrayLike, "3 3"],
    pi: Float[ArrayLike, "3"],
    J: Float[ArrayLike, "3 3"],
    torque_k: Float[ArrayLike, "3"],
    torque_next: Float[ArrayLike, "3"],
    dt: Float[ArrayLike, ""],
    newton_iters: int = 8,
    tolerance: Float[ArrayLike, ""] | None = 1e-10,
    *,
    rotor_momentum: Float[ArrayLike, "3"] | None = None,
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], SolverInfo]:
    """Advance attitude and momentum by one forced step.

    Parameters
    ----------
    R
        Attitude (3, 3), body to space.
    pi
        Body angular momentum (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m², symmetric positive definite.
    torque_k, torque_next
        Body-frame torques (3,) at the start and the end of the step, N m.
    dt
        Time step, s; negative steps backwards.
    newton_iters
        Newton budget, static under `jax.jit`.
    tolerance
        Bound on the residual norm for `converged`, kg m²; `None` is the scale-aware
        bound of [`solve_F_with_info`][lgvi.solve_F_with_info].
    rotor_momentum
        Momentum (3,) of spinning rotors relative to the body, body frame, kg m²/s, during the
        step; `pi` is the total momentum.

    Returns
    -------
    R_next : Array
        Attitude (3, 3) at the end of the step.
    pi_next : Array
        Body angular momentum (3,) at the end of the step.
    info : SolverInfo
        Report of the solve; check `info.converged`.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type, Newton budget or tolerance. Other
        values never raise.
    """
    rotor = {} if rotor_momentum is None else {"rotor_momentum": (rotor_momentum, (3,))}
    R, pi, J, torque_k, torque_next, dt, *rotor_momenta = as_floats(
        R=(R, (3, 3)),
        pi=(pi, (3,)),
        J=(J, (3, 3)),
        torque_k=(torque_k, (3,)),
        torque_next=(torque_next, (3,)),
        dt=(dt, ()),
        **rotor,
    )
    pi = pi + multiply(dt / 2, torque_k)
    rotor_momentum = rotor_momenta[0] if rotor_momenta else None
    settings = newton_iters, tolerance
    F, info = solve_F_with_info(pi, J, dt, *settings, rotor_momentum=rotor_momentum)
    R, pi = product(R, F), product(F.T, pi) + multiply(dt / 2, torque_next)
    finite = jnp.all(jnp.isfinite(R)) & jnp.all(jnp.isfinite(pi))
    return R, pi, info._replace(converged=info.converged & finite)


def simulate_free_rigid_body(
    R0: Float[ArrayLike, "3 3"],
    pi0: Float[ArrayLike, "3"],
    J: Float[ArrayLike, "3 3"],
    dt: Float[ArrayLike, "*steps"],
    steps: int,
    newton_iters: int = 8,
    tolerance: Float[ArrayLike, ""] | None = 1e-10,
    *,
    order: int = 2,
) -> tuple[Float[Array, "states 3 3"], Float[Array, "states 3"], SolverInfo]:
    r"""Trajectory of a body without torque.

    Parameters
    ----------
    R0
        Initial attitude (3, 3), body to space.
    pi0
        Initial body angular momentum (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m², symmetric positive definite.
    dt
        Time step, s: a scalar, or one for each step (steps,).
    steps
        Number of steps, static under `jax.jit`.
    newton_iters
        Newton budget of each step, static under `jax.jit`.
    tolerance
        Bound on the residual norm for `converged`, kg m²; `None` is the scale-aware
        bound of [`solve_F_with_info`][lgvi.solve_F_with_info].
    order
        Order of accuracy in `dt`: 2, 4, 6, 8, 10 or 12, static under `jax.jit`. All orders
        conserve energy and spatial momentum exactly and cost the same.

    Returns
    -------
    Rs : Array
        Attitudes (steps+1, 3, 3), the initial one included.
    pis : Array
        Body angular momenta (steps+1, 3), the initial one included.
    info : SolverInfo
        One entry for each step (steps,); check `info.converged`.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type, count or tolerance. Other values
        never raise.

    Notes
    -----
    An order above 2 takes the steps of order 2 with another inertia, which follows from the
    energy and the momentum; the residuals belong to the equation with this inertia. The map is
    reversible, and symplectic up to its error only. Its accuracy is poor where `J` is not the
    inertia of a body: where the principal moments violate the triangle inequality. A step that
    turns the body by a right angle or more, $|hJ^{-1}\pi| \ge \pi/2$, does not count as
    converged.

    References
    ----------
    R. I. McLachlan, A. Zanna, "The discrete Moser-Veselov algorithm for the free rigid
    body, revisited", Found. Comput. Math. 5 (2005), doi:10.1007/s10208-004-0118-6.
    E. Hairer, G. Vilmart, "Preprocessed discrete Moser-Veselov algorithm for the full dynamics
    of a rigid body", J. Phys. A 39 (2006), doi:10.1088/0305-4470/39/42/009.
    """
    steps, order = as_count("steps", steps, 0), as_order(order)
    return simulate(R0, pi0, J, dt, steps, Method(newton_iters, order), tolerance)[:3]


def simulate_rigid_body(
    R0: Float[ArrayLike, "3 3"],
    pi0: Float[ArrayLike, "3"],
    J: Float[ArrayLike, "3 3"],
    body_torques: Float[ArrayLike, "states 3"],
    dt: Float[ArrayLike, "*steps"],
    newton_iters: int = 8,
    tolerance: Float[ArrayLike, ""] | None = 1e-10,
) -> tuple[Float[Array, "states 3 3"], Float[Array, "states 3"], SolverInfo]:
    """Trajectory of a body under prescribed body-frame torques.

    Parameters
    ----------
    R0
        Initial attitude (3, 3), body to space.
    pi0
        Initial body angular momentum (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m², symmetric positive definite.
    body_torques
        Torques (steps+1, 3) in the body frame at the times of the states, N m; their
        number sets the number of steps.
    dt
        Time step, s: a scalar, or one for each step (steps,).
    newton_iters
        Newton budget of each step, static under `jax.jit`.
    tolerance
        Bound on the residual norm for `converged`, kg m²; `None` is the scale-aware
        bound of [`solve_F_with_info`][lgvi.solve_F_with_info].

    Returns
    -------
    Rs : Array
        Attitudes (steps+1, 3, 3), the initial one included.
    pis : Array
        Body angular momenta (steps+1, 3), the initial one included.
    info : SolverInfo
        One entry for each step (steps,); check `info.converged`.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type or tolerance. Other values never
        raise.
    """
    steps = steps_of_torques(body_torques)
    method = Method(newton_iters)
    return simulate(R0, pi0, J, dt, steps, method, tolerance, body_torques=body_torques)[:3]
