"""The directions of the free leaves that are not observable, in words."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from ...modules.body import PhysicalRigidBody
from ..model.free import Free, inertia_and_derivative
from ..model.model import Model
from .information import Information
from .linear_span import basis, reduced
from .roughly_known import ENTRIES, Knowledge, describe_roughly_known, rotation_that_shows

SCALE = "overall scale of the inertia"
REMEDY = "a known torque or a rotor of known momentum would make it observable"
OTHER_REMEDY = "another motion"


class ScaleDirection(NamedTuple):
    """The direction that scales the inertia, where no residual depends on it."""

    theta: np.ndarray  # (p,)
    leaves: tuple[str, ...]  # other leaves that are proportional to the inertia in this direction

    def to_unit_trace(
        self, model: Model, free: Free, known: Information
    ) -> tuple[Model, Free, Information]:
        """Give the inertia unit trace by a change of the scale, which changes no residual."""
        size = float(np.trace(inertia_and_derivative(model, free)[0]))
        proportional = np.isin(free.leaves, self.leaves)
        # Coordinates of the inertia are logarithms.
        theta = np.where(proportional, free.theta / size, free.theta - np.log(size) * self.theta)
        free = free._replace(theta=theta)
        lengths = np.where(proportional, known.scale * size, known.scale)
        return free.model(model, theta), free, known._replace(scale=lengths)


def _unobservable_scale(free: Free, known: Information) -> ScaleDirection | None:
    """The direction of the scale of the inertia, if it is not observable."""
    if not free.scale_direction.any() or np.any(known.at_bound & (free.scale_direction != 0)):
        return None
    wanted, columns = known.along_observable(free.scale_direction), {}
    for leaf in dict.fromkeys(free.leaves):
        at = np.isin(free.leaves, leaf)
        if not free.of_body[at].any() and not known.at_bound[at].any():
            columns[leaf] = known.along_observable(np.where(at, free.theta, 0))

    def weights(leaves: list[str]) -> np.ndarray | None:
        """Factors on changes of some leaves that cancel a change of the scale, if there are."""
        table = np.array([columns[leaf] for leaf in leaves]).reshape(len(leaves), len(wanted)).T
        found = np.linalg.lstsq(table, -wanted)[0]
        missed = np.linalg.norm(table @ found + wanted)
        return (
            found if missed <= 1e-4 * np.linalg.norm(known.scale * free.scale_direction) else None
        )

    leaves = list(columns)
    for leaf in columns:  # as few as will do
        fewer = [other for other in leaves if other != leaf]
        leaves = leaves if weights(fewer) is None else fewer
    found = weights(leaves)
    if found is None or np.any(abs(found - 1) > 1e-3):
        return None
    direction = free.scale_direction + np.where(np.isin(free.leaves, leaves), free.theta, 0)
    return ScaleDirection(direction, tuple(leaves))


class Described(NamedTuple):
    """A model with its information; the inertia has unit trace if the scale is not observable."""

    model: Model
    free: Free
    information: Information
    unobservable: tuple[str, ...]  # directions in words, and what would make each observable
    scaled: tuple[str, ...]  # leaves that are known only as parts of the trace of the inertia


def describe(model: Model, estimate: Knowledge, elsewhere: Knowledge | None = None) -> Described:
    """Describe unobservable directions; give the inertia unit trace if its scale is one.

    Directions of the inertia that are known only roughly are among them; if another point fits as
    well as the estimate, they are judged there.
    """
    free, known = estimate.free, estimate.information
    words, scale = _in_words(model, free, known)
    words = *words, *describe_roughly_known(model, estimate, elsewhere)
    if scale is None:
        return Described(model, free, known, words, ())
    return Described(*scale.to_unit_trace(model, free, known), words, scale.leaves)


def _in_words(
    model: Model, free: Free, known: Information
) -> tuple[tuple[str, ...], ScaleDirection | None]:
    """The directions that are not observable, with what would make each so; and the scale's."""
    words: list[str] = []
    scale = _unobservable_scale(free, known)
    if scale is not None:
        together = f", together with `{'`, `'.join(scale.leaves)}`" if scale.leaves else ""
        words.append(f"{SCALE}{together}: {REMEDY}")
    return (*words, *_others(model, free, known, scale)), scale


def _others(
    model: Model, free: Free, known: Information, scale: ScaleDirection | None
) -> Iterator[str]:
    """Unobservable directions beside the scale, each with as few numbers as possible."""
    numbers = _numbers(model, free, known)
    names, units = numbers.names, numbers.units
    space = basis(units[:, None] * (numbers.jacobian @ known.null()))
    described = np.zeros((len(names), 0))
    if scale is not None:
        described = basis(units[:, None] * (numbers.jacobian @ scale.theta[:, None]))
    for i, (unit, name) in enumerate(zip(np.eye(len(names)), names, strict=True)):
        with_it = np.column_stack([described, unit])
        # Unobservable on its own, and not a consequence of the directions above.
        if np.linalg.norm(space.T @ unit) > 1 - 1e-6 and basis(with_it).shape == with_it.shape:
            described = with_it
            yield f"{name}: {numbers.remedy([i], unit)} would make it observable; otherwise fix it"
    given = basis(described)
    for row in reduced(basis(space - given @ (given.T @ space), 0.5).T):
        direction = row / units
        parts = direction / direction[np.argmax(abs(row))]
        large = np.flatnonzero(abs(row) > 0.05)
        sum_of = " ".join(f"{parts[i]:+.2g} {names[i]}" for i in large)
        remedy = numbers.remedy(large, direction)
        yield f"{sum_of}: {remedy} would make it observable; otherwise fix one of these"


class _Numbers(NamedTuple):
    """Numbers that the user knows, as linear functions of the free leaves."""

    names: list[str]
    units: np.ndarray  # of changes that matter alike
    jacobian: np.ndarray  # (numbers, p)
    remedies: list[str]  # empty for an entry of the inertia

    def remedy(self, large: Iterable[int], direction: np.ndarray) -> str:
        """What would make a direction (numbers,) observable, some of whose parts are large."""
        remedies = [
            self.remedies[i] or rotation_that_shows(direction[: len(ENTRIES)]) for i in large
        ]
        return " or ".join(dict.fromkeys(remedies))


def _numbers(model: Model, free: Free, known: Information) -> _Numbers:
    """The free leaves; for a physical body the entries of its inertia, as parts of the trace."""
    remedies = [remedy or OTHER_REMEDY for remedy in free.remedies]
    if not isinstance(model.body, PhysicalRigidBody) or not free.of_body.any():
        return _Numbers(list(free.names), known.scale, np.eye(len(free.names)), remedies)
    J, derivative = inertia_and_derivative(model, free)
    jacobian = derivative[tuple(zip(*ENTRIES.values(), strict=True))] / np.trace(J)
    others = np.flatnonzero(~free.of_body)
    return _Numbers(
        [f"inertia {entry}" for entry in ENTRIES] + [free.names[i] for i in others],
        np.append(np.full(len(ENTRIES), known.scale[free.of_body].max()), known.scale[others]),
        np.concatenate([jacobian, np.eye(len(free.theta))[others]]),
        [""] * len(ENTRIES) + [remedies[i] for i in others],
    )
