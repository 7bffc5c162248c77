"""Suspects, which a model may leave out: the gain of freeing each by a score test, in words."""

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
from ..fit.problem import AbstractAtMinimum
from ..model.model import Model
from ..running.progress import show_progress
from ..segments.chain import Directions, Places, with_all_leaves
from ..segments.levels import whole_level
from ..solver.elimination import BlockArrow, Increment, solve
from ..solver.linearise import Linearised, join_parts, linearise_part
from ..uncertainty.information import NO_NOISE, compute_information
from ..uncertainty.report_table import ReportRows
from ..uncertainty.sandwich import LEAST_CLUSTERS, cluster_blocks, compute_sandwich

TIME_OFFSET, DRAG = "time_offset", "drag"  # leaves for which None is zero
# Leaves to which numbers can be added.
OF_SENSORS = (
    *("bias", "scale", "alignment", "position", "offset"),
    *("gravity_scale", "length_scale", DRAG),
)
LINEAR, QUADRATIC, TIME_SCALE = "linear damping", "quadratic drag", "time_scale"
DELAY = "rotor_delay"
CHANCE = 1e-3  # probability, at most, of a finding that is not taken for chance
NOTED = 0.05  # probability, at most, of a suspect that a report names
NOTHING = 1e-3  # standard errors by which a number does not move
MOVED = 1.0  # standard errors by which a suspect must move a number to matter
SAMPLE = 4  # size of the sample of trajectories, where there are many
ALIKE = 1e-6  # relative difference of gains between which the data do not decide


