"""Draws of the posterior by NUTS, about the minimum of a fit.

The No-U-Turn Sampler: M. D. Hoffman & A. Gelman, J. Mach. Learn. Res. 15 (2014). The unknowns are
those of the fit: the free leaves, along the directions that are observable, and the initial state
of each trajectory. They are put in coordinates in which the problem that is linearised about the
minimum is a standard normal distribution, so that the sampler needs no mass matrix.
"""

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
from ..model.free_leaves import Free
from ..model.prior import Prior
from ..model.states import InitialStates
from ..running.compilation import compiled
from ..running.progress import show_progress
from ..segments.levels import whole_level
from ..segments.whole import Trajectories, simulate_costs
from ..solver.elimination import BlockArrow, eliminate
from ..uncertainty.information import NO_NOISE, Information, compute_information
from .flat_coordinates import FlatCoordinates, make_flat_coordinates, make_inner
from .problem import AbstractAtMinimum

CHAINS = 4
MOST_STEPS = 100_000  # of the integrator, in all trajectories
FEWEST_DRAWS = 100  # of each chain
BLOCK = 50  # transitions that one call of the program makes
WARM_UP = 5  # blocks in which the step is found, and which are left out
ACCEPTANCE = 0.9  # of proposals, for which the step is found: valleys are narrow and bent
FIRST_STEP = 0.5
SPREAD = 2.0  # of the starts, wider than the posterior, so that R-hat tells what is not reached
DOUBLINGS = 8  # of a path, at most: a longer one follows something that is not known
LONG_PATH = 2 ** (DOUBLINGS - 1)  # steps of the mean path, from which on draws would take hours
MOST_HALVINGS = 10  # of the distance of a start from the minimum
LARGE_TURN = 1.0  # rad, of an initial attitude, for which a linear model is good


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
            f"Argument `draws` must be a whole number of at least {FEWEST_DRAWS}, such as 1000, of "
            f"each chain, but is {draws!r}."
        )


class Drawn(NamedTuple):
    """Draws, and what the recordings tell where second moments do not vanish."""

    theta: np.ndarray  # (chains, draws, p), free leaves
    information: Information  # with no leaf at a bound
    divergences: int  # transitions that were cut short, as their energy was wrong


class StateCoordinates(NamedTuple):
    """From standard normal coordinates, about, to the initial states of trajectories."""

    states: InitialStates  # at the minimum
    of_leaves: np.ndarray  # (trajectories, m, k), the change of the most likely states
    of_states: np.ndarray  # (trajectories, m, m)
    idle: np.ndarray  # (trajectories, m), 1 for a coordinate that moves nothing

    def shifts_at(self, of_leaves: Array, z: Array) -> Array:
        """The changes of the states, and their coordinates `z`, both (trajectories, m)."""
        most_likely = jnp.asarray(self.of_leaves) @ of_leaves
        return most_likely + jnp.einsum("nij,nj->ni", jnp.asarray(self.of_states), z)


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
    leaves: FlatCoordinates
    states: StateCoordinates
    prior: tuple[Prior, ...]
    residuals: np.ndarray  # number of all residuals
    least: np.ndarray  # cost about the minimum
    noise_is_given: np.ndarray  # whether it is

    @property
    def dimension(self) -> int:
        """Number of coordinates of the free leaves."""
        return self.leaves.of_theta.shape[1]

    @property
    def unknowns(self) -> int:
        """Number of all coordinates."""
        return self.dimension + self.states.idle.size

    def leaves_at(self, z: Array) -> Array:
        """The free leaves (p,) at all coordinates (unknowns,)."""
        return self.leaves.leaves_at(self.leaves.limits.mirror(z[: self.dimension]))[0]


