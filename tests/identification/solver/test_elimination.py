"""The block-arrow solver against dense linear algebra, and what is not observable."""

import numpy as np
import pytest

from lgvi.identification.solver.elimination import STATE_SIZE, BlockArrow, solve, triangularise
from lgvi.identification.uncertainty.information import compute_information

from ...systems import rng

WINDOWS, COMMON, ROWS = 5, 3, 30


def problem(*key):
    """Jacobians (windows, rows, 6+p) and residuals (windows, rows), and their triangles."""
    random = rng(80, *key)
    A = random.normal(size=(WINDOWS, ROWS, STATE_SIZE + COMMON)) * 10.0 ** random.integers(
        -3, 4, STATE_SIZE + COMMON
    )
    b = random.normal(size=(WINDOWS, ROWS))
    return A, b, rows_of(A, b)


def rows_of(A, b):
    return BlockArrow(triangularise(np.concatenate([A, b[..., None]], axis=2)))


def dense(A):
    """The Jacobian of all unknowns: the windows' own, and then the common ones."""
    result = np.zeros((WINDOWS * ROWS, WINDOWS * STATE_SIZE + COMMON))
    for i in range(WINDOWS):
        rows = slice(i * ROWS, (i + 1) * ROWS)
        result[rows, i * STATE_SIZE : (i + 1) * STATE_SIZE] = A[i, :, :STATE_SIZE]
        result[rows, -COMMON:] = A[i, :, STATE_SIZE:]
    return result


def test_a_step_without_damping_solves_the_dense_problem():
    A, b, rows = problem(1)
    step = solve(rows, 0, np.zeros(COMMON, bool))
    expected = np.linalg.lstsq(dense(A), -b.ravel())[0]
    np.testing.assert_allclose(step.theta, expected[-COMMON:], rtol=1e-7)
    np.testing.assert_allclose(step.own.ravel(), expected[:-COMMON], rtol=1e-7)
    left = np.sum((dense(A) @ expected + b.ravel()) ** 2)
    assert step.reduction == pytest.approx(np.sum(b**2) - left, rel=1e-10)
    own = dense(A)[:, :-COMMON]
    left_by_own = np.sum((own @ np.linalg.lstsq(own, -b.ravel())[0] + b.ravel()) ** 2)
    assert step.reduction_by_common == pytest.approx(left_by_own - left, rel=1e-8)


def test_a_damped_step_solves_the_dense_damped_problem():
    A, b, rows = problem(2)
    damping = 0.3
    own = np.linalg.norm(A[:, :, :STATE_SIZE], axis=1).ravel()
    common = np.linalg.norm(A[:, :, STATE_SIZE:], axis=(0, 1))
    scale = np.concatenate([own, common])
    damped = np.concatenate([dense(A) / scale, damping * np.eye(len(scale))])
    expected = np.linalg.lstsq(damped, -np.append(b, np.zeros(len(scale))))[0] / scale
    step = solve(rows, damping, np.zeros(COMMON, bool))
    np.testing.assert_allclose(rows.lengths(), common, rtol=1e-12)
    np.testing.assert_allclose(step.theta, expected[-COMMON:], rtol=1e-9)
    error = own * (step.own.ravel() - expected[:-COMMON])  # in residuals
    np.testing.assert_allclose(error, 0, atol=1e-10)
    assert 0 < step.reduction_by_common < solve(rows, 0, np.zeros(COMMON, bool)).reduction_by_common


def test_what_processes_add_up_is_double_whether_or_not_one_has_gaps():
    _, _, rows = problem(7)
    single = rows._replace(triangles=rows.triangles.astype(np.float32))
    joined = single._replace(gaps=np.zeros((WINDOWS, STATE_SIZE, 2 * STATE_SIZE + COMMON + 1)))
    assert single.gradient().dtype == joined.gradient().dtype == np.float64
    assert single.lengths().dtype == joined.lengths().dtype == np.float64


def test_what_is_held_does_not_move_and_the_rest_solves_the_rest():
    A, b, rows = problem(3)
    held = np.array([False, True, False])
    step = solve(rows, 0, held)
    assert step.theta[1] == 0
    kept = np.append(np.full(WINDOWS * STATE_SIZE, True), ~held)
    expected = np.linalg.lstsq(dense(A)[:, kept], -b.ravel())[0]
    np.testing.assert_allclose(step.theta[~held], expected[-2:], rtol=1e-7)


def test_the_covariance_is_that_of_the_dense_problem():
    A, _, rows = problem(4)
    covariance = np.linalg.inv(dense(A).T @ dense(A))[-COMMON:, -COMMON:]
    known = compute_information(rows, np.zeros(COMMON, bool))
    np.testing.assert_allclose(known.covariance(), covariance, rtol=1e-6)


def test_unknowns_on_which_nothing_depends_stay_and_have_infinite_variance():
    A, b, _ = problem(5)
    A[:, :, 2] = 0  # of each window
    A[:, :, STATE_SIZE + 1] = 3 * A[:, :, STATE_SIZE]  # two common ones that act alike
    rows = rows_of(A, b)
    step = solve(rows, 0, np.zeros(COMMON, bool))
    assert not step.own[:, 2].any()
    known = compute_information(rows, np.zeros(COMMON, bool))
    padded = BlockArrow(np.concatenate([rows.triangles, np.zeros_like(rows.triangles)]))
    for of_rows in (known, compute_information(padded, np.zeros(COMMON, bool))):
        assert of_rows.rank == WINDOWS * (STATE_SIZE - 1) + COMMON - 1
    null = np.array([3.0, -1.0, 0.0])
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
    known = compute_information(rows, np.array([True, False, False]))
    assert known.observable.all()
    assert np.isfinite(known.covariance_of(np.eye(COMMON))).all()


