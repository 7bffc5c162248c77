"""Bases of a linear span."""

import numpy as np


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
