"""The covariance from clusters of residuals, whose errors are independent of other clusters.

A cluster is a whole trajectory, or a block of time of a trajectory. The rows of a cluster are the
whitened Jacobian and the residuals, compressed by $QR$.
"""

from typing import NamedTuple

import numpy as np

from ..solver.elimination import BlockArrow, Eliminated, eliminate, triangularise
from .information import Information

LEAST_CLUSTERS = 16  # blocks of time in all trajectories together
MOST_OWN = 30  # windows of a trajectory whose states are separate unknowns
FITTED = 1e-6  # part of a row's variance that the fit leaves, below which the row is fitted exactly


class Clusters(NamedTuple):
    """Rows of clusters of residuals, at the minimum.

    The unknowns are in coordinates in which all rows together have orthonormal columns: first the
    coordinates of the observable free leaves, then those of the initial states, unless these are
    eliminated.
    """

    rows: np.ndarray  # (clusters, rows, unknowns)
    residuals: np.ndarray  # (clusters, rows)
    common: int  # number of coordinates of the free leaves


def cluster_trajectories(system: BlockArrow, known: Information) -> Clusters:
    """Each trajectory of all processes is a cluster; its initial state is eliminated."""
    left = system.processes.stack(eliminate(system, 0).of_trajectories)
    rows = known.whiten_residuals(left[:, :, :-1])
    return Clusters(rows, left[:, :, -1], rows.shape[2])


