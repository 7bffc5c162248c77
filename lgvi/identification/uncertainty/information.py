"""Which directions of the free leaves are observable, and their covariance."""

from typing import NamedTuple

import numpy as np

from ..least_squares.block_arrow import BlockArrow, eliminate


class Information(NamedTuple):
    """The information on the free leaves, all initial states unknown.

    The whitened Jacobian with columns of unit length is `u @ diag(singular) @ directions`, without
    the columns of leaves at a bound.
    """

    scale: np.ndarray  # (p,), lengths of the columns
    singular: np.ndarray  # (q,), falling
    directions: np.ndarray  # (q, p), rows
    at_bound: np.ndarray  # (p,)
    unobservable: np.ndarray  # (p,), direction that is unobservable exactly, or zero
    zero: float  # singular values up to this count as zero
    rank: int  # number of observable unknowns, with those of the initial states

    @property
    def observable(self) -> np.ndarray:
        return self.singular > self.zero

    def length(self, step: np.ndarray) -> float:
        """Length of a step of the free leaves (p,) in standard errors, for unit noise."""
        return float(np.linalg.norm(self.singular[self.observable] * self.along_observable(step)))

    def along_observable(self, step: np.ndarray) -> np.ndarray:
        """Parts of a step of the free leaves (p,) along the directions that are observable."""
        return self.directions[self.observable] @ (self.scale * step)

    def whiten(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., p) in coordinates (..., k) in which the covariance is 1 for unit noise.

        Jacobians of numbers, and of residuals; what is not observable is left out.
        """
        observable = self.observable
        return (rows / self.scale) @ (self.directions[observable].T / self.singular[observable])

    def null(self) -> np.ndarray:
        """Directions that are not observable (p, directions)."""
        return (self.directions[~self.observable] / self.scale).T

    def singular_values(self) -> np.ndarray:
        """Singular values of the whitened Jacobian itself, its columns not scaled (q,), falling."""
        whitened = self.singular[:, None] * self.directions * self.scale
        return np.linalg.svd(whitened, compute_uv=False)

    def covariance(self) -> np.ndarray:
        """Covariance of the free leaves (p, p) in the observable directions, for unit noise."""
        root = self.whiten(np.eye(len(self.scale)))
        return root @ root.T

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Covariance (m, m) of numbers with a Jacobian (m, p) in the free leaves, for unit noise.

        A number that is not observable has infinite variance, and NaN for its covariances.
        """
        return self.without_unknown(jacobian, jacobian @ self.covariance() @ jacobian.T)

    def without_unknown(self, jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """A covariance (m, m) of numbers, with infinite variances of those not observable."""
        unknown, result = self.unknown(jacobian), covariance.copy()
        result[unknown] = result[:, unknown] = np.nan
        result[unknown, unknown] = np.inf
        return result

    def unknown(self, jacobian: np.ndarray) -> np.ndarray:
        """Whether numbers with a Jacobian (m, p) are not observable (m,)."""
        along = np.linalg.norm(
            (jacobian / self.scale) @ self.directions[~self.observable].T, axis=1
        )
        length = np.linalg.norm(jacobian / self.scale, axis=1)
        unknown = along > 1e-4 * length
        exactly = abs(jacobian @ self.unobservable)
        return unknown | (exactly > 1e-4 * (abs(jacobian) @ abs(self.unobservable)))


def compute_information(system: BlockArrow, at_bound: np.ndarray) -> Information:
    """Eliminate the initial states."""
    own, left, _, order = eliminate(system, 0)
    scale = system.lengths()
    unobservable = np.broadcast_to(system.unobservable, at_bound.shape)
    if at_bound[unobservable != 0].any():  # the leaves cannot change along it
        unobservable = np.zeros_like(unobservable)
    _, singular, of_free = np.linalg.svd((left[:, :-1] / scale)[:, ~at_bound])
    singular = np.pad(singular, (0, len(of_free) - len(singular)))
    directions = np.zeros((len(of_free), len(at_bound)))
    directions[:, ~at_bound] = of_free
    # A window that continues another one has as many gaps as unknowns.
    first = order[0]
    diagonal = abs(np.diagonal(own[first, :, : system.unknowns], axis1=1, axis2=2))
    rank = np.sum(diagonal > system.zero * system.own_lengths()[first]) + np.sum(
        singular > system.zero
    )
    return Information(scale, singular, directions, at_bound, unobservable, system.zero, int(rank))
