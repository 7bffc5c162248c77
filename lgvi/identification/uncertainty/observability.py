"""Directions that recordings do not tell, or tell only roughly, in words."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from ...modules.body import PhysicalRigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..model.free_leaves import Free, bodies_in, inertias_and_derivatives
from .information import NO_NOISE, Information

ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
LENGTH = np.sqrt([1, 1, 1, 2, 2, 2])  # of a unit change of each entry, as a matrix
# Entries of the inertias that are possible, as parts of the trace, scatter by about as much.
ROUGH = 0.15
SMALL = 1e-3  # part of a direction that is none

SCALE = "overall scale of the inertia"
REMEDY_OF_SCALE = "a known torque or a rotor of known momentum"
OTHER_REMEDY = "another motion"

ALIKE = 0.01  # rad, between axes that count as one


def basis(columns: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """Orthonormal columns with the same span; singular values up to `least` count as zero."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > least]


def reduced(rows: np.ndarray) -> np.ndarray:
    """Rows with the same span: each has a 1, its largest entry, where the other rows have zeros."""
    rows, pivots = rows.copy(), np.zeros(len(rows), int)
    for i in range(len(rows)):
        pivots[i] = np.argmax(abs(rows[i]))
        rows[i] /= rows[i, pivots[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] -= rows[k, pivots[i]] * rows[i]
    return rows[np.argsort(pivots)]


class Knowledge(NamedTuple):
    """What is known of the free leaves about a point."""

    free: Free  # with the point
    information: Information
    variance: float  # the factor on the covariance for unit noise, infinite where not known


class RoughlyKnown(NamedTuple):
    """A direction of an inertia that is known only roughly."""

    words: str
    theta: np.ndarray  # (p,), the direction of the free leaves


def find_roughly_known(
    parameters: Any, estimate: Knowledge, elsewhere: Knowledge | None = None
) -> list[RoughlyKnown]:
    """Directions of inertias, as parts of their traces, with large standard errors.

    Beside those that are not observable at the estimate. If another point fits as well as the
    estimate, what is known is judged there.
    """
    judged = elsewhere or estimate
    here = _parts(parameters, estimate.free)
    there = here if elsewhere is None else _parts(parameters, elsewhere.free)
    found = []
    for body, parts, judged_parts in zip(estimate.free.bodies, here, there, strict=True):
        exactly = basis(parts @ estimate.information.null())
        errors = _errors(judged_parts, judged)
        names = [body.label(f"inertia {entry}") for entry in ENTRIES]
        for row, known in _of_body(exactly, errors):
            words = in_words(row / LENGTH, names)
            if elsewhere is None:
                words += f", which is known to {known:.1g} of the trace only"
            words += f": {rotation_that_shows(row / LENGTH)}, for long enough, would show it"
            of_entries = np.where(abs(row) < SMALL * np.max(abs(row)), 0, row)
            found.append(RoughlyKnown(words, np.linalg.pinv(parts) @ of_entries))
    return found


def _of_body(exactly: np.ndarray, errors: np.ndarray) -> Iterator[tuple[np.ndarray, float]]:
    """Directions of one inertia, from a square root of the covariance of its parts, with errors."""
    errors = errors - exactly @ (exactly.T @ errors)
    left, sizes, _ = np.linalg.svd(errors, full_matrices=False)
    for row in reduced(left[:, sizes > _bounded(ROUGH)].T):
        unit = row / np.linalg.norm(row)
        size = np.linalg.norm(unit @ errors)
        # Rounding may make the size of what is not known at all a little more than one.
        yield row, float(size / np.sqrt(max(1 - size**2, np.finfo(float).eps)))


def in_words(parts: np.ndarray, names: list[str]) -> str:
    """A sum of numbers with their names, relative to the largest."""
    parts = parts / parts[np.argmax(abs(parts))]
    large = np.flatnonzero(abs(parts) > 0.05)
    if len(large) == 1:
        return names[int(large[0])]
    return " ".join(f"{parts[i]:+.2g} {names[i]}" for i in large)


def rotation_that_shows(entries: np.ndarray) -> str:
    r"""The rotation that would show best a change $\delta J$ of the inertia with such entries.

    A rotation at $\omega$ needs a torque that differs by $\omega \times \delta J\,\omega$. It is
    largest halfway between the axes of the largest and the smallest eigenvalue of $\delta J$.
    """
    change = np.zeros((3, 3))
    for (i, j), entry in zip(ENTRIES.values(), entries, strict=True):
        change[i, j] = change[j, i] = entry
    _, axes = np.linalg.eigh(change)
    halfway: np.ndarray = np.array([axes[:, 2] + axes[:, 0], axes[:, 2] - axes[:, 0]]) / np.sqrt(2)
    sizes = np.round(abs(halfway), 6).tolist()  # so that rounding does not choose
    axis = halfway[max((0, 1), key=lambda i: (max(sizes[i]), sizes[i]))]
    first_large = np.argmax(abs(axis) > 0.9 * np.max(abs(axis)))
    axis = np.where(abs(axis) < 0.05, 0, axis * np.sign(axis[first_large]))
    words = ", ".join(f"{component:.2g}" for component in axis)
    return f"a rotation about the body axis ({words})"


def _parts(parameters: Any, free: Free) -> list[np.ndarray]:
    """For each body the derivative of the entries of its inertia as parts of the trace (6, p)."""
    found, at = [], tuple(zip(*ENTRIES.values(), strict=True))
    for J, derivative in zip(*inertias_and_derivatives(parameters, free), strict=True):
        trace = np.trace(J)
        parts = (derivative - J[..., None] * np.trace(derivative) / trace) / trace
        found.append(parts[at] * LENGTH[:, None])  # as a matrix's
    return found


def _bounded(error: float) -> float:
    """The standard error of a part of which nothing is known but that it is about 1 at most."""
    return error / np.sqrt(1 + error**2)


def _errors(parts: np.ndarray, known: Knowledge) -> np.ndarray:
    """A square root (6, ...) of the covariance of the parts, each bounded so."""
    information = known.information
    whitened = information.singular * information.observable
    whitened = whitened[:, None] * information.directions * information.scale
    if np.isfinite(known.variance):
        whitened = whitened / np.sqrt(max(known.variance, NO_NOISE))
    parts = parts * ~information.at_bound
    both = np.concatenate([whitened, parts])
    lengths = np.linalg.norm(both, axis=0)
    lengths[lengths == 0] = 1
    # A direction on which nothing depends has only rounding, which must not be inverted.
    rounding = 10 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps)
    return (parts / lengths) @ np.linalg.pinv(both / lengths, rcond=max(1e-12, rounding))


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


def describe_unseen_turns(turns: np.ndarray, R: np.ndarray) -> Iterator[str]:
    """Axes (trajectories, 3) in the body frame, or zeros, of attitudes R (trajectories, 3, 3)."""
    unseen = np.any(turns != 0, axis=1)
    if not unseen.any():
        return
    axes = np.einsum("nij,nj->ni", np.asarray(R, float)[unseen], turns[unseen])
    spread, directions = np.linalg.eigh(np.einsum("ni,nj->ij", axes, axes) / len(axes))
    axis = directions[:, -1] * np.copysign(1, directions[np.argmax(abs(directions[:, -1])), -1])
    about = "an axis of its own"
    if spread[-1] > 1 - ALIKE**2:
        about = f"({', '.join(f'{x + 0:.2f}' for x in np.round(axis, 2))}) of space"
    which = "" if unseen.all() else f" in {np.sum(unseen)} of {len(unseen)} trajectories"
    yield (
        f"turn of the initial attitude about {about}{which}: a sensor of attitudes, or of another "
        "direction, would make it observable"
    )