def cluster_blocks(
    system: BlockArrow,
    blocks: np.ndarray | None,
    known: Information,
    least: int,
    most_own: int = MOST_OWN,
) -> Clusters:
    """Clusters of blocks of time, at least `least` if there are as many blocks.

    `blocks` (windows, blocks, rows, m+p+1) make up the triangles of the windows; by default each
    window is one block. Initial states are unknowns like the free leaves: the information of one
    block on a state is in the residuals of the other blocks. Of a trajectory, the states of the
    first `most_own` windows are unknowns.
    """
    if system.processes.sum(system.trajectories) >= least:
        return cluster_trajectories(system, known)
    blocks = system.processes.stack(system.triangles[:, None] if blocks is None else blocks)
    system = system.of_all_processes()
    m = system.unknowns
    sensitivity, spread, trajectory = _solve_states(system, eliminate(system, 0), most_own)
    state_columns = blocks[..., :m].astype(float)
    common = known.whiten_residuals(blocks[..., m:-1] + state_columns @ sensitivity[:, None])
    residuals = blocks[..., -1:]
    trajectories = trajectory[-1] + 1
    widths = m * np.minimum(np.bincount(trajectory), most_own)
    most_blocks, unknowns = -(-least // trajectories), common.shape[-1]
    clusters = []
    for i in range(trajectories):
        mask = trajectory == i
        state_rows = state_columns[mask] @ spread[mask, None, :, : widths[i]]
        side_by_side = [common[mask], state_rows, residuals[mask]]
        block_rows = np.concatenate(side_by_side, axis=3)
        block_rows = block_rows.reshape(-1, *block_rows.shape[2:])  # block after block
        for part in np.array_split(block_rows, min(most_blocks, len(block_rows))):
            rows = triangularise(part.reshape(-1, part.shape[2]))
            clusters.append((i, rows))
    first = unknowns + np.cumsum(widths) - widths
    shape = len(clusters), max(len(rows) for _, rows in clusters), unknowns + np.sum(widths)
    padded_rows, padded_residuals = np.zeros(shape), np.zeros(shape[:2])
    for j, (i, rows) in enumerate(clusters):
        padded_rows[j, : len(rows), :unknowns] = rows[:, :unknowns]
        padded_rows[j, : len(rows), first[i] : first[i] + widths[i]] = rows[:, unknowns:-1]
        padded_residuals[j, : len(rows)] = rows[:, -1]
    return Clusters(padded_rows, padded_residuals, unknowns)


def _solve_states(
    system: BlockArrow, eliminated: Eliminated, most_own: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the states of windows in the unknowns, and the trajectory of each window.

    The derivatives are (windows, m, p) in the free leaves, and (windows, m, m * windows of a
    trajectory) in coordinates of unit covariance, m for each of the first windows of the
    trajectory. Coordinates of later windows are left out: as far as the gaps are closed, all
    states of a trajectory follow from the first.
    """
    triangles, order = eliminated.own, eliminated.order
    m = system.unknowns
    windows, most = len(triangles), min(len(order), most_own)
    position = system.positions
    sensitivity = np.zeros((windows, m, triangles.shape[2] - 2 * m - 1))
    spread = np.zeros((windows, m, m * most))
    for k, now in enumerate(order):
        coupling = triangles[now, :, m : 2 * m] if k else np.zeros((len(now), m, m))
        leaf_terms = triangles[now, :, 2 * m : -1] + coupling @ sensitivity[now - 1]
        noise_terms = coupling @ spread[now - 1]
        if k < most:
            noise_terms[:, :, m * k : m * (k + 1)] += np.eye(m)
        terms = np.concatenate([leaf_terms, noise_terms], axis=2)
        solution = -np.linalg.solve(triangles[now, :, :m], terms)
        sensitivity[now], spread[now] = np.split(solution, [sensitivity.shape[2]], axis=2)
    return sensitivity, spread, np.cumsum(position == 0) - 1


class Sandwich(NamedTuple):
    """The sandwich estimator; C, for unit noise, is the covariance of a cluster's residuals r."""

    information: Information
    variance: float  # the factor on the covariance for unit noise, of independent residuals
    influence: np.ndarray  # (clusters, k), psi = B^T W r, with W = C^(-1/2) and the rows B
    pull: np.ndarray  # (clusters, k), B^T r
    prior: np.ndarray  # (rows, k), whitened rows of a prior, whose errors are known
    unchecked: np.ndarray  # (k, k), part of the covariance that one cluster alone determines
    squares: np.ndarray  # (clusters, k, k), B^T W^2 B
    roots: np.ndarray  # (clusters, unknowns, k), B^T W B

    def covariance_of(self, jacobian: np.ndarray) -> np.ndarray:
        """Covariance (m, m) of numbers with a Jacobian (m, p).

        A part that one cluster alone determines is as for independent residuals.
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
        $(\operatorname{tr} P)^2/\operatorname{tr} P^2$. The part of the variance that a prior
        gives is known, and has no error.
        """
        gradients = self.information.whiten(jacobian)
        from_prior = self.variance * np.sum((gradients @ self.prior.T) ** 2, axis=1)
        total = np.sum((self.influence @ gradients.T) ** 2, axis=0) + self.variance * np.einsum(
            "ij,jk,ik->i", gradients, self.unchecked, gradients
        )
        estimated = 1 - from_prior / np.where(total > 0, total, 1)
        return self._freedom_of_scatter(gradients) / np.maximum(estimated, 1e-6) ** 2

    def _freedom_of_scatter(self, gradients: np.ndarray) -> np.ndarray:
        """Degrees of freedom of the part of the variance that the scatter determines."""
        freedom = np.ones(len(gradients))
        for i, c in enumerate(gradients):
            squares = np.einsum("nij,i,j->n", self.squares, c, c)
            shared = self.roots @ c
            lengths = np.sum(shared**2, axis=1)
            narrow = shared if len(shared) <= shared.shape[1] else shared.T
            trace = np.sum(squares) - np.sum(lengths)
            square = np.sum(squares**2 - 2 * squares * lengths) + np.sum((narrow @ narrow.T) ** 2)
            from_prior = np.sum((self.prior @ c) ** 2)
            checked = trace / (c @ c - from_prior) if c @ c > from_prior else 0.0
            if checked > FITTED:
                freedom[i] = max(1.0, checked * trace**2 / square)
        return freedom


def compute_sandwich(
    clusters: Clusters, known: Information, variance: float, prior: np.ndarray | None = None
) -> Sandwich:
    """The estimator from the rows of clusters at the minimum, and from a prior (rows, p+1)."""
    rows, common = clusters.rows, clusters.rows[:, :, : clusters.common]
    left = np.eye(rows.shape[1]) - rows @ np.swapaxes(rows, 1, 2)
    eigenvalues, axes = np.linalg.eigh(left)
    kept = eigenvalues > FITTED
    power = np.where(kept, 1 / np.sqrt(np.where(kept, eigenvalues, 1.0)), 0.0)
    # In the principal axes of the covariance of the residuals after the fit.
    along, weighted = np.swapaxes(axes, 1, 2) @ common, power[:, :, None]
    residuals = np.swapaxes(axes, 1, 2) @ clusters.residuals[:, :, None]
    influence = np.einsum("nrk,nr->nk", weighted * along, residuals[:, :, 0])
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
