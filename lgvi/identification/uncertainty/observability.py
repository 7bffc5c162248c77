"""Which directions of the free leaves are not observable, or only roughly known, in words."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from ...modules.body import PhysicalRigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..model.free_leaves import Free, bodies_in, inertias_and_derivatives
from .information import NO_NOISE, Information

# Indices of the entries of an inertia.
ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
LENGTH = np.sqrt([1, 1, 1, 2, 2, 2])  # Frobenius norm of a unit change of each entry
ROUGH = 0.15  # scatter of the entries of possible inertias, as parts of the trace
SMALL = 1e-3  # part of a direction that counts as zero
SCALE = "overall scale of the inertia"  # name of this direction
REMEDY_OF_SCALE = "a known torque or a rotor of known momentum"
OTHER_REMEDY = "another motion"  # for leaves without a remedy of their own
ALIKE = 0.01  # rad, between axes that count as one axis


class LinearPosterior(NamedTuple):
    """The distribution of the free leaves by the problem that is linearised about a point."""

    free: Free  # with the point
    information: Information
    variance: float  # the factor on the covariance for unit noise; infinite if it is not known


class Described(NamedTuple):
    """What `describe` returns; a model's inertia of unobservable scale has unit trace."""

    parameters: Any
    free: Free
    information: Information
    unobservable: tuple[str, ...]  # directions in words, and what would make each observable
    scaled: tuple[str, ...]  # leaves that are known only as parts of the trace of the inertia


class RoughlyKnown(NamedTuple):
    """A direction of an inertia that is known only roughly."""

    words: str
    theta: np.ndarray  # (p,), the direction of the free leaves


class ScaleDirection(NamedTuple):
    """The direction that scales the inertia, where no residual depends on the scale."""

    theta: np.ndarray  # (p,)
    leaves: tuple[str, ...]  # other leaves that are proportional to the inertia in this direction

    def to_unit_trace(
        self, parameters: Any, free: Free, known: Information
    ) -> tuple[Any, Free, Information]:
        """Give the inertia unit trace by a change of the scale, which changes no residual."""
        trace = float(np.trace(inertias_and_derivatives(parameters, free)[0][0]))
        proportional = np.isin(free.leaves, self.leaves)
        # Coordinates of the inertia are logarithms.
        theta = np.where(proportional, free.theta / trace, free.theta - np.log(trace) * self.theta)
        lower, upper, max_step = (
            np.where(proportional, limit / trace, limit)
            for limit in (free.lower, free.upper, free.max_step)
        )
        free = free._replace(theta=theta, lower=lower, upper=upper, max_step=max_step)
        lengths = np.where(proportional, known.scale * trace, known.scale)
        return free.put(parameters, theta), free, known._replace(scale=lengths)


def describe(
    parameters: Any,
    estimate: LinearPosterior,
    start_as_good: LinearPosterior | None = None,
    has_own: bool = False,
) -> Described:
    """Describe unobservable directions; give the inertia unit trace if its scale is one of them.

    The scale stays where trajectories have leaves of their own (`has_own`), which may have to
    change with the scale, unless nothing acts on the body, so that the scale changes alone.

    Directions of the inertia that are known only roughly are described too. If the inertia of the
    start fits as well as the estimate, they are those with large standard errors at the start.
    """
    free, known = estimate.free, estimate.information
    scales = find_unobservable_scales(free, known)
    rough = find_roughly_known(parameters, estimate, start_as_good)
    if start_as_good is not None:  # the estimate is noise along the rough directions
        noise = [direction.theta for direction in rough]
        known = known._replace(noise_directions=np.reshape(noise, (-1, len(free.theta))))
    words = (
        *(
            f"{scale}: {_remedy(directions)} would make it observable"
            for scale, directions in scales.items()
        ),
        *_others(parameters, free, known, scales.values()),
        *(direction.words for direction in rough),
    )
    alone = bool(known.unobservable.any())
    if not scales or any(body.name for body in free.bodies) or (has_own and not alone):
        return Described(parameters, free, known, words, ())
    (scale,) = scales.values()
    return Described(*scale.to_unit_trace(parameters, free, known), words, scale.leaves)


def _remedy(scale: ScaleDirection) -> str:
    """What makes a scale known; a mass too, if there is one in the direction."""
    return f"{'a known mass, ' * ('mass' in scale.leaves)}{REMEDY_OF_SCALE}"


def find_roughly_known(
    parameters: Any, estimate: LinearPosterior, start_as_good: LinearPosterior | None = None
) -> list[RoughlyKnown]:
    """Directions of inertias, as parts of their traces, with large standard errors.

    Directions that are not observable at the estimate are left out. If the inertia of the start
    fits as well as the estimate, the standard errors are those at the start.
    """
    posterior = start_as_good or estimate
    at_estimate = _parts(parameters, estimate.free)
    judged = at_estimate if start_as_good is None else _parts(parameters, start_as_good.free)
    roughly_known = []
    for body, parts, judged_parts in zip(estimate.free.bodies, at_estimate, judged, strict=True):
        null_parts = basis(parts @ estimate.information.null())
        errors = _errors(judged_parts, posterior)
        names = [body.label(f"inertia {entry}") for entry in ENTRIES]
        for row, error in _rough_directions(null_parts, errors):
            words = in_words(row / LENGTH, names)
            if start_as_good is None:
                words += f", which is known to {error:.1g} of the trace only"
            words += f": {rotation_that_shows(row / LENGTH)}, for long enough, would show it"
            entries = np.where(abs(row) < SMALL * np.max(abs(row)), 0, row)
            roughly_known.append(RoughlyKnown(words, np.linalg.pinv(parts) @ entries))
    return roughly_known


