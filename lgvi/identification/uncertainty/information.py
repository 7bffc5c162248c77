"""Which directions of the free leaves are observable, and their covariance."""

from typing import NamedTuple

import numpy as np

from ..solver.elimination import BlockArrow, decompose, eliminate

NO_NOISE = 1e-12  # variance of whitened residuals below which they are rounding


class Information(NamedTuple):
    """The information on the free leaves, where all initial states are unknown too.

    The whitened Jacobian with columns of unit length is `u @ diag(singular) @ directions`, without
    the columns of leaves at a bound.
    """

    scale: np.ndarray  # (p,), lengths of the columns
    singular: np.ndarray  # (q,), falling
    directions: np.ndarray  # (q, p), rows
    at_bound: np.ndarray  # (p,)
    unobservable: np.ndarray  # (p,), direction that is unobservable exactly, or zero
    rank_tolerance: float  # singular values up to this count as zero
    rank: int  # number of observable unknowns, those of the initial states included
    null_directions: np.ndarray  # (n, p), which the residuals do not determine; a prior may
    unseen_local: np.ndarray  # (trajectories, m), unobservable local unknowns of this process
    # (trajectories, 3), body frame: axis of the only unobservable turn of the attitude, or zeros
    unseen_turn_axes: np.ndarray
    noise_directions: np.ndarray  # (n, p), along which the estimate is noise, whatever its errors

    @property
    def observable(self) -> np.ndarray:
        return self.singular > self.rank_tolerance

    def length(self, step: np.ndarray) -> float:
        """Length of a step of the free leaves (p,) in standard errors, for unit noise."""
        return float(np.linalg.norm(self.singular[self.observable] * self.along_observable(step)))

    def along_observable(self, step: np.ndarray) -> np.ndarray:
        """Parts of a step of the free leaves (p,) along the directions that are observable."""
        return self.directions[self.observable] @ (self.scale * step)

    def whiten(self, rows: np.ndarray) -> np.ndarray:
        """Rows (..., p) in coordinates (..., k) in which the covariance is 1 for unit noise.

        Directions that are not observable are left out.
        """
        observable = self.observable
        return (rows / self.scale) @ (self.directions[observable].T / self.singular[observable])

    def whiten_residuals(self, rows: np.ndarray) -> np.ndarray:
        """As `whiten`, for Jacobians of residuals, without their rounding along null directions."""
        rows, null = rows / self.scale, self.null_directions
        return self.whiten((rows - rows @ null.T @ null) * self.scale)

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
        """A covariance (m, m) of numbers, with infinite variance where one is not observable."""
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
        for direction in (self.unobservable, *self.noise_directions):
            exactly = abs(jacobian @ direction)
            unknown = unknown | (exactly > 1e-4 * (abs(jacobian) @ abs(direction)))
        return unknown


def compute_information(system: BlockArrow, at_bound: np.ndarray) -> Information:
    """The information of the linearised problem, whose initial states are eliminated."""
    eliminated = eliminate(system, 0)
    scale = system.lengths()
    unobservable = np.broadcast_to(system.unobservable, at_bound.shape)
    if at_bound[unobservable != 0].any():  # the leaves cannot change along the direction
        unobservable = np.zeros_like(unobservable)
    decomposed = decompose(system, eliminated, at_bound, scale)
    # A window that continues another window has as many gaps as unknowns.
    first = eliminated.order[0]
    triangles = eliminated.own[first, :, : system.unknowns]
    diagonal = abs(np.diagonal(triangles, axis1=1, axis2=2))
    unseen_local = diagonal <= system.rank_tolerance * system.own_lengths()[first]
    common_rank = np.sum(decomposed.singular > decomposed.rank_tolerance)
    rank = system.processes.sum(np.sum(~unseen_local)) + common_rank
    return Information(
        scale,
        decomposed.singular,
        decomposed.directions,
        at_bound,
        unobservable,
        decomposed.rank_tolerance,
        int(rank),
        decomposed.unseen,
        unseen_local,
        _unseen_turn_axes(triangles[:, :3, :3], unseen_local[:, :3]),
        np.zeros((0, len(scale))),
    )


def _unseen_turn_axes(triangles: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Null vectors of the triangles (n, 3, 3), or zeros unless just one turn is not observable."""
    axes, single = np.zeros((len(unseen), 3)), np.sum(unseen, axis=1) == 1
    if single.any():
        axes[single] = np.linalg.svd(triangles[single])[2][:, 2]
    return axes


def degrees_of_freedom(residuals: int, known: Information, prior: np.ndarray) -> float:
    """Number of residuals minus the number of observable unknowns that the residuals determine.

    `prior` (rows, p+1) are the rows of the prior, of which unknowns may be determined in part.
    """
    from_prior = np.sum(known.whiten(prior[:, :-1]) ** 2)  # unknowns that the prior determines
    return max(0.0, residuals - known.rank + float(from_prior))


def variance_factor(loss_sums: np.ndarray, count: int, freedom: float) -> float:
    r"""The factor on the covariance for unit noise, from sums of the losses (3,).

    Without robust losses it is the variance of the whitened residuals. With them it is
    $\overline{|\psi|^2}/\overline{\psi'}^2$ for $\psi = \rho' r$ (Huber & Ronchetti, "Robust
    Statistics", 2nd ed., 2009, section 7.6), times the slope in the linearised problem.
    `count` is the number of residuals. Infinite without degrees of freedom.
    """
    if freedom == 0:
        return np.inf
    squares, slopes, in_problem = loss_sums
    return squares / freedom * count * in_problem / slopes**2