class Suspect(NamedTuple):
    """Something that the model may leave out, and the effect of freeing it, by a score test.

    Attributes
    ----------
    names
        The leaf, or what acts on the body; several names, if nothing tells these apart.
    gain
        The decrease of chi-square, of the trajectories on which it was tried.
    values, errors
        Estimates of the numbers (n,) of the first name, with standard errors: the change of a leaf,
        which is relative for `time_scale`. For damping the coefficient over a third of the trace of
        the inertia, 1/s if the damping is linear and 1/rad if it is quadratic.
    probability
        Of numbers as large as `values` by chance.
    moved
        Name of the number of the report that would move most, in standard errors.
    unit, shift
        The unit of this number, and how far the number would move.
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
        """Whether the gain cannot be chance."""
        return self.probability < CHANCE

    @property
    def matters(self) -> bool:
        """Whether the gain cannot be chance, and the intervals do not cover the shift."""
        return self.is_certain and abs(self.standard_errors) > MOVED

    def __str__(self) -> str:
        count = "1 number" if len(self.values) == 1 else f"{len(self.values)} numbers"
        words = f"freeing {_listed(self.names)} would lower chi-square by {self.gain:.4g} ({count})"
        if not self.moved:
            return words
        if abs(self.standard_errors) < NOTHING:
            return f"{words} and move no other number"
        unit = "" if self.unit == "1" else f" {self.unit}"
        size = f"{self.shift:+.2g}{unit}"
        if "moment" in self.moved:
            size = f"{100 * self.relative:+.2g} %"
        errors = abs(self.standard_errors)
        return f"{words} and move the {self.moved}, by {size} ({errors:.2g} standard errors)"


class LeftOut(NamedTuple):
    """Something that a model may leave out: a leaf of a sensor, or what acts on the body."""

    channel: str  # empty for what acts on the body
    leaf: str
    number: int  # size of the leaf

    @property
    def name(self) -> str:
        return f"{self.channel}.{self.leaf}" if self.channel else self.leaf

    def is_chosen(self, selected: Any) -> bool:
        """Whether the leaf is free; `selected` is a model with True for free leaves."""
        node = selected
        if self.channel:
            node = selected.sensors.get(self.channel)
        return any(jax.tree.leaves(getattr(node, self.leaf, None)))

    def directions(self, model: Model, places: Places) -> Directions:
        """The directions of the leaf's numbers, a column each; zero where a model has no such leaf.

        Parameters
        ----------
        model
            A model with all its leaves.
        places
            The places of these leaves.
        """
        directions = Directions(np.zeros((places.number, self.number)), np.zeros((2, self.number)))
        if self.leaf in (LINEAR, QUADRATIC):  # 1/s, or 1/rad
            directions.drag[int(self.leaf == QUADRATIC), 0] = 1
        elif self.leaf == TIME_SCALE:
            directions.leaves[places.part(TIME_SCALE), 0] = float(model.time_scale)
        elif self.leaf == DELAY:
            directions.leaves[places.rotor_delay, 0] = 1
        elif self.channel in model.sensors:
            at = places.leaf(self.channel, self.leaf)
            if len(at) == self.number:
                directions.leaves[at, np.arange(self.number)] = 1
        return directions


class Scored(NamedTuple):
    """The effect of freeing a suspect."""

    name: str
    gain: float  # decrease of chi-square
    values: np.ndarray  # (n,), estimates of the suspect's numbers
    errors: np.ndarray  # (n,), standard errors of the values
    probability: float  # of a number as large as one of the values by chance
    step: np.ndarray  # (p,), step of the free leaves


class ScoreTests(AbstractAtMinimum):
    """The score tests of all suspects, computed on first use."""

    number_tried = 0  # of trajectories, on which they are tried

    @property
    def not_tried(self) -> str:
        """Why suspects are not tried here, in words; empty if they are tried."""
        if any(part.recordings.are_stored for part in self.problem.configurations):
            return "recordings are in files"  # there may be too many recordings
        return "processes fit together" if self.problem.processes.are_several else ""

    @cached_property
    @show_progress("score tests")
    def found(self) -> list[Scored]:
        """The suspects that are observable, the largest gain first.

        The list is empty if suspects are not tried, whole trajectories cannot be simulated, or the
        size of the noise is not known. Leaves that are free are no suspects.
        """
        known = self.known
        if self.not_tried or not NO_NOISE < self.variance < np.inf:
            return []
        suspects = self._suspects()
        linearised = self._linearise(suspects)
        if not np.isfinite(linearised.cost):
            return []
        p, blocks, at_bound = len(known.scale), linearised.blocks, known.at_bound
        base = _part(linearised.system, np.arange(p))
        base_step, rank = solve(base, 0, at_bound), compute_information(base, at_bound).rank
        scored, end = [], p
        for suspect in suspects:
            end += suspect.number
            columns = np.concatenate([np.arange(p), np.arange(end - suspect.number, end)])
            system = _part(linearised.system, columns)
            bound = np.concatenate([at_bound, np.zeros(suspect.number, bool)])
            extended = compute_information(system, bound)
            if extended.rank < rank + suspect.number:
                continue
            step, m = solve(system, 0, bound), system.unknowns
            rows = None if blocks is None else blocks[..., [*range(m), *(m + columns), -1]]
            # The scatter is that of the residuals after the step.
            after, rows = _after(system, rows, step)
            gain = step.reduction - base_step.reduction
            left = self.variance * max(1 - gain / linearised.cost, 1e-12)
            clusters = cluster_blocks(after, rows, extended, LEAST_CLUSTERS)
            sandwich = compute_sandwich(clusters, extended, left, system.of_prior())
            numbers = np.eye(len(columns))[p:]
            values, errors = step.theta[p:], np.sqrt(np.diag(sandwich.covariance_of(numbers)))
            ratio = abs(values) / np.where(errors > 0, errors, np.inf)
            by_chance = 2 * stdtr(sandwich.freedom_of(numbers), -ratio)
            scored.append(
                Scored(
                    name=suspect.name,
                    gain=gain,
                    values=values,
                    errors=errors,
                    probability=min(1.0, suspect.number * float(np.min(by_chance))),
                    step=step.theta[:p] - base_step.theta,
                )
            )
        return sorted(scored, key=lambda suspect: -suspect.gain)

    def _linearise(self, suspects: Sequence[LeftOut]) -> Linearised:
        """The problem in its free leaves and in the numbers of suspects, about the estimate.

        Of a sample of the trajectories where there are many.
        """
        problem, parts = self.problem, []
        theta = problem.free.theta
        level = whole_level(problem.configurations, self.longest_steps)
        numbers = level.of_trajectories(level.sampled(SAMPLE))
        level, self.number_tried = level.only(numbers), len(numbers)
        states = self.states.at(numbers)
        for configuration, method, chains, part in zip(
            problem.configurations, problem.methods, level.chains, level.parts, strict=True
        ):
            at = configuration.at(problem.parameters, problem.free, theta)
            model = with_all_leaves(at).model
            places = Places.of_model(model)
            more = [suspect.directions(model, places) for suspect in suspects]
            more = reduce(Directions.followed_by, more)
            options = {"blocks": problem.blocks, "mesh": problem.mesh, "more": more}
            parts.append(linearise_part(at, states.at(part), chains, method, **options))
        others = sum(suspect.number for suspect in suspects)
        prior = problem.prior_rows(theta)
        prior = np.insert(prior, [theta.size] * others, 0, axis=1)
        linearised = join_parts(parts, np.pad(theta, (0, others)), prior)
        direction = np.pad(self.known.unobservable, (0, others))
        return linearised._replace(system=linearised.system.without(direction))

    def _suspects(self) -> tuple[LeftOut, ...]:
        """What the models may leave out: leaves that are neither free nor a trajectory's own."""
        configurations = self.problem.configurations
        has_rotor = any(part.recordings.rotor_momentum is not None for part in configurations)
        depends_on_time = has_rotor or any(
            part.model.torque is not None
            or part.recordings.body_torque is not None
            or part.recordings.rotor_speed is not None
            for part in configurations
        )
        chosen = [
            selected
            for part in configurations
            for selected in (part.selected, part.own)
            if selected is not None
        ]
        models = [part.model for part in configurations]
        return tuple(
            suspect
            for suspect in all_left_out(models, depends_on_time, has_rotor)
            if not any(suspect.is_chosen(selected) for selected in chosen)
        )