def test_a_direction_that_nothing_shows_is_unobservable_whatever_rounding_says():
    A, b, _ = problem(7)
    unseen = np.array([1.0, -2.0, 0.0])
    A[:, :, STATE_SIZE] = (
        2 * A[:, :, STATE_SIZE + 1] * (1 + 1e-6 * A[:, :, 0] / abs(A[:, :, 0]).max())
    )
    rounded = rows_of(A, b)
    rows = rounded.without(unseen)
    np.testing.assert_allclose(rows.triangles, rounded.triangles, rtol=0, atol=1e-5 * abs(A).max())
    held = np.zeros(COMMON, bool)
    assert solve(rows, 0, held).reduction < solve(rounded, 0, held).reduction - 0.01
    assert compute_information(rounded, held).observable.all()
    known = compute_information(rows, held)
    np.testing.assert_array_equal(known.observable, [True, True, False])
    np.testing.assert_allclose(np.cross(known.null()[:, 0], unseen), 0, atol=1e-12)
    variances = np.diag(known.covariance_of(np.array([[1.0, 0.0, 1e9], [2.0, 1.0, 1e9]])))
    np.testing.assert_array_equal(np.isinf(variances), [True, False])
    # What is held is not free to change along it.
    assert compute_information(rows, np.array([True, False, False])).observable.all()


def test_length_of_a_step_is_in_standard_errors():
    _, _, rows = problem(6)
    known = compute_information(rows, np.zeros(COMMON, bool))
    step = np.sqrt(np.diag(known.covariance()))[0] * np.eye(COMMON)[0]
    inverse = np.linalg.inv(known.covariance())
    assert known.length(step) == pytest.approx(np.sqrt(step @ inverse @ step), rel=1e-9)


POSITION = np.array([0, 1, 2, 0, 1])  # two trajectories, of three and two segments


def segments(gap_sigma):
    """The problem with gaps of a width, and the dense rows of these."""
    A, b, rows = problem(7)
    random = rng(81)
    gaps = random.normal(size=(WINDOWS, STATE_SIZE, 2 * STATE_SIZE + COMMON + 1))
    scale = np.linalg.norm(A, axis=(0, 1))  # of the unknowns, in which a window sees the like
    gaps[:, :, :STATE_SIZE] += 2 * np.eye(STATE_SIZE)
    gaps[:, :, :-1] *= np.concatenate([scale[:STATE_SIZE], scale]) / gap_sigma
    gaps[:, :, -1] /= gap_sigma
    following = np.roll(POSITION, -1) > 0
    gaps[~following] = 0
    of_gaps = np.zeros((WINDOWS * STATE_SIZE, WINDOWS * STATE_SIZE + COMMON))
    for i in np.flatnonzero(following):
        at = slice(i * STATE_SIZE, (i + 1) * STATE_SIZE)
        of_gaps[at, (i + 1) * STATE_SIZE : (i + 2) * STATE_SIZE] = gaps[i, :, :STATE_SIZE]
        of_gaps[at, at] = gaps[i, :, STATE_SIZE : 2 * STATE_SIZE]
        of_gaps[at, -COMMON:] = gaps[i, :, 2 * STATE_SIZE : -1]
    A, b = np.concatenate([dense(A), of_gaps]), np.append(b, gaps[:, :, -1])
    return A, b, rows._replace(gaps=gaps, position=POSITION)


@pytest.mark.parametrize("gap_sigma", [1, 1e-4])
def test_segments_that_continue_one_another_solve_the_dense_problem(gap_sigma):
    A, b, rows = segments(gap_sigma)
    scale = np.linalg.norm(A, axis=0)
    expected = np.linalg.lstsq(A / scale, -b)[0] / scale
    step = solve(rows, 0, np.zeros(COMMON, bool))
    found = np.append(step.own, step.theta)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    left = np.sum((A @ expected + b) ** 2)
    assert step.reduction == pytest.approx(np.sum(b**2) - left, rel=1e-9)
    np.testing.assert_allclose(rows.gradient(), (A.T @ b)[-COMMON:], rtol=1e-12)
    root = (
        np.linalg.inv(triangularise(A / scale)) / scale[:, None]
    )  # the normal matrix would be worse
    covariance = root @ root.T
    known = compute_information(rows, np.zeros(COMMON, bool))
    np.testing.assert_allclose(known.covariance(), covariance[-COMMON:, -COMMON:], rtol=1e-6)
    # Six initial states of each trajectory: a gap takes what its segment adds.
    assert known.rank == 2 * STATE_SIZE + COMMON


def test_a_damped_step_of_segments_solves_the_dense_damped_problem():
    A, b, rows = segments(1e-2)
    damping = 0.3
    scale = np.append(rows.own_lengths(), rows.lengths())
    damped = np.concatenate([A / scale, damping * np.eye(len(scale))])
    expected = np.linalg.lstsq(damped, -np.append(b, np.zeros(len(scale))))[0] / scale
    step = solve(rows, damping, np.zeros(COMMON, bool))
    np.testing.assert_allclose(np.append(step.own, step.theta), expected, rtol=1e-7)
