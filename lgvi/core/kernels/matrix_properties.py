"""Properties of matrices (3, 3, ...) of JAX or NumPy, by component: cheap in a larger program."""

from functools import reduce
from operator import and_

import numpy as np


def is_rotation(R, tolerance):
    """Whether no entry of R^T R - I is above the tolerance, and the determinant is positive."""
    x, y, z = ([R[0, i], R[1, i], R[2, i]] for i in range(3))
    products = [(x, x, 1), (y, y, 1), (z, z, 1), (x, y, 0), (y, z, 0), (z, x, 0)]
    errors = (abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - wanted) for a, b, wanted in products)
    return reduce(and_, (error <= tolerance for error in errors)) & (determinant(R) > 0)


def is_symmetric(S):
    """Whether half of the digits are symmetric, relative to the diagonal."""
    size = abs(S[0, 0]) + abs(S[1, 1]) + abs(S[2, 2])
    tolerance = float(np.finfo(S.dtype).eps) ** 0.5 * size
    pairs = (0, 1), (1, 2), (2, 0)
    return reduce(and_, (abs(S[i, j] - S[j, i]) <= tolerance for i, j in pairs))


def is_positive_definite(S):
    """Whether the leading minors of a symmetric matrix are positive."""
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    S = S / trace[None, None]  # or a minor of a small body would underflow
    minors = S[0, 0], S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0], determinant(S)
    return reduce(and_, (x > 0 for x in (trace, *minors)))


def determinant(M):
    (a, b, c), (d, e, f), (g, h, i) = ([M[i, j] for j in range(3)] for i in range(3))
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
