"""Groups of residuals whose errors are independent of those of other groups.

A whole trajectory is one, or a block of time of a trajectory. The rows of a group are the whitened
Jacobian and the residuals, compressed by $QR$.
"""

from typing import NamedTuple

import numpy as np

from ..solver.elimination import BlockArrow, Eliminated, eliminate, triangularise
from .information import Information

LEAST_CLUSTERS = 16  # blocks of time, in all trajectories
MOST_OWN = 30  # windows of a trajectory whose states are unknowns of their own

FITTED = 1e-6  # part of the variance of a row that the fit leaves, if it is fitted exactly


class Clusters(NamedTuple):
    """Rows of groups of residuals, at the minimum.

    The unknowns are in coordinates in which all rows together have orthonormal columns: first
    those of the free leaves that are observable, then those of the initial states, if these are
    not eliminated.
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
    """Blocks of time are clusters, at least so many if there are as many.

    `blocks` (windows, blocks, rows, m+p+1) are those of which the triangles of the windows are
    made; by default each window is one. Initial states are unknowns like the free leaves: what one
    block tells of them is in the residuals of the others. Of a trajectory, the states of the first
    `most_own` windows are unknowns.
    """
    if system.processes.sum(system.trajectories) >= least:
        return cluster_trajectories(system, known)
    blocks = system.processes.stack(system.triangles[:, None] if blocks is None else blocks)
    system = system.of_all_processes()
    m = system.unknowns
    sensitivity, spread, trajectory = _solve_states(system, eliminate(system, 0), most_own)
    of_states = blocks[..., :m].astype(float)
    common = known.whiten_residuals(blocks[..., m:-1] + of_states @ sensitivity[:, None])
    residuals = blocks[..., -1:]
    number = trajectory[-1] + 1
    widths = m * np.minimum(np.bincount(trajectory), most_own)
    wanted, unknowns = -(-least // number), common.shape[-1]
    clusters = []
    for i in range(number):
        of_trajectory = trajectory == i
        own = of_states[of_trajectory] @ spread[of_trajectory, None, :, : widths[i]]
        side_by_side = [common[of_trajectory], own, residuals[of_trajectory]]
        of_blocks = np.concatenate(side_by_side, axis=3)
        of_blocks = of_blocks.reshape(-1, *of_blocks.shape[2:])  # block after block
        for part in np.array_split(of_blocks, min(wanted, len(of_blocks))):
            rows = triangularise(part.reshape(-1, part.shape[2]))
            clusters.append((i, rows))
    first = unknowns + np.cumsum(widths) - widths
    shape = len(clusters), max(len(rows) for _, rows in clusters), unknowns + np.sum(widths)
    found, sides = np.zeros(shape), np.zeros(shape[:2])
    for j, (i, rows) in enumerate(clusters):
        found[j, : len(rows), :unknowns] = rows[:, :unknowns]
        found[j, : len(rows), first[i] : first[i] + widths[i]] = rows[:, unknowns:-1]
        sides[j, : len(rows)] = rows[:, -1]
    return Clusters(found, sides, unknowns)


def _solve_states(
    system: BlockArrow, eliminated: Eliminated, most_own: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How the states of windows depend on the unknowns, and the trajectory of each window.

    Their derivatives (windows, m, p) in the free leaves, and (windows, m, m * windows of a
    trajectory) in coordinates of unit covariance, m for each of the first windows of the
    trajectory. Those of later windows are left out: as far as the gaps are closed, all states of
    a trajectory follow from the first.
    """
    own, order = eliminated.own, eliminated.order
    m = system.unknowns
    windows, most = len(own), min(len(order), most_own)
    position = system.positions
    sensitivity = np.zeros((windows, m, own.shape[2] - 2 * m - 1))
    spread = np.zeros((windows, m, m * most))
    for k, now in enumerate(order):
        before = own[now, :, m : 2 * m] if k else np.zeros((len(now), m, m))
        of_leaves = own[now, :, 2 * m : -1] + before @ sensitivity[now - 1]
        of_noise = before @ spread[now - 1]
        if k < most:
            of_noise[:, :, m * k : m * (k + 1)] += np.eye(m)
        found = -np.linalg.solve(own[now, :, :m], np.concatenate([of_leaves, of_noise], axis=2))
        sensitivity[now], spread[now] = np.split(found, [sensitivity.shape[2]], axis=2)
    return sensitivity, spread, np.cumsum(position == 0) - 1


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
