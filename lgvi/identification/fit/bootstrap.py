"""The bootstrap: estimates from trajectories that are drawn again, whose scatter is the error."""

from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from ..model.states import InitialStates
from ..running.progress import show_progress
from ..segments.chain import LEAST_CURVATURE, linearise
from ..segments.levels import Level, whole_level
from ..solver.elimination import BlockArrow, eliminate
from ..solver.linearise import chained
from .problem import AbstractAtMinimum

DRAWS = 200  # fits, each of trajectories that are drawn again
ENOUGH = 1e-3  # gain of the last step, at most, in variances of a residual
FIRST_DAMPING, LARGEST_DAMPING = 1e-2, 1e4  # relative to the information of all trajectories
MOST_STEPS = 50  # of the fit of each draw
STIFF = 1e6  # relative information on a leaf that stays at its bound
UNSEEN = 1e-9  # relative information, at most, on a direction that a draw does not observe


class Bootstrap(AbstractAtMinimum):
    """The estimates of draws of trajectories, computed on first use.

    Of each configuration with n trajectories n are drawn, each with the same chance, and with
    replacement: B. Efron, "Bootstrap methods: another look at the jackknife", Ann. Stat. 7
    (1979), doi:10.1214/aos/1176344552. The mean of a prior is drawn from the prior. All draws are
    fitted at a time, from the estimate, by damped Newton steps. The variance of n trajectories that
    are drawn again is a little too small, by a factor of (n - 1)/n.
    """

    @cached_property
    @show_progress("bootstrap")
    def draws(self) -> np.ndarray:
        """The free leaves of each draw (draws, p); NaN where the fit of a draw did not converge.

        Raises
        ------
        ValueError
            If several processes fit together, none of which has all trajectories.
        RuntimeError
            If a trajectory cannot be simulated as a whole.
        """
        problem, free = self.problem, self.problem.free
        if problem.processes.are_several:
            raise ValueError("Where several processes fit together there is no bootstrap.")
        level = whole_level(problem.configurations, self.longest_steps)
        random = np.random.default_rng(0)
        counts = np.concatenate(
            [random.multinomial(n, np.full(n, 1 / n), DRAWS) for n in level.counts], axis=1
        )
        draw, trajectory = np.nonzero(counts)
        count = counts[draw, trajectory]
        shift = random.normal(size=(DRAWS, len(problem.prior_rows(free.theta))))
        shift *= np.sqrt(problem.prior_noise_variance)
        theta, damping = np.tile(free.theta, (DRAWS, 1)), np.zeros(DRAWS)
        here = self._linearise(level, theta, draw, self.states.at(trajectory), trajectory)
        prior = self._prior(theta, shift)
        cost = np.bincount(draw, count * here.cost) + np.sum(prior[:, :, -1] ** 2, axis=1)
        if not np.all(np.isfinite(cost)):
            raise RuntimeError(
                "The bootstrap simulates whole trajectories, which fails at the estimate: use "
                "standard errors of another kind."
            )
        fitting, done = np.ones(DRAWS, bool), np.zeros(DRAWS, bool)
        for _ in range(MOST_STEPS):
            steps, gain = self._steps(here, prior, draw, count, damping, theta)
            new_theta = np.clip(theta + steps, free.lower, free.upper)
            last = fitting & (gain <= ENOUGH * self.variance)
            theta[last], done[last], fitting[last] = new_theta[last], True, False
            at = np.flatnonzero(fitting[draw])
            if not len(at):
                break
            states = here.at(at).states_after((new_theta - theta)[draw[at]])
            there = self._linearise(level, new_theta, draw[at], states, trajectory[at])
            new_prior = self._prior(new_theta, shift)
            new_cost = np.bincount(draw[at], count[at] * there.cost, DRAWS)
            new_cost += np.sum(new_prior[:, :, -1] ** 2, axis=1)
            better = fitting & (new_cost < cost)
            theta[better], cost[better] = new_theta[better], new_cost[better]
            prior[better] = new_prior[better]
            moved = better[draw[at]]
            here.put(at[moved], there.at(moved))
            damping = np.where(better, damping / 10, np.maximum(10 * damping, FIRST_DAMPING))
            fitting &= damping <= LARGEST_DAMPING
        return np.where(done[:, None], theta, np.nan)

    def _prior(self, theta: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Rows of priors (draws, rows, p+1), with means that `shift` (draws, rows) moves."""
        if not shift.shape[1]:
            return np.zeros((DRAWS, 0, theta.shape[1] + 1))
        rows = self.problem.prior_rows(theta)
        rows[:, :, -1] += shift
        return rows

    def _steps(
        self,
        here: "_Linearised",
        prior: np.ndarray,
        draw: np.ndarray,
        count: np.ndarray,
        damping: np.ndarray,
        theta: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Damped steps of the free leaves (draws, p), and the gains of undamped ones (draws,)."""
        free = self.problem.free
        rows = self.known.whiten_residuals(here.left[:, :, :-1])
        first = np.searchsorted(draw, np.arange(DRAWS))  # each draw has a trajectory

        def summed(values: np.ndarray) -> np.ndarray:
            weight = count.reshape(-1, *(1,) * (values.ndim - 1))
            return np.add.reduceat(weight * values, first)

        prior_rows = self.known.whiten(prior[:, :, :-1])
        information = summed(np.swapaxes(rows, 1, 2) @ rows)
        information += np.swapaxes(prior_rows, 1, 2) @ prior_rows
        slope = summed(np.einsum("nrp,nr->np", here.left[:, :, :-1], here.left[:, :, -1]))
        slope += np.einsum("nrp,nr->np", prior[:, :, :-1], prior[:, :, -1])
        at_bound = ((theta <= free.lower) & (slope > 0)) | ((theta >= free.upper) & (slope < 0))
        leaves = self.known.whiten(np.eye(theta.shape[1]))
        leaves = leaves / np.maximum(np.linalg.norm(leaves, axis=1, keepdims=True), 1e-300)
        information += STIFF * np.einsum("np,pi,pj->nij", at_bound, leaves, leaves)
        squares, axes = np.linalg.eigh(information)
        gradient = summed(np.einsum("nrk,nr->nk", rows, here.left[:, :, -1]))
        gradient += np.einsum("nrk,nr->nk", prior_rows, prior[:, :, -1])
        along = np.einsum("nkj,nk->nj", axes, gradient) * (squares > UNSEEN)
        squares = np.maximum(squares, UNSEEN)
        steps = -np.einsum("nkj,nj->nk", axes, along / (squares + damping[:, None]))
        steps = steps @ self.known.whiten(np.eye(len(self.known.scale))).T
        longest = np.max(abs(steps) / free.max_step, axis=1)
        return steps / np.maximum(longest, 1)[:, None], np.sum(along**2 / squares, axis=1)

    def _linearise(
        self,
        level: Level,
        theta: np.ndarray,
        draw: np.ndarray,
        states: InitialStates,
        trajectory: np.ndarray,
    ) -> "_Linearised":
        """The problem of n trajectories of draws, with a state (n,) each.

        Each draw has its own free leaves (draws, p).
        """
        problem = self.problem
        m = states.unknowns
        models = [
            part.at(problem.parameters, problem.free, theta) for part in problem.configurations
        ]
        most = m + max(model.leaves.shape[1] for model in models) + 1
        rows = np.zeros((len(draw), most, m + theta.shape[1] + 1))
        cost = np.zeros(len(draw))
        for k, model in enumerate(models):
            first = level.parts[k].start
            at = np.flatnonzero((trajectory >= first) & (trajectory < level.parts[k].stop))
            if len(at):
                chains = level.chains[k].only(trajectory[at] - first)
                drawn = model._replace(leaves=model.leaves[draw[at]])
                arguments = problem.methods[k], LEAST_CURVATURE, 1, None, None
                linearised = linearise(drawn, states.at(at), chains, *arguments)
                triangle, cost[at] = linearised.triangles, linearised.cost
                if model.jacobian is not None:
                    triangle = chained(triangle, m, model.jacobian[draw[at]])
                rows[at, : triangle.shape[1]] = triangle
        own, left, _ = eliminate(BlockArrow(rows, unknowns=m), 0)
        return _Linearised(states, own, left, cost)


class _Linearised(NamedTuple):
    """Trajectories (n,), each about its own point, with rows as in `Eliminated`."""

    states: InitialStates
    own: np.ndarray  # (n, m, 2m+p+1)
    left: np.ndarray  # (n, rows, p+1)
    cost: np.ndarray  # (n,)

    def at(self, index: np.ndarray) -> "_Linearised":
        return jax.tree.map(lambda x: x[index], self)

    def put(self, index: np.ndarray, others: "_Linearised") -> None:
        """Replace the trajectories at an index by others."""
        for mine, new in zip(jax.tree.leaves(self), jax.tree.leaves(others), strict=True):
            mine[index] = new

    def states_after(self, steps: np.ndarray) -> InitialStates:
        """The best states after steps of the free leaves (n, p)."""
        m = self.own.shape[1]
        change = np.einsum("nij,nj->ni", self.own[:, :, 2 * m : -1], steps)
        side = (change + self.own[:, :, -1])[..., None]
        return self.states.moved(-np.linalg.solve(self.own[:, :, :m], side)[..., 0])
