"""The block-arrow solver against dense linear algebra, and what is not observable."""

import numpy as np
import pytest

from lgvi.identification.block_arrow import OWN, common_rows, lengths, rank, solve, triangle
from lgvi.identification.observability import information

from ..systems import rng

WINDOWS, COMMON, ROWS = 5, 3, 30


def problem(*key):
    """Jacobians (windows, rows, 6+p) and residuals (windows, rows), and their triangles."""
    random = rng(80, *key)
    A = random.normal(size=(WINDOWS, ROWS, OWN + COMMON)) * 10.0 ** random.integers(
        -3, 4, OWN + COMMON
    )
    b = random.normal(size=(WINDOWS, ROWS))
    return A, b, triangles_of(A, b)


def triangles_of(A, b):
    return triangle(np.concatenate([A, b[..., None]], axis=2))


def dense(A):
    """The Jacobian of all unknowns: the windows' own, and then the common ones."""
    result = np.zeros((WINDOWS * ROWS, WINDOWS * OWN + COMMON))
    for i in range(WINDOWS):
        rows = slice(i * ROWS, (i + 1) * ROWS)
        result[rows, i * OWN : (i + 1) * OWN] = A[i, :, :OWN]
        result[rows, -COMMON:] = A[i, :, OWN:]
    return result


def test_a_step_without_damping_solves_the_dense_problem():
    A, b, triangles = problem(1)
    step = solve(triangles, 0, np.zeros(COMMON, bool))
    expected = np.linalg.lstsq(dense(A), -b.ravel())[0]
    np.testing.assert_allclose(step.theta, expected[-COMMON:], rtol=1e-7)
    np.testing.assert_allclose(step.own.ravel(), expected[:-COMMON], rtol=1e-7)
    left = np.sum((dense(A) @ expected + b.ravel()) ** 2)
    assert step.reduction == pytest.approx(np.sum(b**2) - left, rel=1e-10)


def test_a_damped_step_solves_the_dense_damped_problem():
    A, b, triangles = problem(2)
    damping = 0.3
    own = np.linalg.norm(A[:, :, :OWN], axis=1).ravel()
    common = np.linalg.norm(A[:, :, OWN:], axis=(0, 1))
    scale = np.concatenate([own, common])
    rows = np.concatenate([dense(A) / scale, damping * np.eye(len(scale))])
    expected = np.linalg.lstsq(rows, -np.append(b, np.zeros(len(scale))))[0] / scale
    step = solve(triangles, damping, np.zeros(COMMON, bool))
    np.testing.assert_allclose(lengths(triangles), common, rtol=1e-12)
    np.testing.assert_allclose(step.theta, expected[-COMMON:], rtol=1e-9)
    error = own * (step.own.ravel() - expected[:-COMMON])  # in residuals
    np.testing.assert_allclose(error, 0, atol=1e-10)


def test_what_is_held_does_not_move_and_the_rest_solves_the_rest():
    A, b, triangles = problem(3)
    held = np.array([False, True, False])
    step = solve(triangles, 0, held)
    assert step.theta[1] == 0
    kept = np.append(np.full(WINDOWS * OWN, True), ~held)
    expected = np.linalg.lstsq(dense(A)[:, kept], -b.ravel())[0]
    np.testing.assert_allclose(step.theta[~held], expected[-2:], rtol=1e-7)


def test_common_rows_hold_the_information_that_is_left_of_the_windows():
    A, _, triangles = problem(4)
    _, left = common_rows(triangles, 0)
    covariance = np.linalg.inv(dense(A).T @ dense(A))[-COMMON:, -COMMON:]
    np.testing.assert_allclose(np.linalg.inv(left[:, :-1].T @ left[:, :-1]), covariance, rtol=1e-6)
    known = information(triangles, np.zeros(COMMON, bool))
    np.testing.assert_allclose(known.covariance(), covariance, rtol=1e-6)


def test_unknowns_on_which_nothing_depends_stay_and_have_infinite_variance():
    A, b, _ = problem(5)
    A[:, :, 2] = 0  # of each window
    A[:, :, OWN + 1] = 3 * A[:, :, OWN]  # two common ones that act alike
    triangles = triangles_of(A, b)
    step = solve(triangles, 0, np.zeros(COMMON, bool))
    assert not step.own[:, 2].any()
    assert rank(triangles, np.zeros(COMMON, bool)) == WINDOWS * (OWN - 1) + COMMON - 1
    padded = np.concatenate([triangles, np.zeros_like(triangles)])
    assert rank(padded, np.zeros(COMMON, bool)) == WINDOWS * (OWN - 1) + COMMON - 1
    null = np.array([3.0, -1.0, 0.0])
    known = information(triangles, np.zeros(COMMON, bool))
    np.testing.assert_array_equal(known.observable, [True, True, False])
    np.testing.assert_allclose(np.cross(known.null()[:, 0], null), 0, atol=1e-9 * 3e3)
    variances = np.diag(known.covariance_of(np.eye(COMMON)))
    np.testing.assert_array_equal(np.isinf(variances), [True, True, False])
    # What does not change along it is known: theta_0 + 3 theta_1.
    across = known.covariance_of(np.array([[1.0, 3.0, 0.0]]))
    expected = np.linalg.pinv(dense(A).T @ dense(A), rcond=1e-22)
    variance = np.array([1, 3]) @ expected[-3:-1, -3:-1] @ [1, 3]
    np.testing.assert_allclose(across, [[variance]], rtol=1e-5)
    # What is held is known, and the other one then too.
    known = information(triangles, np.array([True, False, False]))
    assert known.observable.all()
    assert np.isfinite(known.covariance_of(np.eye(COMMON))).all()


def test_length_of_a_step_is_in_standard_errors():
    _, _, triangles = problem(6)
    known = information(triangles, np.zeros(COMMON, bool))
    step = np.sqrt(np.diag(known.covariance()))[0] * np.eye(COMMON)[0]
    inverse = np.linalg.inv(known.covariance())
    assert known.length(step) == pytest.approx(np.sqrt(step @ inverse @ step), rel=1e-9)