def describe_unseen_turns(turns: np.ndarray, R: np.ndarray) -> Iterator[str]:
    """Unobservable turns of initial attitudes R (trajectories, 3, 3), in words.

    `turns` (trajectories, 3) are their axes in the body frame, or zeros.
    """
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


def find_unobservable_scales(free: Free, known: Information) -> dict[str, ScaleDirection]:
    """Unobservable scales by their names: of each body, or else of all bodies together."""
    scales, common_scale = {}, free.scale_direction
    has_bodies_by_name = any(body.name for body in free.bodies)  # else there is one model
    for body in free.bodies if has_bodies_by_name else ():
        alone = _unobservable_scale(free, known, np.where(body.at, common_scale, 0), alone=True)
        if alone is not None:
            scales[f"{SCALE} of {body.name}"] = alone
    together = None if scales else _unobservable_scale(free, known, common_scale)
    if together is None:
        return scales
    words = "overall scale of all inertias" if has_bodies_by_name else SCALE
    leaves = f", together with `{'`, `'.join(together.leaves)}`" if together.leaves else ""
    return {words + leaves: together}


def _unobservable_scale(
    free: Free, known: Information, scale: np.ndarray, alone: bool = False
) -> ScaleDirection | None:
    """A direction `scale` of inertias, if it is not observable, alone or with other leaves."""
    if not scale.any() or np.any(known.at_bound & (scale != 0)):
        return None
    effect, effects = known.along_observable(scale), {}
    for leaf in dict.fromkeys(free.leaves):
        at = np.isin(free.leaves, leaf)
        if not alone and not free.of_body[at].any() and not known.at_bound[at].any():
            effects[leaf] = known.along_observable(np.where(at, free.theta, 0))

    def weights(leaves: list[str]) -> np.ndarray | None:
        """Factors on changes of leaves that cancel a change of the scale, or None."""
        table = np.array([effects[leaf] for leaf in leaves]).reshape(len(leaves), len(effect)).T
        factors = np.linalg.lstsq(table, -effect)[0]
        missed = np.linalg.norm(table @ factors + effect)
        return factors if missed <= 1e-4 * np.linalg.norm(known.scale * scale) else None

    leaves = list(effects)
    for leaf in effects:  # as few leaves as possible
        fewer = [other for other in leaves if other != leaf]
        leaves = leaves if weights(fewer) is None else fewer
    factors = weights(leaves)
    if factors is None or np.any(abs(factors - 1) > 1e-3):
        return None
    direction = scale + np.where(np.isin(free.leaves, leaves), free.theta, 0)
    return ScaleDirection(direction, tuple(leaves))


def _others(
    parameters: Any, free: Free, known: Information, scales: Iterable[ScaleDirection]
) -> Iterator[str]:
    """Unobservable directions other than the scales, each with as few numbers as possible."""
    numbers = _numbers(parameters, free, known)
    names, units = numbers.names, numbers.units
    space = basis(units[:, None] * (numbers.jacobian @ known.null()))
    scaling = np.array([scale.theta for scale in scales]).reshape(-1, len(free.theta))
    described = basis(units[:, None] * (numbers.jacobian @ scaling.T))
    for i, (unit, name) in enumerate(zip(np.eye(len(names)), names, strict=True)):
        extended = np.column_stack([described, unit])
        # Unobservable by itself, and not a consequence of the directions above.
        if np.linalg.norm(space.T @ unit) > 1 - 1e-6 and basis(extended).shape == extended.shape:
            described = extended
            yield f"{name}: {numbers.remedy([i], unit)} would make it observable; otherwise fix it"
    excluded = basis(described)
    for row in reduced(basis(space - excluded @ (excluded.T @ space), 0.5).T):
        direction = row / units
        parts = direction / direction[np.argmax(abs(row))]
        large = np.flatnonzero(abs(row) > 0.05)
        combination = " ".join(f"{parts[i]:+.2g} {names[i]}" for i in large)
        remedy = numbers.remedy(large, direction)
        yield f"{combination}: {remedy} would make it observable; otherwise fix one of these"


