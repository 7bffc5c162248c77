r"""Standard errors that hold where the noise of a cluster of residuals is not independent.

The sandwich estimator with the correction CR2, with which it is unbiased for white noise, and with
the degrees of freedom of its $t$ distribution after Satterthwaite: R. M. Bell & D. F. McCaffrey,
"Bias reduction in standard errors for linear regression with multi-stage samples", Survey
Methodology 28 (2002); J. E. Pustejovsky & E. Tipton, J. Bus. Econ. Stat. 36 (2018),
doi:10.1080/07350015.2016.1247004.

In coordinates in which the columns of the Jacobian of all residuals are orthonormal, cluster $i$
with rows $B_i$ and residuals $b_i$ moves the estimate by $\psi_i = B_i^T W_i b_i$, where
$W_i = (1 - B_i B_i^T)^{-1/2}$. A number with the gradient $c$ has variance $\sum_i (c^T\psi_i)^2$.
"""

from typing import NamedTuple

import numpy as np

from .clusters import Clusters
from .information import Information

FITTED = 1e-6  # part of the variance of a row that the fit leaves, if it is fitted exactly


class Sandwich(NamedTuple):
    """The sandwich estimator of the covariance of the free leaves."""

    information: Information
    variance: float  # the factor on the covariance for unit noise, of independent residuals
    influence: np.ndarray  # (clusters, k), psi
    pull: np.ndarray  # (clusters, k), the same with W = 1
    prior: np.ndarray  # (rows, k), of a prior, whose errors are known
    unchecked: np.ndarray  # (k, k), the part of the covariance that one cluster alone decides
    squares: np.ndarray  # (clusters, k, k), B^T W^2 B
    roots: np.ndarray  # (clusters, unknowns, k), B^T W B

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Covariance (m, m) of numbers with a Jacobian (m, p).

        What one cluster alone decides counts as if its residuals were independent.
        """
        gradients = self.information.whiten(jacobian)
        effects = self.influence @ gradients.T
        alone = gradients @ self.unchecked @ gradients.T
        return self.information.without_unknown(
            jacobian, effects.T @ effects + self.variance * alone
        )

    def freedom_of(self, jacobian: np.ndarray) -> np.ndarray:
        r"""Degrees of freedom of the variance of each number (m,), at least 1.

        Satterthwaite's: with the covariance $P$ of the $c^T\psi_i$ for white noise they are
        $(\operatorname{tr} P)^2/\operatorname{tr} P^2$. The part of the variance that is known,
        from a prior, has no error.
        """
        gradients = self.information.whiten(jacobian)
        known = self.variance * np.sum((gradients @ self.prior.T) ** 2, axis=1)
        whole = np.sum((self.influence @ gradients.T) ** 2, axis=0) + self.variance * np.einsum(
            "ij,jk,ik->i", gradients, self.unchecked, gradients
        )
        estimated = 1 - known / np.where(whole > 0, whole, 1)
        return self._freedom_of_scatter(gradients) / np.maximum(estimated, 1e-6) ** 2

    def _freedom_of_scatter(self, gradients: np.ndarray) -> np.ndarray:
        """Degrees of freedom of the part of the variance that comes from the scatter."""
        found = np.ones(len(gradients))
        for i, c in enumerate(gradients):
            own = np.einsum("nij,i,j->n", self.squares, c, c)
            shared = self.roots @ c
            lengths = np.sum(shared**2, axis=1)
            narrow = shared if len(shared) <= shared.shape[1] else shared.T
            trace = np.sum(own) - np.sum(lengths)
            of_square = np.sum(own**2 - 2 * own * lengths) + np.sum((narrow @ narrow.T) ** 2)
            of_prior = np.sum((self.prior @ c) ** 2)
            checked = trace / (c @ c - of_prior) if c @ c > of_prior else 0.0
            if checked > FITTED:
                found[i] = max(1.0, checked * trace**2 / of_square)
        return found


def compute_sandwich(
    clusters: Clusters, known: Information, variance: float, prior: np.ndarray | None = None
) -> Sandwich:
    """The estimator, from the rows of clusters at the minimum, and those of a prior (rows, p+1)."""
    rows, common = clusters.rows, clusters.rows[:, :, : clusters.common]
    left = np.eye(rows.shape[1]) - rows @ np.swapaxes(rows, 1, 2)
    of_row, axes = np.linalg.eigh(left)
    kept = of_row > FITTED
    power = np.where(kept, 1 / np.sqrt(np.where(kept, of_row, 1.0)), 0.0)
    # In the axes of what the fit leaves of the residuals.
    along, weighted = np.swapaxes(axes, 1, 2) @ common, power[:, :, None]
    seen = np.swapaxes(axes, 1, 2) @ clusters.residuals[:, :, None]
    influence = np.einsum("nrk,nr->nk", weighted * along, seen[:, :, 0])
    checked = np.einsum("nrj,nr,nrk->jk", along, kept.astype(float), along)
    return Sandwich(
        information=known,
        variance=variance,
        influence=influence,
        pull=np.einsum("nrk,nr->nk", common, clusters.residuals),
        prior=known.whiten(np.zeros((0, len(known.scale))) if prior is None else prior[:, :-1]),
        unchecked=np.eye(clusters.common) - checked,
        squares=np.einsum("nrj,nr,nrk->njk", along, power**2, along),
        roots=np.swapaxes(rows, 1, 2) @ axes @ (weighted * along),
    )
