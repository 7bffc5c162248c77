"""Directions of the inertia that are known only roughly, and rotations that would show them."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from ..model.free import Free, inertias_and_derivatives
from .information import Information
from .linear_span import basis, reduced
from .noise import NO_NOISE

ENTRIES = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
LENGTH = np.sqrt([1, 1, 1, 2, 2, 2])  # of a unit change of each entry, as a matrix
# Entries of the inertias that are possible, as parts of the trace, scatter by about as much.
ROUGH = 0.15
SMALL = 1e-3  # part of a direction that is none


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
