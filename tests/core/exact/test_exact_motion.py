"""The exact motion, against power series in fifty decimal digits and against itself."""

from decimal import Decimal
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgvi.core.exact.motion import free_motion

from ...systems import hat, rng
from ..decimal_motion import decimals, digits, motion_at
from .cases import CASES

JS, PIS = (np.stack(arrays) for arrays in zip(*CASES.values(), strict=True))
START = np.eye(3)
TIMES = np.array([3.0, -0.4, 0.05])
WEIGHTS = rng(31).normal(size=(len(TIMES), 3, 3)), rng(32).normal(size=(len(TIMES), 3))


def motion_in_decimals(J, pi, times):
    R, pi = zip(*(motion_at(J, pi, t) for t in times), strict=True)
    return np.array(R), np.array(pi)


@cache
def reference(name, dtype):
    """Of the inertia and the momentum in that precision."""
    given = (np.asarray(x, dtype) for x in (*CASES[name], TIMES))
    R, pi = motion_in_decimals(*map(decimals, given))
    return R.astype(float), pi.astype(float)


@cache
def motions(dtype="float64"):
    arrays = (jnp.asarray(x, dtype) for x in (START, PIS, JS, TIMES))
    batched = jax.vmap(free_motion, in_axes=(None, 0, 0, None))
    R, pi = jax.jit(batched)(*arrays)
    assert R.dtype == pi.dtype == dtype
    return dict(zip(CASES, zip(np.asarray(R), np.asarray(pi), strict=True), strict=True))


@pytest.mark.parametrize("name", CASES)
def test_the_motion_is_exact(name, dtype):
    """To the rounding of the angle turned."""
    R, pi = reference(name, str(dtype))
    found_R, found_pi = motions(str(dtype))[name]
    angle = 1 + 3 * np.linalg.norm(np.linalg.solve(*CASES[name]))
    bound = 10 * angle * np.finfo(dtype).eps
    np.testing.assert_allclose(found_R, R, rtol=0, atol=bound)
    np.testing.assert_allclose(found_pi, pi, rtol=0, atol=bound)


def test_long_times_are_those_of_two_shorter_motions():
    first, second = 1e3, 7.7e3

    @jax.jit
    def motion(J, pi):
        R, middle = free_motion(START, pi, J, jnp.array([first, first + second]))
        rest, end = free_motion(R[0], middle[0], J, jnp.array([second, 0]))
        return R[1], middle[1], rest[0], end[0]

    for name in ("generic", "two nearly equal", "first and second axis", "thin"):
        R, pi, R_again, pi_again = motion(*CASES[name])
        np.testing.assert_allclose(R, R_again, rtol=0, atol=2e-11)
        np.testing.assert_allclose(pi, pi_again, rtol=0, atol=2e-11)


def weighted(J, pi, times):
    R, pi = free_motion(START, pi, J, times)
    return jnp.sum(WEIGHTS[0] * R) + jnp.sum(WEIGHTS[1] * pi)


@cache
def gradients():
    gradient = jax.grad(weighted, argnums=(0, 1, 2))
    results = jax.jit(jax.vmap(gradient, in_axes=(0, 0, None)))(JS, PIS, TIMES)
    return dict(zip(CASES, zip(*map(np.asarray, results), strict=True), strict=True))


@digits
def slope(J, pi, dJ, dpi):
    """Of the weighted sum, by differences in fifty digits."""
    step, totals = Decimal("1e-20"), []
    J, pi, dJ, dpi, times, of_R, of_pi = map(decimals, (J, pi, dJ, dpi, TIMES, *WEIGHTS))
    for h in (step, -step):
        R, end = motion_in_decimals(J + h * dJ, pi + h * dpi, times)
        totals.append(np.sum(of_R * R) + np.sum(of_pi * end))
    return float((totals[0] - totals[1]) / (2 * step))


@pytest.mark.parametrize("name", CASES)
def test_first_derivatives_are_exact(name):
    """Reverse mode; along inertias beside the principal axes, momenta and times."""
    J, pi = CASES[name]
    by_J, by_pi, by_times = gradients()[name]
    along_J = rng(33).normal(size=(3, 3)) * np.linalg.eigvalsh(J)[0]
    along_J, along_pi = (along_J + along_J.T) / 2, rng(34).normal(size=3)
    for dJ, dpi in ((along_J, 0 * along_pi), (0 * along_J, along_pi)):
        wanted = slope(J, pi, dJ, dpi)
        found = np.sum(by_J * dJ) + by_pi @ dpi
        assert abs(found - wanted) < 1e-13 * (1 + abs(wanted))
    R, end = motions()[name]
    rates = np.linalg.solve(J, end.T).T
    turning = np.stack([A @ hat(w) for A, w in zip(R, rates, strict=True)])
    wanted = np.sum(WEIGHTS[0] * turning, axis=(1, 2)) + np.sum(
        WEIGHTS[1] * np.cross(end, rates), axis=1
    )
    np.testing.assert_allclose(by_times, wanted, rtol=1e-12, atol=1e-12)
