"""Simulations: which way a trajectory is computed."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..kernels.finite import product
from ..kernels.vectors import Mat3
from ..step.solution import SolverInfo
from ..typed_arrays import as_count, as_floats, as_tolerance, require_room
from .chunks import Steps, choose_chunks, simulate_in_chunks
from .convergence import Failure, assess_drifts, first_failure, worst_info
from .forced import simulate_forced
from .inertias import rates_of
from .kicks import Forcing
from .prescribed import simulate_composed, simulate_free, simulate_prescribed
from .splitting import Inputs, splitting_of
from .translation import CentreOfMass, CentrePath, translate


class Method(NamedTuple):
    """Static options of a simulation."""

    newton_iters: int
    order: int = 2
    force_gradient: bool = True  # of order 4, rather than a composition
    save_every: int = 1
    saves_memory: bool = True  # by storing fewer states, rather than time
    prescribed: bool = False  # under a torque law that depends on nothing but time


def simulate(
    R0: ArrayLike,
    pi0: ArrayLike,
    J: ArrayLike,
    dt: ArrayLike,
    steps: int,
    method: Method,
    tolerance: ArrayLike | None,
    *,
    body_torques: ArrayLike | None = None,
    rotor_momentum: ArrayLike | None = None,
    forcing: Forcing | None = None,
    centre: CentreOfMass | None = None,
    t0: ArrayLike = 0.0,
) -> tuple[Array, Array, SolverInfo, Failure | None, CentrePath | None]:
    """Attitudes and momenta of the initial state and of the last one of every `save_every` steps.

    `J` is (3, 3), or for order two without `forcing` that depends on the motion (steps, 3, 3).
    `dt` is a scalar or (steps,); `body_torques` (steps+1, 3) are at the times of all states,
    `forcing` is instead of them; `rotor_momentum` is (3,) or (steps, 3); `save_every` divides
    `steps`. The solver info has an entry for each stored state but the first; the failure is the
    first of all, None without steps. Positions and velocities are those of the `centre`.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type or Newton budget.
    """
    as_count("newton_iters", method.newton_iters, 1)
    arguments: dict[str, Any] = {
        "R0": (R0, (3, 3)),
        "pi0": (pi0, (3,)),
        "J": (J, [(3, 3), (steps, 3, 3)]),
        "dt": (dt, [(), (steps,)]),
        "t0": (t0, ()),
    }
    if body_torques is not None:
        arguments["body_torques"] = body_torques, (steps + 1, 3)
    if rotor_momentum is not None:
        arguments["rotor_momentum"] = rotor_momentum, [(3,), (steps, 3)]
    if forcing is not None:
        known = dict(zip(arguments, as_floats(**arguments), strict=True))
        arguments |= forcing.examples(known["t0"], known["R0"], known["pi0"])
    if centre is not None:
        known = dict(zip(arguments, as_floats(**arguments), strict=True))
        arguments |= centre.examples(known["t0"], known["R0"], known["pi0"])
    arrays = dict(zip(arguments, as_floats(**arguments), strict=True))
    if centre is not None:
        x, v, gravity = (arrays[name] for name in ("x0", "v0", "gravity"))
        centre = centre._replace(start=CentrePath(x, v), gravity=gravity)
    tolerance = as_tolerance(tolerance)
    require_room(steps, method.save_every, arrays["pi0"].dtype)
    if steps == 0:
        none = arrays["pi0"][:0]
        path = None if centre is None else jax.tree.map(lambda x: x[None], centre.start)
        return arrays["R0"][None], arrays["pi0"][None], SolverInfo(none, none == none), None, path
    by_step, rotor = {}, arrays.get("rotor_momentum")
    if body_torques is not None:
        by_step["torques"] = arrays["body_torques"][:-1], arrays["body_torques"][1:]
    if rotor is not None and rotor.ndim > 1:
        by_step["rotor"], rotor = rotor, None
    state = [arrays[name] for name in ("R0", "pi0", "J", "dt", "t0")]
    static = steps, method, choose_chunks(steps, method.save_every, method.saves_memory)
    return _simulate(*state, rotor, by_step, forcing, centre, tolerance, *static)


# Compiled here, so that calls outside of `jax.jit` compile once for each number of steps.
@partial(jax.jit, static_argnames=("steps", "method", "chunks"))
def _simulate(
    R0, pi0, J, dt, t0, rotor, by_step, forcing, centre, tolerance, steps, method, chunks
):
    J, newton_iters = (J + jnp.swapaxes(J, -1, -2)) / 2, method.newton_iters
    if J.ndim > 2:
        by_step = by_step | {"inertia": J}
    if dt.ndim:
        by_step = by_step | {"t": t0 + jnp.cumsum(dt) - dt}

    # The sum of squares is finite if all entries are; with a barrier, or XLA would compute it for
    # every step.
    x, y, z = (row.dot(row) for row in Mat3.of(R0))
    starts = jax.lax.optimization_barrier(jnp.isfinite(x + y + z))

    def inputs_of(part: Steps) -> Inputs:
        h = jnp.broadcast_to(part.dt, part.number.shape)
        if part.real is not None:
            h = jnp.where(part.real, h, 0)
        t = part.arrays["t"] if dt.ndim else t0 + part.number.clip(max=steps).astype(dt.dtype) * dt
        return Inputs(t, h, part.arrays.get("rotor", rotor))

    def solve(Q0, pi0, part: Steps):
        inputs, state = inputs_of(part), (Q0, pi0, part.arrays.get("inertia", J))
        if forcing is not None and not method.prescribed:
            start = R0 if chunks is None else product(R0, Q0)
            gradient = method.force_gradient and inputs.rotor is None
            splitting = splitting_of(method.order, gradient)
            motion = simulate_forced(*state, start, inputs, forcing, splitting, newton_iters)
        elif forcing is not None or (method.order > 2 and inputs.rotor is not None):
            law = None if forcing is None else lambda t: forcing.law(t, R0)
            motion = simulate_composed(*state, inputs, law, method.order, newton_iters)
        elif method.order > 2:
            motion = simulate_free(*state, inputs.h, part.dt, method.order, newton_iters)
        else:
            torques = part.arrays.get("torques")
            motion = simulate_prescribed(*state, inputs.h, torques, inputs.rotor, newton_iters)
        Rs, pis, drifts = motion
        # A state may be NaN though its drift is not: by an impulse after it, or by R0.
        finite = jnp.all(jnp.isfinite(pis[1:]), axis=1) & starts
        return Rs, pis, *assess_drifts(drifts, part.number, tolerance, finite)

    def follow(path: CentrePath | None, Rs: Array, pis: Array, part: Steps) -> CentrePath | None:
        """The path of the centre in the steps, whose states are known."""
        if centre is None or path is None:
            return None
        inputs, inertia = inputs_of(part), part.arrays.get("inertia", J)
        momenta = inputs.rotor
        if momenta is not None and momenta.ndim == 1:
            momenta = momenta[None]
        begins, ends = (
            (t, R, rates_of(inertia, pi if momenta is None else pi - momenta))
            for t, R, pi in (
                (inputs.t, Rs[:-1], pis[:-1]),
                (inputs.t + inputs.h, Rs[1:], pis[1:]),
            )
        )
        return translate(centre.acceleration, path, inputs.h, begins, ends)

    start = None if centre is None else centre.start
    if chunks is not None:
        return simulate_in_chunks(solve, follow, R0, pi0, start, dt, by_step, chunks)
    all_steps = Steps(jnp.arange(steps), None, dt, by_step)
    every = method.save_every
    Rs, pis, info, failures = solve(R0, pi0, all_steps)
    path = jax.tree.map(lambda x: x[::every], follow(start, Rs, pis, all_steps))
    failure = first_failure(info.converged, failures)
    info = worst_info(jax.tree.map(lambda x: x.reshape(steps // every, -1), info), axis=1)
    return Rs[::every], pis[::every], info, failure, path
