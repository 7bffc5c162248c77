"""The directions of the free leaves that are not observable, in words."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...modules.body import PhysicalRigidBody
from ..model.free import Free, inertia_and_derivative
from ..model.model import Model
from .information import Information

SCALE = "overall scale of the inertia"
REMEDY = "a known torque or a rotor of known momentum would make it observable"
OTHER_REMEDY = "another motion"
ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}


class ScaleDirection(NamedTuple):
    """A direction in which the inertia only changes its size, and nothing measured changes."""

    theta: np.ndarray  # (p,)
    leaves: tuple[str, ...]  # that are proportional to the inertia

    def to_unit_trace(
        self, model: Model, free: Free, known: Information
    ) -> tuple[Model, Free, Information]:
        """Change the scale, which changes no residual, so that the inertia has unit trace."""
        size = float(np.trace(inertia_and_derivative(model, free)[0]))
        proportional = np.isin(free.leaves, self.leaves)
        # Coordinates of the inertia are logarithms.
        theta = np.where(proportional, free.theta / size, free.theta - np.log(size) * self.theta)
        free = free._replace(theta=theta)
        lengths = np.where(proportional, known.scale * size, known.scale)
        return free.model(model, theta), free, known._replace(scale=lengths)


def _unobservable_scale(free: Free, known: Information) -> ScaleDirection | None:
    """The direction of the scale of the inertia, if it is not observable."""
    if not free.scale_direction.any() or np.any(known.held & (free.scale_direction != 0)):
        return None
    wanted, columns = known.seen(free.scale_direction), {}
    for leaf in dict.fromkeys(free.leaves):
        at = np.isin(free.leaves, leaf)
        if not free.of_body[at].any() and not known.held[at].any():
            columns[leaf] = known.seen(np.where(at, free.theta, 0))

    def weights(leaves: list[str]) -> np.ndarray | None:
        """How much leaves change for a change of the inertia that they hide, if they do."""
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
    """A model and what is known of it; of unit trace if the scale is not observable."""

    model: Model
    free: Free
    information: Information
    unobservable: tuple[str, ...]  # directions, in words, and what would show them
    scaled: tuple[str, ...]  # leaves that are known only as parts of the trace


def describe(model: Model, free: Free, known: Information) -> Described:
    """Say what is not observable, and give the inertia unit trace if its scale is not."""
    words, scale = _in_words(model, free, known)
    if scale is None:
        return Described(model, free, known, words, ())
    return Described(*scale.to_unit_trace(model, free, known), words, scale.leaves)


def _in_words(
    model: Model, free: Free, known: Information
) -> tuple[tuple[str, ...], ScaleDirection | None]:
    """The directions that are not observable, and what would show them; that of the scale."""
    words: list[str] = []
    scale = _unobservable_scale(free, known)
    if scale is not None:
        together = f", together with `{'`, `'.join(scale.leaves)}`" if scale.leaves else ""
        words.append(f"{SCALE}{together}: {REMEDY}")
    return (*words, *_others(model, free, known, scale)), scale


def _others(
    model: Model, free: Free, known: Information, scale: ScaleDirection | None
) -> Iterator[str]:
    """Directions that are not observable, but for the scale: as few numbers in each as can be."""
    numbers = _numbers(model, free, known)
    names, units = numbers.names, numbers.units
    space = _basis(units[:, None] * (numbers.jacobian @ known.null()))
    told = np.zeros((len(names), 0))
    if scale is not None:
        told = _basis(units[:, None] * (numbers.jacobian @ scale.theta[:, None]))
    for unit, name, remedy in zip(np.eye(len(names)), names, numbers.remedies, strict=True):
        with_it = np.column_stack([told, unit])
        # On its own, and not a consequence of what has been told.
        if np.linalg.norm(space.T @ unit) > 1 - 1e-6 and _basis(with_it).shape == with_it.shape:
            told = with_it
            yield f"{name}: {remedy} would make it observable; otherwise fix it"
    given = _basis(told)
    for row in _reduced(_basis(space - given @ (given.T @ space), 0.5).T):
        direction = row / units
        parts = direction / direction[np.argmax(abs(row))]
        large = np.flatnonzero(abs(row) > 0.05)
        sum_of = " ".join(f"{parts[i]:+.2g} {names[i]}" for i in large)
        remedies = " or ".join(dict.fromkeys(numbers.remedies[i] for i in large))
        yield f"{sum_of}: {remedies} would make it observable; otherwise fix one of these"


class _Numbers(NamedTuple):
    """Numbers that the user knows, as linear functions of the free leaves."""

    names: list[str]
    units: np.ndarray  # of changes that matter alike
    jacobian: np.ndarray  # (numbers, p)
    remedies: list[str]


def _numbers(model: Model, free: Free, known: Information) -> _Numbers:
    """The free leaves; but of a physical body the entries of its inertia, as parts of the trace."""
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
        [OTHER_REMEDY] * len(ENTRIES) + [remedies[i] for i in others],
    )


def _basis(columns: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """Orthonormal columns that span the same, but for what is shorter than `least`."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > least]


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Rows that span the same: each has a 1, the largest of it, where the others have zeros."""
    rows, pivots = rows.copy(), np.zeros(len(rows), int)
    for i in range(len(rows)):
        pivots[i] = np.argmax(abs(rows[i]))
        rows[i] /= rows[i, pivots[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] -= rows[k, pivots[i]] * rows[i]
    return rows[np.argsort(pivots)]