def find_suspects(
    scored: Sequence[Scored],
    numbers: ReportRows,
    errors: np.ndarray,
) -> tuple[Suspect, ...]:
    """Suspects with the shifts of the numbers (n,), whose `errors` are known; the worst first.

    Probabilities are those among all suspects. Suspects with the same gain are one suspect.
    """
    judged = np.isfinite(errors) & (errors > 0)
    groups: list[list[Scored]] = []
    for suspect in scored:
        if groups and abs(suspect.gain - groups[-1][0].gain) <= ALIKE * groups[-1][0].gain:
            groups[-1].append(suspect)
        else:
            groups.append([suspect])
    suspects: list[Suspect] = []
    for group in groups:
        # Of suspects with the same gain the first is by name, and not by rounding.
        first, *_ = alike = sorted(group, key=lambda suspect: suspect.name)
        shift = numbers.jacobian @ first.step
        ratio = np.where(judged, shift / np.where(judged, errors, 1), 0)
        i = int(np.argmax(abs(ratio))) if len(ratio) else -1
        moved = i >= 0 and judged[i]
        value = numbers.values[i] if moved else 0.0
        suspects.append(
            Suspect(
                names=tuple(suspect.name for suspect in alike),
                gain=first.gain,
                values=first.values,
                errors=first.errors,
                probability=min(1.0, first.probability * len(scored)),
                moved=numbers.names[i] if moved else "",
                unit=numbers.units[i] if moved else "",
                shift=float(shift[i]) if moved else 0.0,
                relative=float(shift[i] / value) if value else 0.0,
                standard_errors=float(ratio[i]) if moved else 0.0,
            )
        )
    return tuple(suspects)


def describe_suspects(suspects: Sequence[Suspect]) -> Iterator[str]:
    """Suspects that may be more than chance, and the names of all other suspects."""
    if not suspects:
        yield "what the model may leave out could not be tried"
    by_chance = [suspect for suspect in suspects if suspect.probability >= NOTED]
    yield from (str(suspect) for suspect in suspects if suspect.probability < NOTED)
    if by_chance:
        names = ", ".join(_listed(suspect.names) for suspect in by_chance)
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


def all_left_out(models: Iterable[Model], depends_on_time: bool, has_rotor: bool) -> list[LeftOut]:
    """All suspects of several models, which share them.

    Unless something that acts depends on time, time offsets are relative to the first sensor.
    """
    left_out: dict[LeftOut, None] = {}
    for model in models:
        first = None if depends_on_time else next(iter(model.sensors))
        for channel, sensor in model.sensors.items():
            leaves = OF_SENSORS if channel == first else (*OF_SENSORS, TIME_OFFSET)
            for leaf in leaves:
                if number := _number_of(sensor, leaf):
                    left_out[LeftOut(channel, leaf, number)] = None
    acting = [LeftOut("", leaf, 1) for leaf in (LINEAR, QUADRATIC, TIME_SCALE)]
    if has_rotor:
        acting.append(LeftOut("", DELAY, 1))
    return [*left_out, *acting]


def _number_of(sensor: AbstractSensor, leaf: str) -> int:
    """The size of a leaf of a sensor to which numbers can be added; 0 if there is no such leaf."""
    learnable = {field.name for field in fields(sensor) if not field.metadata.get("static")}
    learnable -= {*sensor.state_fields}
    value = getattr(sensor, leaf, None)
    if leaf not in learnable or not (value is None or eqx.is_inexact_array(value)):
        return 0
    return int(leaf in (TIME_OFFSET, DRAG)) if value is None else np.size(value)


def _after(
    system: BlockArrow, blocks: np.ndarray | None, step: Increment
) -> tuple[BlockArrow, np.ndarray | None]:
    """The system and its blocks of time, with the residuals after a step."""
    steps = np.column_stack([step.own, np.tile(step.theta, (len(step.own), 1))])

    def moved(rows: np.ndarray) -> np.ndarray:
        change = np.einsum("n...j,nj->n...", rows[..., :-1].astype(float), steps)
        return np.concatenate([rows[..., :-1], rows[..., -1:] + change[..., None]], axis=-1)

    blocks_after = None if blocks is None else moved(blocks)
    return system._replace(triangles=moved(system.triangles)), blocks_after


def _part(system: BlockArrow, columns: np.ndarray) -> BlockArrow:
    """The system with some of its common unknowns."""
    m = system.unknowns
    count = system.triangles.shape[2] - m - 1
    return BlockArrow(
        system.triangles[:, :, [*range(m), *(m + columns), -1]],
        prior=None if system.prior is None else system.prior[:, [*columns, -1]],
        sizes=np.broadcast_to(system.sizes, count)[columns],
        unobservable=np.broadcast_to(system.unobservable, count)[columns],
        unknowns=m,
    )


def _listed(names: Sequence[str]) -> str:
    return " or ".join(f"`{name}`" for name in names)