class _UserNumbers(NamedTuple):
    """Numbers that the user knows, as linear functions of the free leaves."""

    names: list[str]
    units: np.ndarray  # (numbers,), changes that matter alike
    jacobian: np.ndarray  # (numbers, p)
    # What makes each number observable; for an entry of an inertia the index of the first entry.
    remedies: list[str | int]

    def remedy(self, large: Iterable[int], direction: np.ndarray) -> str:
        """What would make a direction (numbers,) observable, whose parts `large` are large."""
        remedies = []
        for i in large:
            remedy = self.remedies[i]
            if isinstance(remedy, int):
                remedy = rotation_that_shows(direction[remedy : remedy + len(ENTRIES)])
            remedies.append(remedy)
        return " or ".join(dict.fromkeys(remedies))


def _numbers(parameters: Any, free: Free, known: Information) -> _UserNumbers:
    """The free leaves; for a physical body the entries of its inertia, as parts of the trace."""
    names: list[str] = []
    units, rows, remedies = [], [], []
    others = np.ones(len(free.theta), bool)
    bodies, entries = bodies_in(parameters), tuple(zip(*ENTRIES.values(), strict=True))
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
        rows.append(derivative[entries] / np.trace(J))
    names += [free.names[i] for i in np.flatnonzero(others)]
    remedies += [free.remedies[i] or OTHER_REMEDY for i in np.flatnonzero(others)]
    rows.append(np.eye(len(free.theta))[others])
    return _UserNumbers(
        names, np.append(units, known.scale[others]), np.concatenate(rows), remedies
    )


def _rough_directions(
    null_parts: np.ndarray, errors: np.ndarray
) -> Iterator[tuple[np.ndarray, float]]:
    """Rough directions of an inertia and their errors, from a square root of the covariance."""
    errors = errors - null_parts @ (null_parts.T @ errors)
    left, sizes, _ = np.linalg.svd(errors, full_matrices=False)
    for row in reduced(left[:, sizes > _bounded(ROUGH)].T):
        unit = row / np.linalg.norm(row)
        size = np.linalg.norm(unit @ errors)
        # By rounding the size of an unknown direction may be a little more than one.
        yield row, float(size / np.sqrt(max(1 - size**2, np.finfo(float).eps)))


def _parts(parameters: Any, free: Free) -> list[np.ndarray]:
    """For each body the derivative of the entries of its inertia as parts of the trace (6, p)."""
    parts_of_bodies, entries = [], tuple(zip(*ENTRIES.values(), strict=True))
    for J, derivative in zip(*inertias_and_derivatives(parameters, free), strict=True):
        trace = np.trace(J)
        parts = (derivative - J[..., None] * np.trace(derivative) / trace) / trace
        parts_of_bodies.append(parts[entries] * LENGTH[:, None])  # with the norm of the matrix
    return parts_of_bodies


def _errors(parts: np.ndarray, posterior: LinearPosterior) -> np.ndarray:
    """A square root (6, ...) of the covariance of the parts, each bounded as in `_bounded`."""
    information = posterior.information
    whitened = information.singular * information.observable
    whitened = whitened[:, None] * information.directions
    # Of a leaf on which no residual depends there is rounding alone, of any direction.
    whitened = whitened * (np.linalg.norm(whitened, axis=0) > information.rank_tolerance)
    whitened = whitened * information.scale
    if np.isfinite(posterior.variance):
        whitened = whitened / np.sqrt(max(posterior.variance, NO_NOISE))
    parts = parts * ~information.at_bound
    stacked = np.concatenate([whitened, parts])
    lengths = np.linalg.norm(stacked, axis=0)
    lengths[lengths == 0] = 1
    # A direction on which nothing depends has rounding alone, which must not be inverted.
    rounding = 10 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps)
    return (parts / lengths) @ np.linalg.pinv(stacked / lengths, rcond=max(1e-12, rounding))


def _bounded(error: float) -> float:
    """The standard error of a part that is known beforehand to be about 1 at most."""
    return error / np.sqrt(1 + error**2)


def basis(columns: np.ndarray, least: float = 1e-6) -> np.ndarray:
    """Orthonormal columns with the same span; singular values up to `least` count as zero."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > least]


def reduced(rows: np.ndarray) -> np.ndarray:
    """Rows with the same span: each has a 1, its largest entry, where all other rows have zeros."""
    rows, pivots = rows.copy(), np.zeros(len(rows), int)
    for i in range(len(rows)):
        pivots[i] = np.argmax(abs(rows[i]))
        rows[i] /= rows[i, pivots[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] -= rows[k, pivots[i]] * rows[i]
    return rows[np.argsort(pivots)]


def in_words(parts: np.ndarray, names: list[str]) -> str:
    """A sum of named numbers, with factors relative to the largest factor."""
    parts = parts / parts[np.argmax(abs(parts))]
    large = np.flatnonzero(abs(parts) > 0.05)
    if len(large) == 1:
        return names[int(large[0])]
    return " ".join(f"{parts[i]:+.2g} {names[i]}" for i in large)


def rotation_that_shows(entries: np.ndarray) -> str:
    r"""The rotation that shows best a change $\delta J$ of the inertia, given by its entries.

    A rotation at $\omega$ needs a torque that differs by $\omega \times \delta J\,\omega$. This
    is largest halfway between the axes of the largest and the smallest eigenvalue of $\delta J$.
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
