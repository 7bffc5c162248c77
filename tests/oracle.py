"""The discrete Moser-Veselov step in another chart, by another solver, in NumPy.

With F = Exp(g), a = sin|g|/|g| and b = (1 - cos|g|)/|g|^2 the equation is
a J g + b g x J g = h pi.
"""

import numpy as np

from .systems import hat


def rotation_of_vector(g):
    angle = np.linalg.norm(g)
    G = hat(g)
    return np.eye(3) + np.sinc(angle / np.pi) * G + _versine(angle) * G @ G


def oracle_F(pi, J, h):
    """F of one free step, to rounding; raises if Newton's iteration finds no root."""
    pi, J = np.asarray(pi, float), np.asarray(J, float)
    scale = np.trace(J)
    J, p = J / scale, float(h) * pi / scale
    g = np.linalg.solve(J, p)
    value = _equation(g, J, p)
    for _ in range(60):
        step = np.linalg.solve(_jacobian(g, J), -value)
        factor = 1.0
        while factor > 1e-6:
            trial = _equation(g + factor * step, J, p)
            if np.linalg.norm(trial) < np.linalg.norm(value):
                break
            factor /= 2
        else:
            break  # no descent: rounding, or no root
        g, value = g + factor * step, trial
    if np.linalg.norm(value) > 1e-14 * np.linalg.norm(p) + 1e-16 * np.linalg.norm(g):
        raise ArithmeticError("The discrete Moser-Veselov equation has no root here.")
    return rotation_of_vector(g)


def oracle_step(R, pi, J, torque_k, torque_next, h):
    """Half impulse, free step, half impulse."""
    pi = pi + h / 2 * np.asarray(torque_k)
    F = oracle_F(pi, J, h)
    return R @ F, F.T @ pi + h / 2 * np.asarray(torque_next)


def _versine(angle):
    """(1 - cos angle)/angle^2 without cancellation."""
    return np.sinc(angle / (2 * np.pi)) ** 2 / 2


def _equation(g, J, p):
    angle, Jg = np.linalg.norm(g), J @ g
    return np.sinc(angle / np.pi) * Jg + _versine(angle) * np.cross(g, Jg) - p


def _jacobian(g, J):
    t, Jg = np.linalg.norm(g), J @ g
    if t < 1e-2:
        da, db = -1 / 3 + t**2 / 30, -1 / 12 + t**2 / 180
    else:
        da = (t * np.cos(t) - np.sin(t)) / t**3
        db = (t * np.sin(t) - 2 + 2 * np.cos(t)) / t**4
    turning = np.sinc(t / np.pi) * J + _versine(t) * (hat(g) @ J - hat(Jg))
    return turning + np.outer(da * Jg + db * np.cross(g, Jg), g)
