"""The directions of the free leaves that are not observable, in words."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...modules.body import PhysicalRigidBody
from ..model.free import Free, inertia_and_derivative
from ..model.model import Model
from .information import Information

SCALE = "overall scale of the inertia"
REMEDY = "a known torque or a rotor of known momentum would show it"
REMEDIES = {
    "attitude.alignment": "a second sensor",
    "attitude.time_offset": "a second sensor",
    "gyroscope.alignment": "a second sensor",
    "gyroscope.time_offset": "a second sensor",
    "gyroscope.scale": "a sensor of attitudes, or a known torque,",
    "rotor_inertia": "a recorded rotor",
    "time_scale": "a gyroscope, or a known torque,",
}
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
    if not free.size.any() or np.any(known.held & (free.size != 0)):
        return None
    wanted, columns = known.seen(free.size), {}
    for leaf in dict.fromkeys(free.leaves):
        at = np.isin(free.leaves, leaf)
        if not leaf.startswith("body") and not known.held[at].any():
            columns[leaf] = known.seen(np.where(at, free.theta, 0))

    def weights(leaves: list[str]) -> np.ndarray | None:
        """How much leaves change for a change of the inertia that they hide, if they do."""
        table = np.array([columns[leaf] for leaf in leaves]).reshape(len(leaves), len(wanted)).T
        found = np.linalg.lstsq(table, -wanted)[0]
        missed = np.linalg.norm(table @ found + wanted)
        return found if missed <= 1e-4 * np.linalg.norm(known.scale * free.size) else None

    leaves = list(columns)
    for leaf in columns:  # as few as will do
        fewer = [other for other in leaves if other != leaf]
        leaves = leaves if weights(fewer) is None else fewer
    found = weights(leaves)
    if found is None or np.any(abs(found - 1) > 1e-3):
        return None
    direction = free.size + np.where(np.isin(free.leaves, leaves), free.theta, 0)
    return ScaleDirection(direction, tuple(leaves))


class Described(NamedTuple):
    """A model and what is known of it; of unit trace if the scale is not observable."""

    model: Model
    free: Free
    information: Information
    unobservable: tuple[str, ...]  # directions, in words, and what would show them
    scaled: tuple[str, ...]  # leaves that are known only as parts of the trace


def described(model: Model, free: Free, known: Information) -> Described:
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
    names, units, named = _named(model, free, known)
    space = _basis(units[:, None] * named(known.null()))
    told = np.zeros((len(names), 0))
    if scale is not None:
        told = _basis(units[:, None] * named(scale.theta[:, None]))
    for unit, name in zip(np.eye(len(names)), names, strict=True):
        with_it = np.column_stack([told, unit])
        # On its own, and not a consequence of what has been told.
        if np.linalg.norm(space.T @ unit) > 1 - 1e-6 and _basis(with_it).shape == with_it.shape:
            told = with_it
            yield f"{name}: {_remedy(name)} would show it, or hold it"
    given = _basis(told)
    for row in _reduced(_basis(space - given @ (given.T @ space), 0.5).T):
        direction = row / units
        parts = direction / direction[np.argmax(abs(row))]
        sum_of = [f"{part:+.2g} {names[i]}" for i, part in enumerate(parts) if abs(row[i]) > 0.05]
        remedies = dict.fromkeys(_remedy(names[i]) for i in np.flatnonzero(abs(row) > 0.05))
        yield f"{' '.join(sum_of)}: {' or '.join(remedies)} would show it, or hold one of these"


def _remedy(name: str) -> str:
    return REMEDIES.get(name.split("[")[0], "another motion")


def _named(model: Model, free: Free, known: Information):
    """Names of numbers, the units in which they matter alike, and a map from the free leaves.

    Of a physical body the numbers are the entries of its inertia, as parts of the trace.
    """
    of_body = np.array([leaf.startswith("body") for leaf in free.leaves])
    if not isinstance(model.body, PhysicalRigidBody) or not of_body.any():
        return free.names, known.scale, lambda theta: theta

    J, derivative = inertia_and_derivative(model, free)
    jacobian = derivative[tuple(zip(*ENTRIES.values(), strict=True))] / np.trace(J)
    others = np.flatnonzero(~of_body)
    names = [f"inertia {entry}" for entry in ENTRIES] + [free.names[i] for i in others]
    units = np.append(np.full(len(ENTRIES), known.scale[of_body].max()), known.scale[others])
    return names, units, lambda theta: np.concatenate([jacobian @ theta, theta[others]])


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
