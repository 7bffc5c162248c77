r"""What freeing each suspect would gain, without a fit: score tests.

The problem at the minimum is linearised in the free leaves and in those of all suspects at once; a
step of both then gives how far chi-square would fall, and how far the estimate would move: C. R.
Rao, "Large sample tests of statistical hypotheses concerning several parameters", Proc. Cambridge
Philos. Soc. 44 (1948), doi:10.1017/S0305004100023987. How probable that is by chance follows from
the same scatter of trajectories, or blocks of time, as standard errors do.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array
from scipy.special import stdtr

from ...modules.sensors.base import AbstractSensor
from ..compilation import compiled
from ..data.recordings import Recordings
from ..least_squares.block_arrow import BlockArrow, Increment, solve
from ..least_squares.linearise import Linearised
from ..model.configuration import Configuration
from ..model.free import Free
from ..model.states import InitialStates
from ..problem import FitProblem
from ..uncertainty.clusters import LEAST_CLUSTERS, cluster_blocks
from ..uncertainty.information import Information, compute_information
from ..uncertainty.noise import NO_NOISE
from ..uncertainty.sandwich import compute_sandwich
from ..windows.initial_guess import largest_rates
from ..windows.level import whole_level
from ..windows.step_size import choose_method
from .left_out import Extended, LeftOut, all_left_out

TURN_OF_STEP = 0.05  # rad


class Scored(NamedTuple):
    """What freeing a suspect would do."""

    name: str
    gain: float  # how far chi-square would fall
    values: np.ndarray  # (n,), what its numbers would be
    errors: np.ndarray  # (n,), standard errors of these
    probability: float  # of a number as large as one of these by chance
    step: np.ndarray  # (p,), how far the free leaves would move


class ScoreTests:
    """The score tests of all suspects, computed when they are asked for."""

    def __init__(
        self,
        problem: FitProblem,
        longest_steps: Sequence[np.ndarray],
        states: InitialStates,
        residuals: Sequence[dict[str, np.ndarray]],
        known: Information,
        variance: float,
        chi_square: float,
    ):
        """At the minimum of a problem, with the estimate in `problem.free`."""
        self.problem, self.longest_steps, self.states = problem, longest_steps, states
        self.residuals, self.known = residuals, known
        self.variance, self.chi_square = variance, chi_square

    @cached_property
    def found(self) -> list[Scored]:
        """The suspects that are observable, the largest gain first.

        There are none, if whole trajectories cannot be simulated, or nothing tells the size of the
        noise. Leaves that are free are no suspects.
        """
        problem, known = self.problem, self.known
        if not NO_NOISE < self.variance < np.inf:
            return []
        recorded = [each.recordings for each in problem.configurations]
        # One program must serve all configurations: each has a rotor, or none has.
        has_rotor = all(each.rotor_momentum is not None for each in recorded)
        depends_on_time = any(
            part is not None
            for each in problem.configurations
            for part in (
                each.model.torque,
                each.recordings.body_torque,
                each.recordings.rotor_momentum,
            )
        )
        models = [each.model for each in problem.configurations]
        chosen = [
            selected
            for each in problem.configurations
            for selected in (each.selected, each.own)
            if selected is not None
        ]
        suspects = tuple(
            each
            for each in all_left_out(models, depends_on_time, has_rotor)
            if not any(each.is_chosen(selected) for selected in chosen)
        )
        linearised = self._linearise(suspects)
        if linearised is None or not np.isfinite(linearised.cost):
            return []
        p, blocks, at_bound = len(known.scale), linearised.blocks, known.at_bound
        none = _part(linearised.system, np.arange(p))
        base, rank = solve(none, 0, at_bound), compute_information(none, at_bound).rank
        found, end = [], p
        for suspect in suspects:
            end += suspect.number
            columns = np.concatenate([np.arange(p), np.arange(end - suspect.number, end)])
            system = _part(linearised.system, columns)
            bound = np.concatenate([at_bound, np.zeros(suspect.number, bool)])
            with_it = compute_information(system, bound)
            if with_it.rank < rank + suspect.number:
                continue
            step, m = solve(system, 0, bound), system.unknowns
            of_blocks = None if blocks is None else blocks[..., [*range(m), *(m + columns), -1]]
            # The scatter is that of the residuals which the step leaves.
            after, of_blocks = _after(system, of_blocks, step)
            gain = step.reduction - base.reduction
            left = self.variance * max(1 - gain / self.chi_square, 1e-12)
            clusters = cluster_blocks(after, of_blocks, with_it, LEAST_CLUSTERS)
            sandwich = compute_sandwich(clusters, with_it, left, system.of_prior())
            numbers = np.eye(len(columns))[p:]
            values, errors = step.theta[p:], np.sqrt(np.diag(sandwich.covariance_of(numbers)))
            ratio = abs(values) / np.where(errors > 0, errors, np.inf)
            by_chance = 2 * stdtr(sandwich.freedom_of(numbers), -ratio)
            found.append(
                Scored(
                    name=suspect.name,
                    gain=gain,
                    values=values,
                    errors=errors,
                    probability=min(1.0, suspect.number * float(np.min(by_chance))),
                    step=step.theta[:p] - base.theta,
                )
            )
        return sorted(found, key=lambda each: -each.gain)

    def _linearise(self, suspects: tuple[LeftOut, ...]) -> Linearised | None:
        """The problem in the free leaves and in the numbers of suspects, about the estimate.

        With a method that suits all suspects, and recordings that leave the same residuals with
        it. None, if the leaves that are a trajectory's own cannot be found again.
        """
        problem, free = self.problem, self.problem.free
        dtype = jax.dtypes.canonicalize_dtype(float)
        numbers = tuple(jax.device_put(np.zeros(suspect.number, dtype)) for suspect in suspects)
        parameters = problem.parameters, numbers
        extended = _extended(free, [number.size for number in numbers])
        configurations, methods, steps = [], [], []
        start = 0
        for each, method, longest in zip(
            problem.configurations, problem.methods, self.longest_steps, strict=True
        ):
            function = Extended(each.function, suspects)
            model = eqx.filter_jit(function)(parameters)
            given = each.name, each.recordings, function, model, parameters, extended
            configuration = Configuration.of_model(*given)
            if each.own is not None:
                own = _found_again(each.own, configuration.model)
                if own is None:
                    return None
                configuration = configuration._replace(own=own)
            states = self.states.at(slice(start, start + len(each.recordings)))
            start += len(each.recordings)
            speeds = largest_rates(each.model, each.recordings, states)
            of_model = configuration.model, each.recordings, None, speeds, TURN_OF_STEP
            chosen, step = choose_method(*of_model)
            configurations.append(configuration)
            methods.append(chosen)
            steps.append(np.minimum(step, longest) if method.order == chosen.order else step)
        found = replace(
            problem,
            parameters=parameters,
            free=extended,
            configurations=configurations,
            methods=methods,
            prior=[prior._replace(function=_OfFirst(prior.function)) for prior in problem.prior],
        )
        linearised = found.linearise(
            whole_level(configurations, steps), extended.theta, self.states
        )
        if not np.isfinite(linearised.cost):
            return None
        found.configurations = [
            each._replace(recordings=_with_residuals(each, part.predicted(), residuals))
            for each, part, residuals in zip(
                configurations, linearised.parts, self.residuals, strict=True
            )
        ]
        level = whole_level(found.configurations, steps)
        linearised = found.linearise(level, extended.theta, self.states)
        added = len(extended.theta) - len(free.theta)
        direction = np.pad(self.known.unobservable, (0, added))
        return linearised._replace(system=linearised.system.without(direction))


class _OfFirst(eqx.Module):
    """A function of the parameters, where these are the first of a pair."""

    function: Any = eqx.field(static=True)

    def __call__(self, both: tuple[Any, Any]) -> Any:
        return self.function(both[0])


def _extended(free: Free, numbers: Sequence[int]) -> Free:
    """The free leaves, and those of suspects, which are zero."""
    count = sum(numbers)

    def with_(values: np.ndarray, of_suspects: float) -> np.ndarray:
        return np.concatenate([values, np.full(count, of_suspects)])

    return free._replace(
        theta=with_(free.theta, 0.0),
        lower=with_(free.lower, -np.inf),
        upper=with_(free.upper, np.inf),
        max_step=with_(free.max_step, np.inf),
        scale_direction=with_(free.scale_direction, 0.0),
        selected=(free.selected, (True,) * len(numbers)),
    )


def _found_again(own: Any, model: Any) -> Any:
    """Leaves of a trajectory's own, by their names, in a model with suspects; None if not all."""
    wanted = {path for path, chosen in jax.tree_util.tree_leaves_with_path(own) if chosen}
    found = jax.tree_util.tree_map_with_path(lambda path, leaf: path in wanted, model)
    return found if sum(jax.tree.leaves(found)) == len(wanted) else None


