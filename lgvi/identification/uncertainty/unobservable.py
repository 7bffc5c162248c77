"""The directions of the free leaves that are not observable, in words."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ...modules.body import PhysicalRigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..model.bodies import bodies_in
from ..model.free import Free, inertias_and_derivatives
from .information import Information
from .linear_span import basis, reduced
from .roughly_known import ENTRIES, Knowledge, find_roughly_known, rotation_that_shows

SCALE = "overall scale of the inertia"
REMEDY_OF_SCALE = "a known torque or a rotor of known momentum"
OTHER_REMEDY = "another motion"


class ScaleDirection(NamedTuple):
    """The direction that scales the inertia, where no residual depends on it."""

    theta: np.ndarray  # (p,)
    leaves: tuple[str, ...]  # other leaves that are proportional to the inertia in this direction

    def to_unit_trace(
        self, parameters: Any, free: Free, known: Information
    ) -> tuple[Any, Free, Information]:
        """Give the inertia unit trace by a change of the scale, which changes no residual."""
        size = float(np.trace(inertias_and_derivatives(parameters, free)[0][0]))
        proportional = np.isin(free.leaves, self.leaves)
        # Coordinates of the inertia are logarithms.
        theta = np.where(proportional, free.theta / size, free.theta - np.log(size) * self.theta)
        free = free._replace(theta=theta)
        lengths = np.where(proportional, known.scale * size, known.scale)
        return free.put(parameters, theta), free, known._replace(scale=lengths)


def _unobservable_scale(
    free: Free, known: Information, scale: np.ndarray, alone: bool = False
) -> ScaleDirection | None:
    """A direction `scale` of inertias, if it is not observable: alone, or with other leaves."""
    if not scale.any() or np.any(known.at_bound & (scale != 0)):
        return None
    wanted, columns = known.along_observable(scale), {}
    for leaf in dict.fromkeys(free.leaves):
        at = np.isin(free.leaves, leaf)
        if not alone and not free.of_body[at].any() and not known.at_bound[at].any():
            columns[leaf] = known.along_observable(np.where(at, free.theta, 0))

    def weights(leaves: list[str]) -> np.ndarray | None:
        """Factors on changes of some leaves that cancel a change of the scale, if there are."""
        table = np.array([columns[leaf] for leaf in leaves]).reshape(len(leaves), len(wanted)).T
        found = np.linalg.lstsq(table, -wanted)[0]
        missed = np.linalg.norm(table @ found + wanted)
        return found if missed <= 1e-4 * np.linalg.norm(known.scale * scale) else None

    leaves = list(columns)
    for leaf in columns:  # as few as will do
        fewer = [other for other in leaves if other != leaf]
        leaves = leaves if weights(fewer) is None else fewer
    found = weights(leaves)
    if found is None or np.any(abs(found - 1) > 1e-3):
        return None
    direction = scale + np.where(np.isin(free.leaves, leaves), free.theta, 0)
    return ScaleDirection(direction, tuple(leaves))


class Described(NamedTuple):
    """Parameters with the information; the inertia of a model has unit trace if its scale is not
    observable."""

    parameters: Any
    free: Free
    information: Information
    unobservable: tuple[str, ...]  # directions in words, and what would make each observable
    scaled: tuple[str, ...]  # leaves that are known only as parts of the trace of the inertia


def describe(
    parameters: Any,
    estimate: Knowledge,
    elsewhere: Knowledge | None = None,
    has_own: bool = False,
) -> Described:
    """Describe unobservable directions; give the inertia unit trace if its scale is one.

    Not so where trajectories have leaves of their own (`has_own`), which may have to change with
    the scale, unless nothing acts on the body, so that the scale is alone.

    Directions of the inertia that are known only roughly are among them; if another point fits as
    well as the estimate, they are judged there.
    """
    free, known = estimate.free, estimate.information
    scales = _unobservable_scales(free, known)
    rough = find_roughly_known(parameters, estimate, elsewhere)
    if elsewhere is not None:  # the estimate is noise along these
        known = known._replace(
            lost=np.array([each.theta for each in rough]).reshape(-1, len(free.theta))
        )
    words = (
        *(f"{scale}: {REMEDY_OF_SCALE} would make it observable" for scale in scales),
        *_others(parameters, free, known, scales.values()),
        *(each.words for each in rough),
    )
    alone = bool(known.unobservable.any())
    if not scales or any(body.name for body in free.bodies) or (has_own and not alone):
        return Described(parameters, free, known, words, ())
    (scale,) = scales.values()
    return Described(*scale.to_unit_trace(parameters, free, known), words, scale.leaves)


def _unobservable_scales(free: Free, known: Information) -> dict[str, ScaleDirection]:
    """Of each body, or of all together, by its words."""
    found, of_all = {}, free.scale_direction
    several = any(body.name for body in free.bodies)  # else it is that of a model
    for body in free.bodies if several else ():
        alone = _unobservable_scale(free, known, np.where(body.at, of_all, 0), alone=True)
        if alone is not None:
            found[f"{SCALE} of {body.name}"] = alone
    together = None if found else _unobservable_scale(free, known, of_all)
    if together is None:
        return found
    words = "overall scale of all inertias" if several else SCALE
    leaves = f", together with `{'`, `'.join(together.leaves)}`" if together.leaves else ""
    return {words + leaves: together}


def _others(
    parameters: Any, free: Free, known: Information, scales: Iterable[ScaleDirection]
) -> Iterator[str]:
    """Unobservable directions beside the scales, each with as few numbers as possible."""
    numbers = _numbers(parameters, free, known)
    names, units = numbers.names, numbers.units
    space = basis(units[:, None] * (numbers.jacobian @ known.null()))
    given = np.array([scale.theta for scale in scales]).reshape(-1, len(free.theta))
    described = basis(units[:, None] * (numbers.jacobian @ given.T))
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
    # What makes each observable; for an entry of an inertia the index of the first one of it.
    remedies: list[str | int]

    def remedy(self, large: Iterable[int], direction: np.ndarray) -> str:
        """What would make a direction (numbers,) observable, some of whose parts are large."""
        found = []
        for i in large:
            remedy = self.remedies[i]
            if isinstance(remedy, int):
                remedy = rotation_that_shows(direction[remedy : remedy + len(ENTRIES)])
            found.append(remedy)
        return " or ".join(dict.fromkeys(found))


def _numbers(parameters: Any, free: Free, known: Information) -> _Numbers:
    """The free leaves; for a physical body the entries of its inertia, as parts of the trace."""
    names: list[str] = []
    units, rows, remedies = [], [], []
    others = np.ones(len(free.theta), bool)
    bodies, at = bodies_in(parameters), tuple(zip(*ENTRIES.values(), strict=True))
    for body, J, derivative in zip(
        free.bodies, *inertias_and_derivatives(parameters, free), strict=True
    ):
        if not isinstance(bodies[body.position], (PhysicalRigidBody, KnownAxesRigidBody)):
            continue
        others &= ~body.at
        unit = known.scale[body.at].max()
        remedies += [len(names)] * len(ENTRIES)
        names += [body.label(f"inertia {entry}") for entry in ENTRIES]
        units += [unit] * len(ENTRIES)
        rows.append(derivative[at] / np.trace(J))
    names += [free.names[i] for i in np.flatnonzero(others)]
    remedies += [free.remedies[i] or OTHER_REMEDY for i in np.flatnonzero(others)]
    rows.append(np.eye(len(free.theta))[others])
    return _Numbers(names, np.append(units, known.scale[others]), np.concatenate(rows), remedies)
