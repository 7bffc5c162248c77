"""Free steps of many bodies and their gradients in long double, without the library.

F = (I + C)(I - C)^-1 for C = hat(c), with J c + c x J c = (1 + c.c) h pi / 2. Arrays have the
bodies first. Whether a solution is one is told by the equation of matrices,
F Jd - Jd F^T = h hat(pi).
"""

from typing import NamedTuple

import numpy as np

ITERATIONS = 60


class Steps(NamedTuple):
    """Solutions of the equation."""

    F: np.ndarray  # (bodies, 3, 3)
    c: np.ndarray  # (bodies, 3)
    inverse: np.ndarray  # of the derivative of the equation in c, for unit trace (bodies, 3, 3)
    residual: np.ndarray  # of the equation of matrices, over the trace (bodies,)


def matvec(M, v):
    return np.einsum("nij,nj->ni", M, v)


def hat(v):
    x, y, z = v.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)


def size(v):
    return np.sqrt(np.einsum("ni,ni->n", v, v))


def inverse_of(M):
    columns = [np.cross(M[:, i - 2], M[:, i - 1]) for i in range(3)]
    det = np.einsum("ni,ni->n", M[:, 0], columns[0])
    return np.stack(columns, 2) / det[:, None, None]


def cayley(c):
    C = hat(c)
    return np.eye(3) + (2 / (1 + size(c) ** 2))[:, None, None] * (C + C @ C)


def vee(S):
    return (
        np.stack([S[:, 2, 1] - S[:, 1, 2], S[:, 0, 2] - S[:, 2, 0], S[:, 1, 0] - S[:, 0, 1]], 1) / 2
    )


def left_side(F, J):
    """vee(F Jd - Jd F^T)"""
    S = F @ (np.trace(J, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - J)
    return vee(S - np.swapaxes(S, 1, 2))


def solve(pi, J, h):
    """The steps, by Newton's method with a search along the line; `h` is one number."""
    pi, J = (np.asarray(x, np.longdouble) for x in (pi, J))
    trace = np.trace(J, axis1=1, axis2=2)
    J, p = J / trace[:, None, None], np.longdouble(h) * pi / trace[:, None]

    def equation(c, J, p):
        Jc = matvec(J, c)
        return Jc + np.cross(c, Jc) - (1 + size(c) ** 2)[:, None] * p / 2

    def derivative(c, J, p):
        return J + hat(c) @ J - hat(matvec(J, c)) - p[:, :, None] * c[:, None, :]

    c = matvec(inverse_of(J), p) / 2
    left = np.arange(len(c))  # those that still improve
    for _ in range(ITERATIONS):
        own = c[left], J[left], p[left]
        value = equation(*own)
        step = -matvec(inverse_of(derivative(*own)), value)
        best, least = own[0].copy(), size(value)
        better = np.zeros(len(left), bool)
        for factor in (1, 0.5, 0.25, 0.1, 0.01):
            trial = own[0] + factor * step
            norm = size(equation(trial, *own[1:]))
            take = ~better & (norm < least)
            best[take], better = trial[take], better | take
        c[left] = best
        left = left[better]
        if len(left) == 0:
            break
    F = cayley(c)
    return Steps(F, c, inverse_of(derivative(c, J, p)), size(left_side(F, J) - p))


def gradients(steps, weights, pi, J, h):
    """Of sum(weights * F) in pi (bodies, 3) and J (bodies, 3, 3), which is not symmetrised."""
    F, c, inverse, _ = steps
    J = np.asarray(J, np.longdouble)
    trace = np.trace(J, axis1=1, axis2=2)
    M = np.swapaxes(F, 1, 2) @ weights
    axial = 2 * vee(M)
    square = 1 + size(c) ** 2
    # F^T dF = hat(2 (dc - c x dc) / (1 + c.c))
    of_c = 2 / square[:, None] * (axial - np.cross(axial, c))
    multiplier = matvec(np.swapaxes(inverse, 1, 2), of_c) / trace[:, None]
    of_pi = np.longdouble(h) * square[:, None] / 2 * multiplier
    of_J = -(multiplier + np.cross(multiplier, c))[:, :, None] * c[:, None, :]
    return of_pi, of_J