class Sampler(AbstractAtMinimum):
    """Draws the free leaves and the initial states."""

    @show_progress("sampling")
    def draw(self, draws: int, key: Array) -> Drawn:
        """So many draws of each chain.

        Raises
        ------
        ValueError
            If several processes fit together, a loss is robust, a leaf of a body has bounds, too
            much or no more was read than is fitted, or no direction of the free leaves is
            observable.
        RuntimeError
            If whole trajectories cannot be simulated.
        """
        # The package is optional, and takes some seconds to be imported.
        from blackjax.adaptation.step_size import dual_averaging_adaptation

        target, known = self._target()
        first = dual_averaging_adaptation(ACCEPTANCE)[0](FIRST_STEP)
        adaptation = jax.tree.map(lambda x: np.asarray(x, jnp.result_type(x)), first)
        states = _start(target, key)
        theta, divergences = [], 0
        with show_progress() as progress:
            for block in range(WARM_UP - (-draws // BLOCK)):
                warms_up = block < WARM_UP
                at = key, np.array(block), np.array(warms_up)
                states, adaptation, of_block, diverged, path = _draw_block(
                    target, states, adaptation, *at, optimised=True
                )
                progress.iterations += BLOCK
                if block == WARM_UP - 1 and path > LONG_PATH:
                    raise RuntimeError(
                        f"The posterior is too narrow and bent to be drawn, as {path:.0f} steps do "
                        "not cross it: give the fit a `prior` for what is known roughly, or fix it."
                    )
                if not warms_up:
                    theta.append(np.asarray(of_block, float))
                    divergences += int(diverged)
        return Drawn(np.concatenate(theta, axis=1)[:, :draws], known, divergences)

    def _target(self) -> tuple[Target, Information]:
        problem = self.problem
        self._require_likelihood()
        free, level = problem.free, whole_level(problem.configurations, self.longest_steps)
        steps = sum(int(np.sum(chains.steps)) for chains in level.chains)
        if steps > MOST_STEPS:
            raise ValueError(
                f"There are no draws for {steps} steps of the integrator: with more than "
                f"{MOST_STEPS} derivatives are too much for the memory, and so many readings need "
                "no draws."
            )
        inner = make_inner(problem.parameters, free)
        linearised = problem.linearise(level, inner.theta, self.states)
        if not np.isfinite(linearised.cost):
            raise RuntimeError(
                "Sampling simulates whole trajectories, which fails near the estimate: take "
                "recordings that are shorter."
            )
        known = compute_information(linearised.system, free.lower == free.upper)
        if not known.observable.any():
            raise ValueError("There are no draws where no direction of what is free is observable.")
        parts = [
            Part(configuration.of_leaves, Trajectories.of(chains), method)
            for configuration, chains, method in zip(
                problem.configurations, level.chains, problem.methods, strict=True
            )
        ]
        of_theta = self.deviation * known.whiten(np.eye(len(free.theta)))
        of_theta = _narrowed(of_theta, free.max_step)
        leaves = make_flat_coordinates(problem.parameters, free, inner, of_theta, known)
        target = Target(
            problem.parameters,
            free,
            tuple(parts),
            leaves,
            self._state_coordinates(linearised.system, leaves),
            tuple(problem.prior),
            np.array(float(linearised.number)),
            np.array(float(linearised.cost)),
            np.array(problem.noise_is_given),
        )
        return target, known

    def _require_likelihood(self) -> None:
        self.require_noise("there are no draws")
        problem = self.problem
        if any(configuration.model.is_robust for configuration in problem.configurations):
            raise ValueError(
                "There are no draws with a robust loss, which is the likelihood of no noise: fit "
                "sensors without a `loss`."
            )
        free = problem.free
        if (np.isfinite(free.lower) | np.isfinite(free.upper))[free.of_body].any():
            raise ValueError(
                "There are no draws where a leaf of a body has bounds, as the prior is flat in "
                "second moments: give a `prior` instead."
            )

    @property
    def deviation(self) -> float:
        """The standard deviation of a residual."""
        return np.sqrt(max(self.variance, NO_NOISE))

    def _state_coordinates(self, system: BlockArrow, leaves: FlatCoordinates) -> StateCoordinates:
        m = system.unknowns
        own, lengths = eliminate(system, 0).own, system.own_lengths()
        left, sizes, right = np.linalg.svd(own[:, :, :m] / lengths[:, None])
        seen = sizes > system.rank_tolerance
        inverse = np.swapaxes(right, 1, 2) * (seen / np.where(seen, sizes, 1))[:, None]
        inverse = inverse / lengths[:, :, None]
        by_theta = -inverse @ np.swapaxes(left, 1, 2) @ own[:, :, 2 * m : -1]
        turns = np.where(np.arange(m) < 3, LARGE_TURN, np.inf)
        return StateCoordinates(
            jax.tree.map(np.asarray, self.states),
            by_theta @ leaves.of_theta,
            _narrowed(self.deviation * inverse, turns),
            1.0 - seen,
        )


def _narrowed(root: np.ndarray, most: np.ndarray) -> np.ndarray:
    """A root (..., p, k) of a covariance, no wider in each number than a linear model is good."""
    wide = root / most[:, None]
    precision = np.eye(root.shape[-1]) + np.swapaxes(wide, -1, -2) @ wide
    # The root of the inverse that is nearest to the identity, so that little changes.
    squares, axes = np.linalg.eigh(precision)
    return root @ (axes / np.sqrt(squares)[..., None, :]) @ np.swapaxes(axes, -1, -2)


def _start(target: Target, key: Array) -> Any:
    """States of the chains at normal coordinates, nearer to the minimum where not finite.

    Raises
    ------
    RuntimeError
        If the posterior is not finite near the minimum.
    """
    dtype = jax.dtypes.canonicalize_dtype(float)
    z = SPREAD * jax.random.normal(jax.random.fold_in(key, 0), (CHAINS, target.unknowns), dtype)
    for _ in range(MOST_HALVINGS):
        states, is_finite = _start_at(target, z)
        if np.all(is_finite):
            return states
        z = jnp.where(is_finite[:, None], z, z / 2)
    raise RuntimeError(
        "The posterior is not finite near the estimate, where sampling starts: fit with shorter "
        "steps, an `integrator` of smaller `dt`."
    )


@compiled("draws of the posterior")
def _draw_block(
    target: Target,
    states: Any,
    adaptation: Any,
    key: Array,
    block: Array | np.ndarray,
    warms_up: Array | np.ndarray,
) -> tuple[Any, Any, Array, Array, Array]:
    """The states of the chains after some transitions, and the adaptation of the step.

    Then the free leaves (chains, draws, p), the number of transitions that diverged, and the mean
    number of steps of a path.
    """
    from blackjax import nuts
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    _, adapt, settled = dual_averaging_adaptation(ACCEPTANCE)
    density, kernel = partial(_log_density, target), nuts.build_kernel()
    dtype = states.position.dtype
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
        leaves = jax.vmap(target.leaves_at)(states.position)
        path = jnp.mean(info.num_integration_steps.astype(dtype))
        return (states, adaptation), (leaves, jnp.sum(info.is_divergent), path)

    keys = jax.random.split(jax.random.fold_in(key, 1 + block), BLOCK)
    carry, (leaves, diverged, path) = jax.lax.scan(transition, (states, adaptation), keys)
    states, adaptation = carry
    return states, adaptation, leaves.swapaxes(0, 1), jnp.sum(diverged), jnp.mean(path)


@compiled("a start of the draws")
def _start_at(target: Target, z: Array) -> tuple[Any, Array]:
    """States of the chains at coordinates (chains, unknowns), and whether each is finite."""
    from blackjax import nuts

    states = jax.vmap(lambda z: nuts.init(z, partial(_log_density, target)))(z)
    slopes = jnp.all(jnp.isfinite(states.logdensity_grad), axis=1)
    return states, jnp.isfinite(states.logdensity) & slopes


def _log_density(target: Target, z: Array) -> Array:
    """The logarithm of the density of the coordinates (unknowns,), without constants."""
    parameters, free, parts, leaves, states, priors, residuals, least, is_given = target
    of_leaves, of_states = jnp.split(z, [target.dimension])
    of_leaves = leaves.limits.mirror(of_leaves)
    theta, volume = leaves.leaves_at(of_leaves)
    shifts = states.shifts_at(of_leaves, of_states.reshape(states.idle.shape))
    initial, first, cost = states.states.moved(shifts), 0, jnp.zeros((), z.dtype)
    for part in parts:
        model = part.of_leaves.at(parameters, free, theta)
        last = first + part.trajectories.segments.start.shape[1]
        arguments = initial.at(slice(first, last)), part.trajectories, part.method
        cost, first = cost + jnp.sum(simulate_costs(model, part.of_leaves.own, *arguments)), last
    # Under Jeffreys' prior 1 / sigma of the size of the noise, which is integrated out.
    rise, factor = cost - jnp.asarray(least), cost / jnp.asarray(least)
    density = -jnp.where(is_given, rise, jnp.asarray(residuals) * jnp.log(factor)) / 2
    with_leaves = free.put(parameters, theta)
    for prior in priors:
        values, _ = ravel_pytree(prior.function(with_leaves))
        misfits = (values - jnp.asarray(prior.mean)) / jnp.asarray(prior.deviation)
        density = density - jnp.sum(misfits**2) / 2
    density = density + volume
    # Initial attitudes are uniform: the volume of a rotation vector of length a is sinc²(a/2).
    squares = jnp.sum(shifts[:, :3] ** 2, axis=1)
    half = jnp.sqrt(jnp.maximum(squares, 1e-12)) / 2
    density = density + 2 * jnp.sum(jnp.log(abs(jnp.sin(half) / half)))
    return density - jnp.sum(jnp.asarray(states.idle).ravel() * of_states**2) / 2
