"""Bodies and momenta at which the exact motion is easy to get wrong."""

import numpy as np

from ...systems import GENERIC, rotation


def body(*reciprocal_moments, axes=None):
    axes = np.eye(3) if axes is None else axes
    J = axes @ np.diag(1 / np.asarray(reciprocal_moments, float)) @ axes.T
    return (J + J.T) / 2


ANY = np.array([0.7, -0.4, 0.5])
UNEQUAL = body(1, 0.6, 0.4)
CASES = {
    "generic": (GENERIC, ANY),
    "in principal axes": (UNEQUAL, ANY),
    "all moments equal": (np.eye(3), ANY),
    "two large moments equal": (body(1, 0.4, 0.4), ANY),
    "two small moments equal": (body(1, 1, 0.4), ANY),
    "two equal, in other axes": (body(1, 1, 0.4, axes=rotation(5)), ANY),
    "two nearly equal": (body(1, 1 + 1e-6, 0.4, axes=rotation(6)), ANY),
    "two equal to rounding": (body(1, 1 + 1e-13, 0.4), ANY),
    "all nearly equal": (body(1, 1 + 1e-9, 1 - 1e-9, axes=rotation(7)), ANY),
    "about the smallest moment": (UNEQUAL, np.array([1.0, 0, 0])),
    "about the middle moment": (UNEQUAL, np.array([0, 1.0, 0])),
    "about the largest moment": (UNEQUAL, np.array([0, 0, 1.0])),
    "nearly about the smallest": (UNEQUAL, np.array([1, 1e-9, 1e-10])),
    "nearly about the middle": (UNEQUAL, np.array([1e-9, 1, 2e-9])),
    "nearly about the largest": (UNEQUAL, np.array([1e-8, 1e-9, 1])),
    "separatrix": (UNEQUAL, np.array([0.5, 0.3, 0.5 * 2**0.5 * (1 + 3e-13)])),
    "first and second axis": (UNEQUAL, np.array([0.7, 0.5, 0])),
    "first and third axis": (UNEQUAL, np.array([0.7, 0, 0.5])),
    "second and third axis": (UNEQUAL, np.array([0, 0.7, 0.5])),
    "across the axis of symmetry": (body(1, 1, 0.4), np.array([0.7, -0.4, 0])),
    "along the axis of symmetry": (body(1, 1, 0.4), np.array([0, 0, -1.0])),
    "no body": (body(1, 10, 10.001), np.array([0.7, 0.04, 0.05])),
    "thin": (body(1e4, 1, 1.0001), np.array([3e-5, 0.5, 0.6])),
    "thin, of equal moments": (body(1e4, 1, 1), np.array([3e-5, 0.5, 0.6])),
    "thin, along its axis": (body(1e4, 1.02, 1), np.array([1e-4, 1e-12, 0])),
    "at rest": (UNEQUAL, np.zeros(3)),
    "thin, at rest": (body(1e9, 1.1, 0.8), np.zeros(3)),
}
