"""Draws of the posterior by NUTS, about the minimum of a fit.

The No-U-Turn Sampler: M. D. Hoffman & A. Gelman, J. Mach. Learn. Res. 15 (2014). The unknowns are
those of the fit: the free leaves, along the directions that are observable, and the initial state
of each trajectory. They are put in coordinates in which the problem that is linearised about the
minimum is a standard normal distribution, so that the sampler needs no mass matrix.
"""

from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from numbers import Integral
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import ModelOfLeaves
from ..model.free_leaves import Free, bodies_in, inertias_and_derivatives
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
ACCEPTANCE = 0.8  # of proposals, for which the step is found
FIRST_STEP = 0.5
DOUBLINGS = 8  # of a path, at most: a longer one follows something that is not known
MOST_HALVINGS = 10  # of the distance of a start from the minimum
LARGE_TURN = 1.0  # rad, of an initial attitude, for which a linear model is good
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


class Coordinates(NamedTuple):
    """From standard normal numbers, about, to the unknowns: k of free leaves, m of each state."""

    theta: np.ndarray  # (p,), at the minimum
    lower: np.ndarray  # (p,)
    upper: np.ndarray  # (p,)
    of_theta: np.ndarray  # (p, k)
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
        """The free leaves (p,) at coordinates (k,), mirrored at their bounds.

        The density of what is mirrored is that of the leaves, on both sides of a bound.
        """
        theta = jnp.asarray(self.theta) + jnp.asarray(self.of_theta) @ z
        has_lower, has_upper = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        lower, upper = jnp.where(has_lower, self.lower, 0), jnp.where(has_upper, self.upper, 0)
        width = jnp.where(has_lower & has_upper, upper - lower, 1)
        between = lower + abs(jnp.mod(theta - lower + width, 2 * width) - width)
        theta = jnp.where(has_lower & ~has_upper, lower + abs(theta - lower), theta)
        theta = jnp.where(has_upper & ~has_lower, upper - abs(upper - theta), theta)
        return jnp.where(has_lower & has_upper, between, theta)

    def shifts_at(self, theta: Array, z: Array) -> Array:
        """The changes of the initial states (trajectories, m) at their coordinates."""
        by_theta = jnp.asarray(self.by_theta) @ (theta - jnp.asarray(self.theta))
        return by_theta + jnp.einsum("nij,nj->ni", jnp.asarray(self.of_states), z)


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
    residuals: np.ndarray | None  # number of all residuals; None where the noise is given


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
        linearised = problem.linearise(level, free.theta, self.states)
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
            self._coordinates(linearised.system, known, numbers),
            numbers,
            tuple(problem.prior),
            None if problem.noise_is_given else np.array(float(linearised.number)),
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

    def _coordinates(self, system: BlockArrow, known: Information, numbers: Numbers) -> Coordinates:
        problem, free, m = self.problem, self.problem.free, system.unknowns
        deviation = np.sqrt(max(self.variance, NO_NOISE))
        of_theta = deviation * known.whiten(np.eye(len(free.theta)))
        own, lengths = eliminate(system, 0).own, system.own_lengths()
        left, sizes, right = np.linalg.svd(own[:, :, :m] / lengths[:, None])
        seen = sizes > system.rank_tolerance
        inverse = np.swapaxes(right, 1, 2) * (seen / np.where(seen, sizes, 1))[:, None]
        inverse = inverse / lengths[:, :, None]
        to_linear = np.zeros((of_theta.shape[1], 0))
        of_theta = _narrowed(of_theta, free.max_step)
        if numbers.positions:
            to_linear = np.linalg.pinv(numbers.jacobian(problem.parameters, free) @ of_theta)
        turns = np.where(np.arange(m) < 3, LARGE_TURN, np.inf)
        return Coordinates(
            free.theta,
            free.lower,
            free.upper,
            of_theta,
            jax.tree.map(np.asarray, self.states),
            -inverse @ np.swapaxes(left, 1, 2) @ own[:, :, 2 * m : -1],
            _narrowed(deviation * inverse, turns),
            1.0 - seen,
            to_linear,
        )


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
    parameters, free, parts, coordinates, numbers, prior, residuals = target
    of_leaves, of_states = z[: coordinates.known], z[coordinates.known :]
    of_states = of_states.reshape(coordinates.idle.shape)
    theta = coordinates.leaves_at(of_leaves)
    shifts = coordinates.shifts_at(theta, of_states)
    states, first, cost = coordinates.states.moved(shifts), 0, jnp.zeros((), z.dtype)
    for part in parts:
        model = part.of_leaves.at(parameters, free, theta)
        last = first + part.trajectories.segments.start.shape[1]
        arguments = states.at(slice(first, last)), part.trajectories, part.method
        cost, first = cost + jnp.sum(simulate_costs(model, part.of_leaves.own, *arguments)), last
    # Under Jeffreys' prior 1 / sigma of the size of the noise, which is integrated out.
    fitted = -cost / 2 if residuals is None else -jnp.asarray(residuals) / 2 * jnp.log(cost)
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
