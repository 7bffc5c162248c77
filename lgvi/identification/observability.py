"""Which directions of the free leaves the measurements determine, and names for the others."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .block_arrow import OWN, Rows, eliminated
from .model import Free, Model

SCALE = "overall scale of the inertia"
REMEDY = "a known torque or a rotor of known momentum would show it"


class Information(NamedTuple):
    """What is known of the free leaves when all initial states are unknown.

    The whitened Jacobian with columns of unit length is `u @ diag(singular) @ directions`, without
    the leaves that are held.
    """

    scale: np.ndarray  # (p,), lengths of the columns
    singular: np.ndarray  # (q,), falling
    directions: np.ndarray  # (q, p), rows
    held: np.ndarray  # (p,), at a bound
    zero: float  # singular values up to which are
    rank: int  # number of unknowns that are determined, initial states among them

    @property
    def observable(self) -> np.ndarray:
        return self.singular > self.zero

    def length(self, step: np.ndarray) -> float:
        """Length of a step of the free leaves (p,) in standard errors, for unit noise."""
        seen = self.observable
        return float(
            np.linalg.norm(self.singular[seen] * (self.directions[seen] @ (self.scale * step)))
        )

    def null(self) -> np.ndarray:
        """Directions that nothing depends on (p, directions)."""
        return (self.directions[~self.observable] / self.scale).T

    def singular_values(self) -> np.ndarray:
        """Of the whitened Jacobian itself, its columns not made of unit length (q,), falling."""
        whitened = self.singular[:, None] * self.directions * self.scale
        return np.linalg.svd(whitened, compute_uv=False)

    def covariance(self) -> np.ndarray:
        """Of the free leaves in the directions that are observable (p, p), for unit noise."""
        seen = self.observable
        root = self.directions[seen] / self.singular[seen, None] / self.scale
        return root.T @ root

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Of what has a Jacobian (m, p): infinite where not determined, and beside it no number."""
        result = jacobian @ self.covariance() @ jacobian.T
        along = np.linalg.norm(
            (jacobian / self.scale) @ self.directions[~self.observable].T, axis=1
        )
        length = np.linalg.norm(jacobian / self.scale, axis=1)
        unknown = along > 1e-4 * length
        result[unknown] = result[:, unknown] = np.nan
        result[unknown, unknown] = np.inf
        return result


def information(rows: Rows, held: np.ndarray) -> Information:
    """Eliminate the initial states."""
    own, left, order = eliminated(rows, 0)
    scale = rows.lengths()
    _, singular, of_free = np.linalg.svd((left[:, :-1] / scale)[:, ~held])
    singular = np.pad(singular, (0, len(of_free) - len(singular)))
    directions = np.zeros((len(of_free), len(held)))
    directions[:, ~held] = of_free
    # A window that continues another one has as many gaps as unknowns.
    first = order[0]
    diagonal = abs(np.diagonal(own[first, :, :OWN], axis1=1, axis2=2))
    rank = np.sum(diagonal > rows.zero * rows.own_lengths()[first]) + np.sum(singular > rows.zero)
    return Information(scale, singular, directions, held, rows.zero, int(rank))


class ScaleDirection(NamedTuple):
    """A direction in which the inertia only changes its size, and nothing measured changes."""

    theta: np.ndarray  # (p,)
    leaves: tuple[str, ...]  # that are proportional to the inertia

    def to_unit_trace(
        self, model: Model, free: Free, known: Information
    ) -> tuple[Model, Free, Information]:
        """Change the scale, which changes no residual, so that the inertia has unit trace."""
        size = float(jnp.trace(model.body.inertia))
        proportional = np.isin(free.leaves, self.leaves)
        # Coordinates of the inertia are logarithms.
        theta = np.where(proportional, free.theta / size, free.theta - np.log(size) * self.theta)
        free = free._replace(theta=theta)
        lengths = np.where(proportional, known.scale * size, known.scale)
        return free.model(model, jnp.asarray(theta)), free, known._replace(scale=lengths)


def _unobservable_scale(model: Model, free: Free, known: Information) -> ScaleDirection | None:
    """The direction of the scale of the inertia, if it is not observable."""

    def inertia(theta):
        return free.model(model, theta).body.inertia.ravel()

    theta, null = jnp.asarray(free.theta), known.null()
    if not null.size:
        return None
    jacobian = np.asarray(jax.jacfwd(inertia)(theta), float) @ null
    J = np.asarray(inertia(theta), float)
    weights = np.linalg.lstsq(jacobian, J)[0]
    if np.linalg.norm(jacobian @ weights - J) > 1e-3 * np.linalg.norm(J):
        return None
    direction, leaves = null @ weights, []
    for leaf in dict.fromkeys(free.leaves):
        at = np.array([name == leaf for name in free.leaves])
        if leaf.startswith("body"):
            continue
        if np.linalg.norm(known.scale[at] * direction[at]) < 1e-4 * np.linalg.norm(
            known.scale * direction
        ):
            direction[at] = 0
            continue
        error = known.scale[at] * (direction[at] - free.theta[at])
        if np.linalg.norm(error) > 1e-3 * np.linalg.norm(known.scale[at] * free.theta[at]):
            return None
        leaves.append(leaf)
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
    null, words = (known.scale[:, None] * known.null()), []
    scale = _unobservable_scale(model, free, known)
    if scale is not None:
        together = f", together with `{'`, `'.join(scale.leaves)}`" if scale.leaves else ""
        words.append(f"{SCALE}{together}: {REMEDY}")
        unit = known.scale * scale.theta / np.linalg.norm(known.scale * scale.theta)
        null -= np.outer(unit, unit @ null)
    left, singular, _ = np.linalg.svd(null, full_matrices=False)
    for direction in left[:, singular > 0.5].T:
        direction = direction / known.scale
        direction /= np.max(abs(direction))
        parts = [
            f"{part:+.2g} {name}"
            for name, part in zip(free.names, direction, strict=True)
            if abs(part) > 0.05
        ]
        words.append(f"{' '.join(parts)}: another motion would show it, or hold one of these")
    return tuple(words), scale
