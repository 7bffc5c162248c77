"""Which directions of the free leaves the measurements determine, and how well."""

from typing import NamedTuple

import numpy as np

from ..least_squares.block_arrow import OWN, BlockArrow, eliminate


class Information(NamedTuple):
    """What is known of the free leaves when all initial states are unknown.

    The whitened Jacobian with columns of unit length is `u @ diag(singular) @ directions`, without
    the leaves that are held.
    """

    scale: np.ndarray  # (p,), lengths of the columns
    singular: np.ndarray  # (q,), falling
    directions: np.ndarray  # (q, p), rows
    held: np.ndarray  # (p,), at a bound
    unseen: np.ndarray  # (p,), a direction that nothing depends on by theory, or zero
    zero: float  # singular values up to which are
    rank: int  # number of unknowns that are determined, initial states among them

    @property
    def observable(self) -> np.ndarray:
        return self.singular > self.zero

    def length(self, step: np.ndarray) -> float:
        """Length of a step of the free leaves (p,) in standard errors, for unit noise."""
        return float(np.linalg.norm(self.singular[self.observable] * self.seen(step)))

    def seen(self, step: np.ndarray) -> np.ndarray:
        """Parts of a step of the free leaves (p,) along the directions that are observable."""
        return self.directions[self.observable] @ (self.scale * step)

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
        unknown |= abs(jacobian @ self.unseen) > 1e-4 * (abs(jacobian) @ abs(self.unseen))
        result[unknown] = result[:, unknown] = np.nan
        result[unknown, unknown] = np.inf
        return result


def compute_information(system: BlockArrow, held: np.ndarray) -> Information:
    """Eliminate the initial states."""
    own, left, order = eliminate(system, 0)
    scale = system.lengths()
    unseen = np.broadcast_to(system.unseen, held.shape)
    if held[unseen != 0].any():  # the others cannot change along it
        unseen = np.zeros_like(unseen)
    _, singular, of_free = np.linalg.svd((left[:, :-1] / scale)[:, ~held])
    singular = np.pad(singular, (0, len(of_free) - len(singular)))
    directions = np.zeros((len(of_free), len(held)))
    directions[:, ~held] = of_free
    # A window that continues another one has as many gaps as unknowns.
    first = order[0]
    diagonal = abs(np.diagonal(own[first, :, :OWN], axis1=1, axis2=2))
    rank = np.sum(diagonal > system.zero * system.own_lengths()[first]) + np.sum(
        singular > system.zero
    )
    return Information(scale, singular, directions, held, unseen, system.zero, int(rank))