def _with_residuals(
    configuration: Configuration,
    predicted: dict[str, np.ndarray],
    residuals: dict[str, np.ndarray],
) -> Recordings:
    """Recordings whose readings are predictions disturbed by residuals."""
    recordings, sensors = configuration.recordings, configuration.model.sensors
    dtype = jax.dtypes.canonicalize_dtype(float)

    def disturbed(channel: str) -> np.ndarray:
        count = len(predicted[channel])
        if not count:
            return predicted[channel]
        # Lengths are powers of two, so that one program serves many.
        index = np.arange(2 ** (count - 1).bit_length()) % count
        both = (each[channel][index].astype(dtype) for each in (predicted, residuals))
        return np.asarray(_disturbed(sensors[channel], *both, few=True), float)[:count]

    channels = {
        channel: replace(
            samples, values=disturbed(channel) if len(samples.values) else samples.values
        )
        for channel, samples in recordings.channels.items()
    }
    return replace(recordings, channels=type(recordings.channels)(channels))


@compiled
def _disturbed(sensor: AbstractSensor, predicted: Array, residuals: Array) -> Array:
    return jax.vmap(sensor.add_noise)(predicted, residuals)


def _after(
    system: BlockArrow, blocks: np.ndarray | None, step: Increment
) -> tuple[BlockArrow, np.ndarray | None]:
    """The system and its blocks of time, with the residuals after a step."""
    both = np.column_stack([step.own, np.tile(step.theta, (len(step.own), 1))])

    def moved(rows: np.ndarray) -> np.ndarray:
        change = np.einsum("n...j,nj->n...", rows[..., :-1].astype(float), both)
        return np.concatenate([rows[..., :-1], rows[..., -1:] + change[..., None]], axis=-1)

    of_blocks = None if blocks is None else moved(blocks)
    return system._replace(triangles=moved(system.triangles)), of_blocks


def _part(system: BlockArrow, columns: np.ndarray) -> BlockArrow:
    """The system in some of its common unknowns."""
    m = system.unknowns
    count = system.triangles.shape[2] - m - 1
    return BlockArrow(
        system.triangles[:, :, [*range(m), *(m + columns), -1]],
        prior=None if system.prior is None else system.prior[:, [*columns, -1]],
        sizes=np.broadcast_to(system.sizes, count)[columns],
        unobservable=np.broadcast_to(system.unobservable, count)[columns],
        unknowns=m,
    )
