"""The search for the best manoeuvres: random ones within the limits, and descent from the best.

The descent is SciPy's SLSQP: sequential quadratic programming keeps to nonlinear limits and ends
exactly at those that bind, in some tens of iterations, as the derivatives of all limits are known.
Penalties or maps of bounds, which a gradient method of optax would need, do not know limits along a
motion.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, NonlinearConstraint, minimize

from ..running.progress import show_progress
from .criterion import Criterion, assess
from .limits import ROUNDING, Commands, Limits, LimitUse
from .manoeuvre import Effects, Experiment, differentiate_manoeuvres

RANDOM = 24  # experiments within the limits, of which the descent starts from the best
SHRINKINGS = 8  # at most, of a random experiment
STARTS = 3
UNITS = {"rate": "rad/s", "saturation": "rad/s", "turn": "rad", "travel": "m", "torque": "N m"}
MARGIN = 3e-3  # part of a limit that is left for what happens between the nodes
ITERATIONS = 200
ENOUGH = 1e-5  # relative change of a standard error that does not matter
AGREE = 1e-2  # relative difference of standard errors of experiments that are as good
NOTHING = 1e-10  # information, relative to that of all random experiments, that is rounding


class Evaluated(NamedTuple):
    """One experiment."""

    manoeuvres: np.ndarray  # (trajectories, numbers)
    information: np.ndarray  # (draws, p, p), with what is known before
    information_changes: np.ndarray  # (draws, trajectories, numbers, p, p)
    effects: Effects  # (draws * trajectories, ...)

    @property
    def largest_use(self) -> float:
        """The largest part of a limit that is taken along the motion."""
        return float(np.sqrt(max(np.max(use) for use in self.effects.uses.values())))


class Space(NamedTuple):
    """All experiments: trajectories, whose manoeuvres have limits, and draws of the model."""

    experiment: Experiment
    limits: Limits
    thetas: np.ndarray  # (draws, p)
    R: np.ndarray  # (trajectories, 3, 3)
    own: np.ndarray  # (trajectories, m)
    known: np.ndarray  # (draws, p, p), information before the experiment

    @property
    def trajectories(self) -> int:
        return len(self.R)

    @property
    def commands(self) -> Commands | None:
        return self.experiment.commands

    @property
    def calm(self) -> np.ndarray:
        """The manoeuvre of a trajectory (numbers,) that does little."""
        if self.commands is None:
            return np.zeros(3)
        return np.concatenate([np.zeros(3), np.tile(self.commands.calm, self.commands.knots)])

    @property
    def scale(self) -> np.ndarray:
        """The size of each number of a manoeuvre (numbers,); zero where it is fixed."""
        rate = np.full(3, self.limits.largest_initial_rate)
        if self.commands is None:
            return rate
        lower, upper, start, knots = (
            self.commands.lower,
            self.commands.upper,
            self.commands.start,
            self.commands.knots,
        )
        sizes = np.tile((upper - lower) / 2, (knots, 1))
        sizes[0, ~np.isnan(start)] = 0
        return np.concatenate([rate, sizes.ravel()])

    def at_knots(self, manoeuvres: np.ndarray) -> np.ndarray:
        """The commands (..., knots, columns) of manoeuvres (..., numbers)."""
        columns = 0 if self.commands is None else len(self.commands.lower)
        knots = 0 if self.commands is None else self.commands.knots
        return manoeuvres[..., 3:].reshape(*manoeuvres.shape[:-1], knots, columns)

    def draw(self, random: np.random.Generator) -> np.ndarray:
        """A random experiment (trajectories, numbers), within the limits of rates and commands."""
        count = self.trajectories
        omega = random.normal(size=(count, 3))
        omega /= np.linalg.norm(omega, axis=1, keepdims=True)
        size = self.limits.largest_initial_rate * random.uniform(size=(count, 1)) ** (1 / 3)
        if self.commands is None:
            return size * omega
        lower, upper, slope = self.commands.lower, self.commands.upper, self.commands.slope
        knots = random.uniform(lower, upper, (count, self.commands.knots, len(lower)))
        start = self.commands.start
        knots[:, 0] = np.where(np.isnan(start), knots[:, 0], start)
        step = slope * (self.experiment.grid.knots[1] - self.experiment.grid.knots[0])
        for k in range(1, self.commands.knots):
            knots[:, k] = np.clip(knots[:, k], knots[:, k - 1] - step, knots[:, k - 1] + step)
        return np.concatenate([size * omega, knots.reshape(count, -1)], axis=1)

    def evaluate(self, manoeuvres: np.ndarray) -> Evaluated:
        """What an experiment would tell for each draw, and how much of the limits it takes."""
        draws, (count, numbers), p = len(self.thetas), manoeuvres.shape, self.thetas.shape[1]
        with show_progress() as progress:
            progress.iterations += 1
        effects = differentiate_manoeuvres(
            self.experiment,
            np.repeat(self.thetas, count, axis=0),
            np.tile(self.R, (draws, 1, 1)),
            np.tile(self.own, (draws, 1)),
            np.tile(manoeuvres, (draws, 1)),
        )
        information, changes = effects.information(p)
        information = information.reshape(draws, count, p, p).sum(1) + self.known
        changes = changes.reshape(draws, count, numbers, p, p)
        return Evaluated(manoeuvres, information, changes, effects)

    def uses_along(self, evaluated: Evaluated) -> Iterator[LimitUse]:
        """How much is taken of each limit along the motion."""
        for name, squares in evaluated.effects.uses.items():
            limit = np.ravel(self.experiment.limits[name])
            number = np.argmax(squares) % len(limit)
            size, part = float(limit[number]), float(np.sqrt(np.max(squares)))
            extreme = part * size
            if name == "turn":
                extreme = float(np.arccos(np.clip(1 - part**2 * (1 - np.cos(size)), -1, 1)))
            of = ""
            if name == "torque" and self.commands is not None:
                of = f" of {self.commands.names[number]}"
            elif name == "saturation":
                of = f" about {'xyz'[number]}" if len(limit) > 1 else ""
            yield LimitUse(f"{name}{of}", UNITS[name], extreme, size)

    def draw_within(self, random: np.random.Generator) -> Evaluated:
        """A random experiment, of which so much less is done that it is within all limits.

        Where the calm is not within the limits, it is as it was drawn.
        """
        drawn = evaluated = self.evaluate(self.draw(random))
        for _ in range(SHRINKINGS):
            if evaluated.largest_use <= 1:
                return evaluated
            part = min(0.98 / evaluated.largest_use, 0.9)
            evaluated = self.evaluate(self.calm + part * (evaluated.manoeuvres - self.calm))
        return evaluated if evaluated.largest_use <= 1 else drawn


class Goal(NamedTuple):
    """What is to be known well."""

    criterion: Criterion
    jacobians: np.ndarray  # (draws, n, p), of a quantity
    basis: np.ndarray  # (p, q), directions that some experiment tells

    def assess(self, evaluated: Evaluated) -> tuple[float, np.ndarray]:
        """The mean over the draws of the criterion, and its gradient (trajectories, numbers)."""
        value, gradient, basis = 0.0, np.zeros(evaluated.manoeuvres.shape), self.basis
        parts = zip(
            self.jacobians, evaluated.information, evaluated.information_changes, strict=True
        )
        for jacobian, information, changes in parts:
            of_draw, slope = assess(self.criterion, basis.T @ information @ basis, jacobian @ basis)
            slope = basis @ slope @ basis.T
            value += of_draw / len(self.jacobians)
            gradient += np.sum(slope * changes, axis=(2, 3)) / len(self.jacobians)
        return value, gradient


class SearchResult(NamedTuple):
    """The result of a search."""

    best: Evaluated
    usual: Evaluated  # of the random experiments within the limits the middle one
    converged: bool
    starts: int  # of the descent
    agreeing: int  # that end as well as the best


class Directions(NamedTuple):
    """Directions of the free leaves, in units in which the information on each leaf is about 1."""

    seen: np.ndarray  # (p, q), that are observable by some experiment
    hidden: np.ndarray  # (p, p - q)
    scale: np.ndarray  # (p,), of the leaves

    @property
    def coordinates(self) -> np.ndarray:
        """From the leaves to the coordinates along what is observable (q, p)."""
        return (self.seen * self.scale[:, None] ** 2).T


def find_directions(experiments: Sequence[Evaluated]) -> Directions:
    """Which directions of the free leaves some experiment shows."""
    information = np.mean([x.information[0] for x in experiments], axis=0)
    scale = np.sqrt(np.diagonal(information))
    scale = np.where(scale > 0, scale, 1)
    values, axes = np.linalg.eigh(information / np.outer(scale, scale))
    is_seen = values > NOTHING * len(values)
    axes = axes / scale[:, None]
    return Directions(axes[:, is_seen], axes[:, ~is_seen], scale)


def search(space: Space, goal: Goal, experiments: Sequence[Evaluated]) -> SearchResult:
    """The best experiment, by descent from the best of random experiments.

    Raises
    ------
    ValueError
        If no experiment is within the limits; it names the limit.
    """
    within = [x for x in experiments if x.largest_use <= 1]
    if not within:
        nearest = sorted(experiments, key=lambda x: x.largest_use)[:STARTS]
        approached = [_approach(space, start) for start in nearest]
        within = [x for x, is_within in approached if is_within]
        if not within:
            _raise_infeasible(space, min((x for x, _ in approached), key=lambda x: x.largest_use))
    ordered = sorted(within, key=lambda x: goal.assess(x)[0])
    starts = ordered[:STARTS]
    ends = [end for start in starts for end in _descend(space, goal, start)]
    ends.append((ordered[0], False))
    values = np.array([goal.assess(end)[0] for end, _ in ends])
    best, converged = ends[int(np.argmin(values))]
    agreeing = int(np.sum(values[:-1] <= values.min() + AGREE))
    return SearchResult(best, ordered[len(ordered) // 2], converged, len(starts), agreeing)


def _descend(space: Space, goal: Goal, start: Evaluated) -> Iterator[tuple[Evaluated, bool]]:
    """Where SLSQP ends from a start, if that is within the limits, and whether it converged."""
    problem = _Problem(space, start)
    slope: Any = problem.room_slope
    result = minimize(
        lambda x: problem.objective(goal, x),
        problem.first,
        jac=True,
        bounds=Bounds(problem.lower, problem.upper),
        constraints=[
            NonlinearConstraint(problem.room, 0, np.inf, slope),
            *problem.slopes,
        ],
        method="SLSQP",
        options={"maxiter": ITERATIONS, "ftol": ENOUGH},
    )
    if problem.is_within(result.x):
        yield problem.evaluate(result.x), bool(result.success)


class _Problem:
    """What is not fixed of all manoeuvres, as a vector of about unit size: the search from a start.

    Room that is left of a limit is the part of its square, and never below zero.
    """

    def __init__(self, space: Space, start: Evaluated):
        self.space, self.shape = space, start.manoeuvres.shape
        self.center, values = np.tile(space.calm, space.trajectories), start.manoeuvres.ravel()
        scale = np.tile(space.scale, space.trajectories)
        self.is_free = scale > 0
        # Limits along the motion may leave much less room than those of rates and commands: with a
        # larger unit the first step of a descent goes far beyond them.
        is_rate = np.arange(len(scale)) % len(space.scale) < 3
        moved = abs(values - self.center) / np.where(self.is_free, scale, 1)
        sizes = [np.max(moved, where=kind, initial=0) or 1.0 for kind in (is_rate, ~is_rate)]
        self.scale = (scale * np.where(is_rate, *sizes))[self.is_free]
        self.first = (values - self.center)[self.is_free] / self.scale
        lower, upper = (self.center + sign * scale for sign in (-1, 1))
        if (commands := space.commands) is not None:
            for bound, of_columns in ((lower, commands.lower), (upper, commands.upper)):
                bound.reshape(self.shape)[:, 3:] = np.tile(of_columns, commands.knots)
        self.lower: Any = (lower - self.center)[self.is_free] / self.scale
        self.upper: Any = (upper - self.center)[self.is_free] / self.scale
        self.slopes = list(self._slopes())
        self.last: tuple[bytes, Evaluated] | None = None

    def manoeuvres(self, x: np.ndarray) -> np.ndarray:
        values = self.center.copy()
        values[self.is_free] += self.scale * x
        return values.reshape(self.shape)

    def evaluate(self, x: np.ndarray) -> Evaluated:
        key = x.tobytes()
        if self.last is None or self.last[0] != key:
            self.last = key, self.space.evaluate(self.manoeuvres(x))
        return self.last[1]

    def is_within(self, x: np.ndarray) -> bool:
        """Whether limits are kept; SLSQP may end beyond them where it does not converge."""
        changes = [limit.A @ x for limit in self.slopes]
        return bool(
            np.all(self.room(x) >= -MARGIN)
            and all(
                np.all((limit.lb - ROUNDING <= change) & (change <= limit.ub + ROUNDING))
                for limit, change in zip(self.slopes, changes, strict=True)
            )
        )

    def objective(self, goal: Goal, x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = goal.assess(self.evaluate(x))
        return value, gradient.ravel()[self.is_free] * self.scale

    def room(self, x: np.ndarray) -> np.ndarray:
        uses = self.evaluate(x).effects.uses.values()
        left = np.concatenate([use.ravel() for use in uses])
        at_start = np.sum(self._initial_rates(x) ** 2, axis=1)
        return (1 - MARGIN) ** 2 - np.append(left, at_start)

    def room_slope(self, x: np.ndarray) -> np.ndarray:
        changes, count = self.evaluate(x).effects.uses_changes.values(), self.shape[0]
        at_start = np.zeros((count, 1, self.shape[1]))
        limit = self.space.limits.largest_initial_rate or 1.0
        at_start[:, 0, :3] = 2 * self._initial_rates(x) / limit
        rows = []
        for table in (*changes, at_start):
            of_all = np.zeros((*table.shape[:2], *self.shape))
            at = np.arange(len(table))
            of_all[at, :, at % count] = -table
            rows.append(of_all.reshape(-1, self.center.size))
        return np.concatenate(rows)[:, self.is_free] * self.scale

    def _initial_rates(self, x: np.ndarray) -> np.ndarray:
        """The angular rates at the start (trajectories, 3), as parts of their limit."""
        return self.manoeuvres(x)[:, :3] / (self.space.limits.largest_initial_rate or 1.0)

    def _slopes(self) -> Iterator[LinearConstraint]:
        """The limits of the change of commands from knot to knot."""
        commands, knots = self.space.commands, self.space.experiment.grid.knots
        if commands is None or not np.any(np.isfinite(commands.slope)):
            return
        steps = np.kron(
            np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, None],
            np.diag(1 / commands.slope),
        )
        of_one = np.concatenate([np.zeros((len(steps), 3)), steps], axis=1)
        of_all = np.kron(np.eye(self.shape[0]), of_one[np.any(of_one != 0, axis=1)])
        at_zero: Any = of_all @ self.center
        yield LinearConstraint(of_all[:, self.is_free] * self.scale, -1 - at_zero, 1 - at_zero)


def _approach(space: Space, start: Evaluated) -> tuple[Evaluated, bool]:
    """The experiment that exceeds limits least, from a start, and whether it is within them."""
    problem = _Problem(space, start)

    def excess(x: np.ndarray) -> tuple[float, np.ndarray]:
        missing = np.minimum(problem.room(x), 0)
        return float(np.sum(missing**2)), 2 * missing @ problem.room_slope(x)

    least = minimize(
        excess,
        problem.first,
        jac=True,
        bounds=Bounds(problem.lower, problem.upper),
        constraints=problem.slopes,
        method="SLSQP",
        options={"maxiter": ITERATIONS, "ftol": MARGIN**4},
    )
    return problem.evaluate(least.x), problem.is_within(least.x)


def _raise_infeasible(space: Space, nearest: Evaluated) -> NoReturn:
    """Name the limit that no experiment keeps."""
    use = max(space.uses_along(nearest), key=lambda use: use.extreme / use.limit)
    raise ValueError(
        f"Argument `limits` must allow an experiment, but none was found: `{use.name}` comes down "
        f"to {use.extreme:.3g} {use.unit}, and its limit is {use.limit:.3g} {use.unit}."
    )
