"""Draws of the posterior by NUTS, about the minimum of a fit.

The No-U-Turn Sampler: M. D. Hoffman & A. Gelman, J. Mach. Learn. Res. 15 (2014). The unknowns are
those of the fit: the free leaves, along the directions that are observable, and the initial state
of each trajectory. They are put in coordinates in which the problem that is linearised about the
minimum is a standard normal distribution, so that the sampler needs no mass matrix.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from importlib.util import find_spec
from numbers import Integral
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ...core.inertia import log_cholesky_from_inertia
from ...modules.body import PhysicalRigidBody
from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import ModelOfLeaves
from ..model.free_leaves import Free, FreeBody, bodies_in, inertias_and_derivatives
from ..model.prior import Prior
from ..model.states import InitialStates
from ..running.compilation import compiled
from ..running.progress import show_progress
from ..segments.levels import whole_level
from ..segments.programs import SIX, six
from ..segments.whole import Trajectories, simulate_costs
from ..solver.elimination import BlockArrow, eliminate
from ..uncertainty.information import NO_NOISE, Information, compute_information
from .problem import AbstractAtMinimum

CHAINS = 4
FEWEST_DRAWS = 100  # of each chain
BLOCK = 50  # transitions that one call of the program makes
WARM_UP = 5  # blocks in which the step is found, and which are left out
ACCEPTANCE = 0.9  # of proposals, for which the step is found: valleys are narrow and bent
FIRST_STEP = 0.5
DOUBLINGS = 8  # of a path, at most: a longer one follows something that is not known
MOST_HALVINGS = 10  # of the distance of a start from the minimum
LARGE_TURN = 1.0  # rad, of an initial attitude, for which a linear model is good
SMALL = 0.02  # second moment, of the largest, at least where the problem is linearised
NOT_SEEN = 1e-4  # part of a direction that is observable, up to which the direction is not


def require_draws(draws: int) -> None:
    """Check the number of draws, and that the sampler is installed.

    Raises
    ------
    ImportError
        If the package of the sampler is not installed.
    ValueError
        If it is no whole number, or too small to be judged.
    """
    if find_spec("blackjax") is None:
        raise ImportError(
            'Draws of the posterior need the package `blackjax`: `pip install "lgvi[sampling]"`.'
        )
    if not isinstance(draws, Integral) or draws < FEWEST_DRAWS:
        raise ValueError(
            f"Argument `draws` must be a whole number of at least {FEWEST_DRAWS}, of each chain, "
            f"but is {draws!r}."
        )


class Drawn(NamedTuple):
    """What the sampler returns."""

    theta: np.ndarray  # (chains, draws, p), free leaves
    information: Information  # with no leaf at a bound
    divergences: int  # transitions that were cut short, as their energy was wrong


class Straight(NamedTuple):
    """Coordinates in which the entries of the inertia of a body are linear, about.

    A motion depends on the entries smoothly, also where a second moment vanishes; their logarithms
    do not. The second moments about `axes` are factored as $M D M^T$ with a unit triangle $M$. The
    last entry of $D$, which is the smallest, vanishes first: it has a coordinate of its own, behind
    a softplus function, and what is correlated with the entry follows the entry.
    """

    leaves: tuple[int, ...]  # the log-Cholesky coordinates of the body among the free leaves
    axes: np.ndarray  # (3, 3), principal axes, that of the largest second moment first
    second_moments: np.ndarray  # (3, 3), at the minimum, about the axes
    of_z: np.ndarray  # (3, 3, k), their derivative
    widths: np.ndarray  # (3,), standard errors of the second moments about the axes
    direction: np.ndarray  # (k,), unit length, of the smallest, across those of bodies before

    def bend(self, z: Array) -> Array:
        """The coordinates (k,) with the smallest second moment made positive."""
        of_smallest = jnp.asarray(self.of_z)[2, 2]
        value, direction = self.second_moments[2, 2] + of_smallest @ z, jnp.asarray(self.direction)
        change = self._positive(2, value) - value
        return z + direction * (change / (of_smallest @ direction))

    def at(self, z: Array) -> Array:
        """The log-Cholesky coordinates (6,) at coordinates (k,) that are bent."""
        S = jnp.asarray(self.second_moments) + jnp.asarray(self.of_z) @ z
        d0, d2 = self._positive(0, S[0, 0]), S[2, 2]
        m10, m20 = S[1, 0] / d0, S[2, 0] / d0
        d1 = self._positive(1, S[1, 1] - m10**2 * d0)
        m21 = (S[2, 1] - m20 * m10 * d0) / d1
        one, zero = jnp.ones_like(d0), jnp.zeros_like(d0)
        M = jnp.stack([one, zero, zero, m10, one, zero, m20, m21, one]).reshape(3, 3)
        factor = (jnp.asarray(self.axes) @ M) * jnp.sqrt(jnp.stack([d0, d1, d2]))[None, :]
        S = factor @ factor.T
        second = S[1, 1] - S[1, 0] ** 2 / S[0, 0]
        squares = jnp.stack([S[0, 0], second, d0 * d1 * d2 / (S[0, 0] * second)])
        below = [S[1, 0] / S[0, 0], S[2, 0] / S[0, 0]]
        below.append((S[2, 1] - below[0] * S[2, 0]) / second)
        return jnp.concatenate([jnp.log(squares) / 2, jnp.stack(below)])

    def _positive(self, i: int, value: Array) -> Array:
        width = jnp.asarray(self.widths)[i]
        return width * jax.nn.softplus(value / width)


class Coordinates(NamedTuple):
    """From standard normal numbers, about, to the unknowns: k of free leaves, m of each state."""

    theta: np.ndarray  # (p,), at the minimum
    lower: np.ndarray  # (p,)
    upper: np.ndarray  # (p,)
    of_theta: np.ndarray  # (p, k)
    straight: tuple[Straight, ...]  # of physical bodies
    states: InitialStates  # at the minimum
    by_theta: np.ndarray  # (trajectories, m, p), the change of the most likely states
    of_states: np.ndarray  # (trajectories, m, m)
    idle: np.ndarray  # (trajectories, m), 1 for a coordinate that moves nothing
    to_linear: np.ndarray  # (k, numbers), k coordinates in which the prior is flat

    @property
    def known(self) -> int:
        """Number of coordinates of the free leaves."""
        return self.of_theta.shape[1]

    @property
    def unknowns(self) -> int:
        """Number of all coordinates."""
        return self.known + self.idle.size

    def leaves_at(self, z: Array) -> Array:
        """The free leaves (p,) at coordinates (k,)."""
        z = self._bent(z)
        theta = jnp.asarray(self.theta) + self._changes(z)
        for body in self.straight:
            theta = theta.at[np.array(body.leaves)].set(body.at(z))
        return theta

    def _bent(self, z: Array) -> Array:
        for body in self.straight:
            z = body.bend(z)
        return z

    def _changes(self, z: Array) -> Array:
        """The changes (p,) of the free leaves, of those of straight bodies to first order.

        Leaves are mirrored at their bounds: the density of what is mirrored is that of the leaves,
        on both sides of a bound.
        """
        start = jnp.asarray(self.theta)
        theta = start + jnp.asarray(self.of_theta) @ z
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        lower, upper = jnp.where(has_lower, self.lower, 0), jnp.where(has_upper, self.upper, 0)
        width = jnp.where(has_lower & has_upper, upper - lower, 1)
        between = lower + abs(jnp.mod(theta - lower + width, 2 * width) - width)
        theta = jnp.where(has_lower & ~has_upper, lower + abs(theta - lower), theta)
        theta = jnp.where(has_upper & ~has_lower, upper - abs(upper - theta), theta)
        return jnp.where(has_lower & has_upper, between, theta) - start

    def shifts_at(self, z: Array, of_states: Array) -> Array:
        """The changes of the initial states (trajectories, m) at their coordinates."""
        by_theta = jnp.asarray(self.by_theta) @ self._changes(self._bent(z))
        return by_theta + jnp.einsum("nij,nj->ni", jnp.asarray(self.of_states), of_states)


class Numbers(NamedTuple):
    """The numbers in which the prior is flat: entries of inertias, and other leaves.

    Numbers whose size the recordings do not tell are divided by the trace of the inertia.
    """

    positions: tuple[int, ...]  # of the free bodies among all bodies
    traces: tuple[tuple[int, ...], ...]  # for each free body those by whose traces it is divided
    others: tuple[int, ...]  # free leaves that are not of a body
    divided: tuple[bool, ...]  # whether each is divided by the trace of the first body

    def at(self, parameters: Any, free: Free, theta: Array) -> Array:
        """The numbers at values (p,) of the free leaves."""
        bodies = bodies_in(free.put(parameters, theta))
        J = [bodies[position].inertia.astype(theta.dtype) for position in self.positions]
        trace = [jnp.trace(inertia) for inertia in J]
        entries = [
            six(inertia) / (sum(trace[k] for k in divisor) if divisor else 1)
            for inertia, divisor in zip(J, self.traces, strict=True)
        ]
        others = [
            theta[i : i + 1] / (trace[0] if divided else 1)
            for i, divided in zip(self.others, self.divided, strict=True)
        ]
        return jnp.concatenate([*entries, *others])

    def jacobian(self, parameters: Any, free: Free) -> np.ndarray:
        """Their derivative by the free leaves (numbers, p), at the minimum."""
        J, derivatives = inertias_and_derivatives(parameters, free)
        traces, slopes = np.trace(J, axis1=1, axis2=2), np.trace(derivatives, axis1=1, axis2=2)

        def over(value: Any, row: np.ndarray, divisor: tuple[int, ...]) -> np.ndarray:
            if not divisor:
                return row
            trace, slope = sum(traces[[*divisor]]), sum(slopes[[*divisor]])
            return (row - np.multiply.outer(value / trace, slope)) / trace

        entries = [over(J[k][SIX], derivatives[k][SIX], d) for k, d in enumerate(self.traces)]
        others = [
            over(free.theta[i], np.eye(len(free.theta))[i], (0,) if divided else ())[None]
            for i, divided in zip(self.others, self.divided, strict=True)
        ]
        return np.concatenate([*entries, *others])


class Part(NamedTuple):
    """A configuration in the program."""

    of_leaves: ModelOfLeaves
    trajectories: Trajectories
    method: MoserVeselovIntegrator


class Target(NamedTuple):
    """What the density depends on."""

    parameters: Any
    free: Free
    parts: tuple[Part, ...]
    coordinates: Coordinates
    numbers: Numbers
    prior: tuple[Prior, ...]
    residuals: np.ndarray  # number of all residuals
    noise_is_given: np.ndarray  # whether it is


class Sampler(AbstractAtMinimum):
    """Draws the free leaves and the initial states."""

    @show_progress("sampling")
    def draw(self, draws: int, key: Array, scaled: Sequence[str]) -> Drawn:
        """So many draws of each chain; `scaled` are leaves known as parts of the trace alone.

        Raises
        ------
        ValueError
            If several processes fit together, a loss is robust, no more was read than is fitted, or
            no direction of the free leaves is observable.
        RuntimeError
            If whole trajectories cannot be simulated.
        """
        # The package is optional, and takes some seconds to be imported.
        from blackjax.adaptation.step_size import dual_averaging_adaptation

        target, known = self._target(scaled)
        first = dual_averaging_adaptation(ACCEPTANCE)[0](FIRST_STEP)
        adaptation = jax.tree.map(lambda x: np.asarray(x, jnp.result_type(x)), first)
        states, usable = _start(target, key)
        if not np.all(usable):
            raise RuntimeError(
                "The posterior is not finite near the estimate, where sampling starts: fit with "
                "shorter steps, an `integrator` of smaller `dt`."
            )
        theta, divergences = [], 0
        with show_progress() as progress:
            for block in range(WARM_UP - (-draws // BLOCK)):
                warms_up = block < WARM_UP
                at = key, np.array(block), np.array(warms_up)
                states, adaptation, of_block, diverged = _draw_block(
                    target, states, adaptation, *at, optimised=True
                )
                progress.iterations += BLOCK
                if not warms_up:
                    theta.append(np.asarray(of_block, float))
                    divergences += int(diverged)
        return Drawn(np.concatenate(theta, axis=1)[:, :draws], known, divergences)

    def _target(self, scaled: Sequence[str]) -> tuple[Target, Information]:
        problem = self.problem
        self._require_likelihood()
        free, level = problem.free, whole_level(problem.configurations, self.longest_steps)
        inside = _inside(problem.parameters, free)
        linearised = problem.linearise(level, inside.theta, self.states)
        if not np.isfinite(linearised.cost):
            raise RuntimeError(
                "Sampling simulates whole trajectories, which fails at the estimate: take "
                "recordings that are shorter."
            )
        known = compute_information(linearised.system, np.zeros(len(free.theta), bool))
        if not known.observable.any():
            raise ValueError("There are no draws where no direction of what is free is observable.")
        numbers = _find_numbers(free, known, scaled)
        parts = [
            Part(configuration.of_leaves, Trajectories.of(chains), method)
            for configuration, chains, method in zip(
                problem.configurations, level.chains, problem.methods, strict=True
            )
        ]
        target = Target(
            problem.parameters,
            free,
            tuple(parts),
            self._coordinates(linearised.system, known, numbers, inside),
            numbers,
            tuple(problem.prior),
            np.array(float(linearised.number)),
            np.array(problem.noise_is_given),
        )
        return target, known

    def _require_likelihood(self) -> None:
        problem = self.problem
        if problem.processes.are_several:
            raise ValueError("Where several processes fit together there are no draws.")
        if any(configuration.model.is_robust for configuration in problem.configurations):
            raise ValueError(
                "There are no draws with a robust loss, which is the likelihood of no noise: fit "
                "sensors without a `loss`."
            )
        if not np.isfinite(self.variance):
            raise ValueError(
                "There are no draws where no more was read than is fitted, as that does not tell "
                'the size of the noise: fit with `noise="given"`, or more readings.'
            )

    def _coordinates(
        self, system: BlockArrow, known: Information, numbers: Numbers, inside: Free
    ) -> Coordinates:
        problem, free, m = self.problem, self.problem.free, system.unknowns
        deviation = np.sqrt(max(self.variance, NO_NOISE))
        of_theta = deviation * known.whiten(np.eye(len(free.theta)))
        own, lengths = eliminate(system, 0).own, system.own_lengths()
        left, sizes, right = np.linalg.svd(own[:, :, :m] / lengths[:, None])
        seen = sizes > system.rank_tolerance
        inverse = np.swapaxes(right, 1, 2) * (seen / np.where(seen, sizes, 1))[:, None]
        inverse = inverse / lengths[:, :, None]
        of_theta = _narrowed(of_theta, free.max_step)
        to_linear = np.zeros((of_theta.shape[1], 0))
        if numbers.positions:
            of_numbers = numbers.jacobian(problem.parameters, inside) @ of_theta
            to_linear = np.linalg.pinv(of_numbers)
        turns = np.where(np.arange(m) < 3, LARGE_TURN, np.inf)
        return Coordinates(
            free.theta,
            free.lower,
            free.upper,
            of_theta,
            tuple(_straighten(problem.parameters, free, inside, numbers, of_theta)),
            jax.tree.map(np.asarray, self.states),
            -inverse @ np.swapaxes(left, 1, 2) @ own[:, :, 2 * m : -1],
            _narrowed(deviation * inverse, turns),
            1.0 - seen,
            to_linear,
        )


def _inside(parameters: Any, free: Free) -> Free:
    """The free leaves where no second moment of a body is much smaller than the largest.

    There the logarithms of second moments are as good coordinates as the second moments.
    """
    theta = free.theta.copy()
    J, _ = inertias_and_derivatives(parameters, free)
    for inertia, body in zip(J, free.bodies, strict=True):
        if _is_straight(parameters, free, body):
            sizes, axes = np.linalg.eigh(np.trace(inertia) / 2 * np.eye(3) - inertia)
            if sizes[0] < SMALL * sizes[2]:
                S = axes * np.maximum(sizes, SMALL * sizes[2]) @ axes.T
                J_inside = np.trace(S) * np.eye(3) - S
                theta[body.at] = np.asarray(log_cholesky_from_inertia(J_inside))
    return free._replace(theta=theta)


def _is_straight(parameters: Any, free: Free, body: FreeBody) -> bool:
    """Whether the coordinates of a body are logarithms, without bounds."""
    bounded = np.isfinite(free.lower) | np.isfinite(free.upper)
    is_physical = isinstance(bodies_in(parameters)[body.position], PhysicalRigidBody)
    return is_physical and not bounded[body.at].any()


def _straighten(
    parameters: Any, free: Free, inside: Free, numbers: Numbers, of_theta: np.ndarray
) -> Iterator[Straight]:
    """The coordinates of physical bodies."""
    eye, before = np.eye(3), np.zeros((0, of_theta.shape[1]))
    J, _ = inertias_and_derivatives(parameters, free)
    J_inside, derivatives = inertias_and_derivatives(parameters, inside)
    J_of_z = derivatives @ of_theta
    traces, slopes = np.trace(J_inside, axis1=1, axis2=2), np.trace(J_of_z, axis1=1, axis2=2)
    for k, (body, divisor) in enumerate(zip(free.bodies, numbers.traces, strict=True)):
        if not _is_straight(parameters, free, body):
            continue
        of_z = J_of_z[k]
        if divisor:  # no change of the size, which is not known
            some = [*divisor]
            of_z = of_z - np.multiply.outer(J_inside[k], slopes[some].sum(0) / traces[some].sum())
        of_z = np.trace(of_z) / 2 * eye[..., None] - of_z
        sizes, axes = np.linalg.eigh(np.trace(J_inside[k]) / 2 * eye - J_inside[k])
        sizes, axes = sizes[::-1], axes[:, ::-1]
        of_z = np.einsum("ia,ijk,jb->abk", axes, of_z, axes)
        second_moments = axes.T @ (np.trace(J[k]) / 2 * eye - J[k]) @ axes
        errors = np.linalg.norm(of_z[range(3), range(3)], axis=1)
        widths = np.clip(errors, 1e-9 * sizes[0], sizes[0] / 4)
        direction = of_z[2, 2] - before.T @ (before @ of_z[2, 2])
        length = np.linalg.norm(direction)
        if length > NOT_SEEN * errors[2]:  # else the size of the body is that of another one
            before = np.concatenate([before, direction[None] / length])
            leaves = tuple(np.flatnonzero(body.at).tolist())
            yield Straight(leaves, axes, second_moments, of_z, widths, before[-1])


def _narrowed(root: np.ndarray, most: np.ndarray) -> np.ndarray:
    """A root (..., p, k) of a covariance, no wider in each number than a linear model is good."""
    wide = root / most[:, None]
    precision = np.eye(root.shape[-1]) + np.swapaxes(wide, -1, -2) @ wide
    # The root of the inverse that is nearest to the identity, so that little changes.
    squares, axes = np.linalg.eigh(precision)
    return root @ (axes / np.sqrt(squares)[..., None, :]) @ np.swapaxes(axes, -1, -2)


def _find_numbers(free: Free, known: Information, scaled: Sequence[str]) -> Numbers:
    """The numbers in which the prior is flat."""
    of_scaled = np.isin(free.leaves, scaled)

    def is_unknown(direction: np.ndarray) -> bool:
        seen = np.linalg.norm(known.along_observable(direction))
        return bool(direction.any() and seen <= NOT_SEEN * np.linalg.norm(known.scale * direction))

    together = is_unknown(free.scale_direction + np.where(of_scaled, free.theta, 0))
    every = tuple(range(len(free.bodies))) if together else ()
    others = np.flatnonzero(~free.of_body)
    return Numbers(
        tuple(body.position for body in free.bodies),
        tuple(
            (k,) if is_unknown(np.where(body.at, free.scale_direction, 0)) else every
            for k, body in enumerate(free.bodies)
        ),
        tuple(others.tolist()),
        tuple((of_scaled & together)[others].tolist()),
    )


@compiled("draws of the posterior")
def _draw_block(
    target: Target,
    states: Any,
    adaptation: Any,
    key: Array,
    block: Array | np.ndarray,
    warms_up: Array | np.ndarray,
) -> tuple[Any, Any, Array, Array]:
    """The states of the chains after some transitions, and the adaptation of the step.

    Then the free leaves (chains, draws, p), and the number of transitions that diverged.
    """
    from blackjax import nuts
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    _, adapt, settled = dual_averaging_adaptation(ACCEPTANCE)
    density, kernel = partial(_log_density, target), nuts.build_kernel()
    coordinates, dtype = target.coordinates, states.position.dtype
    masses = jnp.ones(states.position.shape[1], dtype)

    def transition(carry: Any, key: Array) -> tuple[Any, Any]:
        states, adaptation = carry
        step = jnp.exp(adaptation.log_step_size)
        step = jnp.where(warms_up, step, settled(adaptation)).astype(dtype)
        states, info = jax.vmap(
            lambda key, state: kernel(key, state, density, step, masses, DOUBLINGS)
        )(jax.random.split(key, CHAINS), states)
        with jax.numpy_dtype_promotion("standard"):  # which the package takes for granted
            adapted = adapt(adaptation, jnp.mean(info.acceptance_rate))
        adaptation = jax.tree.map(
            lambda new, old: jnp.where(warms_up, new, old).astype(old.dtype), adapted, adaptation
        )
        leaves = jax.vmap(lambda z: coordinates.leaves_at(z[: coordinates.known]))(states.position)
        return (states, adaptation), (leaves, jnp.sum(info.is_divergent))

    keys = jax.random.split(jax.random.fold_in(key, 1 + block), BLOCK)
    carry, (leaves, diverged) = jax.lax.scan(transition, (states, adaptation), keys)
    states, adaptation = carry
    return states, adaptation, leaves.swapaxes(0, 1), jnp.sum(diverged)


@compiled("a start of the draws")
def _start(target: Target, key: Array) -> tuple[Any, Array]:
    """States of the chains at normal coordinates (chains, unknowns), and whether each is usable.

    Where the density is not finite, they are moved towards the minimum.
    """
    from blackjax import nuts

    density = partial(_log_density, target)
    shape, dtype = (CHAINS, target.coordinates.unknowns), jnp.asarray(target.free.theta).dtype
    z = jax.random.normal(jax.random.fold_in(key, 0), shape, dtype)

    def at(z: Array) -> Any:
        states = jax.vmap(lambda z: nuts.init(z, density))(z)
        slopes = jnp.all(jnp.isfinite(states.logdensity_grad), axis=1)
        return states, jnp.isfinite(states.logdensity) & slopes

    def nearer(carry: Any) -> Any:
        number, (states, usable) = carry
        z = states.position
        return number + 1, at(jnp.where(usable[:, None] | (number == 0), z, z / 2))

    # The loop evaluates the density at the first point too, so that it is compiled once.
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(at, z))
    nothing = nothing[0]._replace(position=z), nothing[1]
    _, started = jax.lax.while_loop(
        lambda carry: (carry[0] <= MOST_HALVINGS) & ~jnp.all(carry[1][1]), nearer, (0, nothing)
    )
    return started


def _log_density(target: Target, z: Array) -> Array:
    """The logarithm of the density of the coordinates (unknowns,), without constants."""
    parameters, free, parts, coordinates, numbers, prior, residuals, given = target
    of_leaves, of_states = z[: coordinates.known], z[coordinates.known :]
    of_states = of_states.reshape(coordinates.idle.shape)
    theta = coordinates.leaves_at(of_leaves)
    shifts = coordinates.shifts_at(of_leaves, of_states)
    states, first, cost = coordinates.states.moved(shifts), 0, jnp.zeros((), z.dtype)
    for part in parts:
        model = part.of_leaves.at(parameters, free, theta)
        last = first + part.trajectories.segments.start.shape[1]
        arguments = states.at(slice(first, last)), part.trajectories, part.method
        cost, first = cost + jnp.sum(simulate_costs(model, part.of_leaves.own, *arguments)), last
    # Under Jeffreys' prior 1 / sigma of the size of the noise, which is integrated out.
    fitted = -jnp.where(given, cost, jnp.asarray(residuals) * jnp.log(cost)) / 2
    of_prior = jnp.zeros((), z.dtype)
    for each in prior:
        values, _ = ravel_pytree(each.function(free.put(parameters, theta)))
        misfits = (values - jnp.asarray(each.mean)) / jnp.asarray(each.deviation)
        of_prior = of_prior - jnp.sum(misfits**2) / 2
    volume = jnp.zeros((), z.dtype)
    if numbers.positions:

        def linear(z: Array) -> Array:
            at = numbers.at(parameters, free, coordinates.leaves_at(z))
            return jnp.asarray(coordinates.to_linear) @ at

        volume = jnp.linalg.slogdet(jax.jacfwd(linear)(of_leaves))[1]
    # Initial attitudes are uniform: the volume of a rotation vector of length a is sinc²(a/2).
    squares = jnp.sum(shifts[:, :3] ** 2, axis=1)
    half = jnp.sqrt(jnp.maximum(squares, 1e-12)) / 2
    uniform = 2 * jnp.sum(jnp.log(abs(jnp.sin(half) / half)))
    nothing = -jnp.sum(jnp.asarray(coordinates.idle) * of_states**2) / 2
    return fitted + of_prior + volume + uniform + nothing
