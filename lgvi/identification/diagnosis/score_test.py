r"""What freeing each suspect would gain, without a fit: score tests.

The problem at the minimum is linearised in the free leaves and in those of all suspects at once; a
step of both then gives how far chi-square would fall, and how far the estimate would move: C. R.
Rao, "Large sample tests of statistical hypotheses concerning several parameters", Proc. Cambridge
Philos. Soc. 44 (1948), doi:10.1017/S0305004100023987. How probable that is by chance follows from
the same scatter of trajectories, or blocks of time, as standard errors do.
"""

from collections.abc import Sequence
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from ..least_squares.block_arrow import BlockArrow
from ..least_squares.elimination import Increment, solve
from ..least_squares.linearise import Linearised, join_parts, linearise_part
from ..model.states import InitialStates
from ..problem import FitProblem
from ..progress import show_progress
from ..segments.chain import Directions, Places, with_all_leaves
from ..uncertainty.clusters import LEAST_CLUSTERS, cluster_blocks
from ..uncertainty.information import Information, compute_information
from ..uncertainty.noise import NO_NOISE
from ..uncertainty.sandwich import compute_sandwich
from ..windows.level import whole_level
from .left_out import LeftOut, all_left_out


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
        known: Information,
        variance: float,
    ):
        """At the minimum of a problem, with the estimate in `problem.free`."""
        self.problem, self.longest_steps, self.states = problem, longest_steps, states
        self.known, self.variance = known, variance

    @property
    def not_tried(self) -> str:
        """Where suspects are not tried, as here, in words; empty if they are."""
        if any(each.recordings.are_stored for each in self.problem.configurations):
            return "recordings are in files"  # they may be too many
        return "processes fit together" if self.problem.together.are_several else ""

    @cached_property
    @show_progress("score tests")
    def found(self) -> list[Scored]:
        """The suspects that are observable, the largest gain first.

        There are none, if they are not tried, whole trajectories cannot be simulated, or nothing
        tells the size of the noise. Leaves that are free are no suspects.
        """
        known = self.known
        if self.not_tried or not NO_NOISE < self.variance < np.inf:
            return []
        suspects = self._suspects()
        linearised = self._linearise(suspects)
        if linearised is None:
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
            left = self.variance * max(1 - gain / linearised.cost, 1e-12)
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

    def _linearise(self, suspects: Sequence[LeftOut]) -> Linearised | None:
        """The problem in its free leaves and in the numbers of suspects, about the estimate.

        None, if whole trajectories cannot be simulated.
        """
        problem, parts = self.problem, []
        theta = problem.free.theta
        level = whole_level(problem.configurations, self.longest_steps)
        for configuration, method, chains, part in zip(
            problem.configurations, problem.methods, level.layouts, level.parts, strict=True
        ):
            at = configuration.at(problem.parameters, problem.free, theta)
            model = with_all_leaves(at).model
            places = Places.of_model(model)
            more = [suspect.directions(model, places) for suspect in suspects]
            more = reduce(Directions.followed_by, more)
            given = self.states.at(part), chains, method
            options = {"blocks": problem.blocks, "mesh": problem.mesh, "more": more}
            parts.append(linearise_part(at, *given, **options))
        others = sum(suspect.number for suspect in suspects)
        prior = problem.prior_rows(theta)
        prior = np.insert(prior, [theta.size] * others, 0, axis=1)
        found = join_parts(parts, np.pad(theta, (0, others)), prior)
        if not np.isfinite(found.cost):
            return None
        direction = np.pad(self.known.unobservable, (0, others))
        return found._replace(system=found.system.without(direction))

    def _suspects(self) -> tuple[LeftOut, ...]:
        """What the models may leave out; leaves that are free, or a trajectory's own, are none."""
        configurations = self.problem.configurations
        recorded = [each.recordings for each in configurations]
        has_rotor = any(each.rotor_momentum is not None for each in recorded)
        depends_on_time = has_rotor or any(
            each.model.torque is not None
            or each.recordings.body_torque is not None
            or each.recordings.rotor_speed is not None
            for each in configurations
        )
        chosen = [
            selected
            for each in configurations
            for selected in (each.selected, each.own)
            if selected is not None
        ]
        models = [each.model for each in configurations]
        return tuple(
            each
            for each in all_left_out(models, depends_on_time, has_rotor)
            if not any(each.is_chosen(selected) for selected in chosen)
        )


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
