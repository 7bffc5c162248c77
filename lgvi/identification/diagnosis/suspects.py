"""What a model may leave out: what freeing it would gain, by score tests, and in words."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from functools import cached_property, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from scipy.special import chdtrc, stdtr

from ...modules.sensors.sensor import AbstractSensor
from ..fit.part import FittedPart
from ..fit.problem import Problem
from ..model.model import Model
from ..model.states import InitialStates
from ..running.progress import show_progress
from ..segments.chain import Directions, Places, with_all_leaves
from ..segments.levels import whole_level
from ..solver.elimination import BlockArrow, Increment, solve
from ..solver.linearise import Linearised, join_parts, linearise_part
from ..uncertainty.information import NO_NOISE, Information, compute_information
from ..uncertainty.report_table import Numbers
from ..uncertainty.sandwich import LEAST_CLUSTERS, cluster_blocks, compute_sandwich

TIME_OFFSET, DRAG = "time_offset", "drag"  # for which None is zero
# Leaves to which numbers can be added.
OF_SENSORS = "bias", "scale", "alignment", "gravity_scale", "length_scale", DRAG
LINEAR, QUADRATIC, TIME_SCALE = "linear damping", "quadratic drag", "time_scale"
DELAY = "rotor_delay"

CHANCE = 1e-3  # probability at most, in all, of what is not taken for chance
NOTED = 0.05  # the same, of suspects that a report names
MOVED = 1.0  # standard errors by which a suspect must move a number to matter
ALIKE = 1e-6  # relative difference of gains between which the data do not decide


class LeftOut(NamedTuple):
    """Something that a model may leave out: a leaf of a sensor, or what acts on the body."""

    channel: str  # empty where it is no sensor's
    leaf: str
    number: int  # of numbers

    @property
    def name(self) -> str:
        return f"{self.channel}.{self.leaf}" if self.channel else self.leaf

    @property
    def is_of_rotor(self) -> bool:
        """Whether it is only where a rotor is recorded."""
        return self.leaf == DELAY

    def is_chosen(self, selected: Any) -> bool:
        """Whether a model of True, where a leaf is free, has it among these."""
        node = selected
        if self.channel:
            node = selected.sensors.get(self.channel)
        return any(jax.tree.leaves(getattr(node, self.leaf, None)))

    def directions(self, model: Model, places: Places) -> Directions:
        """The directions of its numbers, one column for each; zero where a model has no such leaf.

        Parameters
        ----------
        model
            A model with all its leaves.
        places
            Where they are.
        """
        found = Directions(np.zeros((places.number, self.number)), np.zeros((2, self.number)))
        if self.leaf in (LINEAR, QUADRATIC):  # 1/s, or 1/rad
            found.damping[int(self.leaf == QUADRATIC), 0] = 1
        elif self.leaf == TIME_SCALE:
            found.leaves[places.part(TIME_SCALE), 0] = float(model.time_scale)
        elif self.leaf == DELAY:
            found.leaves[places.rotor_delay, 0] = 1
        elif self.channel in model.sensors:
            at = places.leaf(self.channel, self.leaf)
            if len(at) == self.number:
                found.leaves[at, np.arange(self.number)] = 1
        return found


def all_left_out(models: Iterable[Model], depends_on_time: bool, has_rotor: bool) -> list[LeftOut]:
    """All that is suspected of some models, which share it.

    Unless something that acts depends on time, time offsets count from the first sensor's.
    """
    found: dict[LeftOut, None] = {}
    for model in models:
        first = None if depends_on_time else next(iter(model.sensors))
        for channel, sensor in model.sensors.items():
            leaves = OF_SENSORS if channel == first else (*OF_SENSORS, TIME_OFFSET)
            for leaf in leaves:
                if number := _number_of(sensor, leaf):
                    found[LeftOut(channel, leaf, number)] = None
    acting = [LeftOut("", leaf, 1) for leaf in (LINEAR, QUADRATIC, TIME_SCALE)]
    if has_rotor:
        acting.append(LeftOut("", DELAY, 1))
    return [*found, *acting]


def _number_of(sensor: AbstractSensor, leaf: str) -> int:
    """How many numbers a leaf of a sensor has, to which others can be added; 0 if it is no leaf."""
    learnable = {each.name for each in fields(sensor) if not each.metadata.get("static")}
    value = getattr(sensor, leaf, None)
    if leaf not in learnable or not (value is None or eqx.is_inexact_array(value)):
        return 0
    return int(leaf in (TIME_OFFSET, DRAG)) if value is None else np.size(value)


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
        problem: Problem,
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
        return "processes fit together" if self.problem.processes.are_several else ""

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


class Suspect(NamedTuple):
    """What the model may leave out, and what freeing it would do, by a score test.

    Attributes
    ----------
    names
        The leaf, or what acts on the body; several, if nothing tells them apart.
    gain
        How far chi-square would fall.
    values, errors
        What the numbers (n,) of the first would be, with standard errors: what is to be added to a
        leaf, as a part of it for `time_scale`. Of damping what is to be multiplied by a third of
        the trace of the inertia, 1/s if it is linear and 1/rad if it is quadratic.
    probability
        Of numbers as large as these by chance.
    moved
        Name of the number of the report that would move most, in standard errors.
    unit, shift
        Its unit, and how far it would move.
    relative
        The shift over the number.
    standard_errors
        The shift over the standard error of the number.
    """

    names: tuple[str, ...]
    gain: float
    values: np.ndarray
    errors: np.ndarray
    probability: float
    moved: str
    unit: str
    shift: float
    relative: float
    standard_errors: float

    @property
    def name(self) -> str:
        """The names, joined by "or"."""
        return " or ".join(self.names)

    @property
    def is_certain(self) -> bool:
        """Whether it cannot be chance."""
        return self.probability < CHANCE

    @property
    def matters(self) -> bool:
        """Whether it cannot be chance, and the intervals do not cover it."""
        return self.is_certain and abs(self.standard_errors) > MOVED

    def __str__(self) -> str:
        count = "1 number" if len(self.values) == 1 else f"{len(self.values)} numbers"
        words = f"freeing {_listed(self.names)} would lower chi-square by {self.gain:.4g} ({count})"
        if not self.moved:
            return words
        unit = "" if self.unit == "1" else f" {self.unit}"
        size = f"{self.shift:+.2g}{unit}"
        if "moment" in self.moved:
            size = f"{100 * self.relative:+.2g} %"
        errors = abs(self.standard_errors)
        return f"{words} and move the {self.moved}, by {size} ({errors:.2g} standard errors)"


def _listed(names: Sequence[str]) -> str:
    return " or ".join(f"`{name}`" for name in names)


def find_suspects(
    scored: Sequence[Scored],
    numbers: Numbers,
    errors: np.ndarray,
) -> tuple[Suspect, ...]:
    """Suspects with what they would do to numbers (n,) with such errors, the worst first.

    Probabilities are those among all suspects. Those with one gain are one.
    """
    judged = np.isfinite(errors) & (errors > 0)
    groups: list[list[Scored]] = []
    for each in scored:
        if groups and abs(each.gain - groups[-1][0].gain) <= ALIKE * groups[-1][0].gain:
            groups[-1].append(each)
        else:
            groups.append([each])
    found: list[Suspect] = []
    for group in groups:
        # Which of one gain is the first would be decided by rounding.
        each, *_ = alike = sorted(group, key=lambda of_group: of_group.name)
        shift = numbers.jacobian @ each.step
        ratio = np.where(judged, shift / np.where(judged, errors, 1), 0)
        i = int(np.argmax(abs(ratio))) if len(ratio) else -1
        moved = i >= 0 and judged[i]
        value = numbers.values[i] if moved else 0.0
        found.append(
            Suspect(
                names=tuple(suspect.name for suspect in alike),
                gain=each.gain,
                values=each.values,
                errors=each.errors,
                probability=min(1.0, each.probability * len(scored)),
                moved=numbers.names[i] if moved else "",
                unit=numbers.units[i] if moved else "",
                shift=float(shift[i]) if moved else 0.0,
                relative=float(shift[i] / value) if value else 0.0,
                standard_errors=float(ratio[i]) if moved else 0.0,
            )
        )
    return tuple(found)


def describe_suspects(suspects: Sequence[Suspect]) -> Iterator[str]:
    """Those that may be more than chance, and what else was tried."""
    if not suspects:
        yield "what the model may leave out could not be tried"
    by_chance = [each for each in suspects if each.probability >= NOTED]
    yield from (str(each) for each in suspects if each.probability < NOTED)
    if by_chance:
        names = ", ".join(_listed(each.names) for each in by_chance)
        yield f"freeing {names} would gain no more than chance"


def describe_trajectories(part: FittedPart) -> Iterator[str]:
    """The least and the largest chi-square of a trajectory, for each degree of freedom."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    judged = freedom > 0
    if np.sum(judged) < 2:
        return
    ratio = np.where(judged, chi_square / np.where(judged, freedom, 1), np.nan)
    least, most = np.nanargmin(ratio), np.nanargmax(ratio)
    names = part.recordings.names
    yield (
        f"chi-square of a trajectory for each degree of freedom: {ratio[least]:.3g} "
        f"(`{names[least]}`) to {ratio[most]:.3g} (`{names[most]}`)"
    )


def differ_in_size(part: FittedPart) -> bool:
    """Whether the residuals differ more from trajectory to trajectory than by chance."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    judged = freedom > 0
    if part.model.is_robust or np.sum(judged) < 2 or not np.sum(chi_square[judged]):
        return False
    chi_square, freedom = chi_square[judged], freedom[judged]
    mean = np.sum(chi_square) / np.sum(freedom)
    return bool(np.min(chdtrc(freedom, chi_square / mean)) * len(freedom) < CHANCE)
