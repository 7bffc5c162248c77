"""The exact motion of random bodies over its whole domain, against power series in fifty digits.

In one command, five minutes on two cores; with SAMPLES=10000 before it, a quarter of an hour:
python -m pytest -n 0 -q -s -o python_files="proof_free_motion.py" tests/benchmarks

Moments and momenta are equal, nearly equal, along axes, on the separatrix, and of thin bodies as
often as not. What rounding of the input does is by the derivatives, which are tried beside.
"""

import os
from concurrent.futures import ProcessPoolExecutor
from decimal import Decimal
from functools import partial
from multiprocessing import get_context

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from lgvi.core.exact.motion import free_motion

from ..core.decimal_motion import decimals, digits, motion_at
from ..systems import rng

SAMPLES = int(os.environ.get("SAMPLES", "2000"))
DERIVATIVES = SAMPLES // 20


def near_zero(random, count):
    """Numbers of size one, and others down to 1e-15, or zero."""
    sizes = 10.0 ** np.where(random.random(count) < 0.5, 0, random.uniform(-15, 0, count))
    return np.where(random.random(count) < 0.1, 0, sizes) * random.normal(size=count)


def drawn(count):
    """Inertias, momenta and times: the body turns by up to 100 rad."""
    random = rng(71)
    beta = 1 + 0.5 * np.stack([near_zero(random, count) for _ in range(3)], axis=1)
    beta = np.abs(beta) + 0.1
    pi = np.stack([near_zero(random, count) for _ in range(3)], axis=1)
    # A fifth on the separatrix but for about 1e-12: (b1 - b2) p1^2 = (b2 - b3) p3^2.
    order = np.sort(beta, axis=1)[:, ::-1]
    on = random.random(count) < 0.2
    beta = np.where(on[:, None], order, beta)
    gaps = np.sqrt(np.abs(beta[:, 0] - beta[:, 1]) / np.maximum(beta[:, 1] - beta[:, 2], 1e-300))
    third = pi[:, 0] * gaps * (1 + 1e-12 * random.normal(size=count))
    pi[:, 2] = np.where(on & (gaps < 1e3), third, pi[:, 2])
    # A fifth of thin bodies, spun hardly about their axis.
    thin, factor = random.random(count) < 0.2, 10 ** random.uniform(0, 6, count)
    beta[:, 0] *= np.where(thin, factor, 1)
    pi[:, 0] /= np.where(thin, factor, 1)
    axes = np.where(
        (random.random(count) < 0.5)[:, None, None],
        np.eye(3),
        Rotation.random(count, rng=random).as_matrix(),
    )
    J = np.einsum("nij,nj,nkj->nik", axes, 1 / beta, axes)
    alpha = np.roll(beta, -2, axis=1) - np.roll(beta, -1, axis=1)
    x = np.abs(np.roll(alpha, -1, axis=1) * np.roll(alpha, -2, axis=1)) * pi**2
    rates = np.linalg.norm(beta * pi, axis=1) + np.sqrt(np.max(x, axis=1))
    angle = np.exp(random.uniform(np.log(0.01), np.log(100), count))
    return (J + np.swapaxes(J, 1, 2)) / 2, np.einsum("nij,nj->ni", axes, pi), angle / (rates + 1e-3)


def value(case):
    return [x.astype(float) for x in motion_at(*map(decimals, case))]


@digits
def slope(case):
    """Of attitude and momentum along a change of J and pi, by differences in fifty digits."""
    J, pi, t, dJ, dpi = map(decimals, case)
    h = Decimal("1e-20")
    ends = [motion_at(J + k * dJ, pi + k * dpi, t) for k in (h, -h)]
    return [((a - b) / (2 * h)).astype(float) for a, b in zip(*ends, strict=True)]


@jax.jit
@partial(jax.vmap, in_axes=(0, 0, 0))
def motion(J, pi, t):
    R, end = free_motion(jnp.eye(3), pi, J, t[None])
    return R[0], end[0]


def sensitivity(J, pi, t):
    """How far the motion changes at most where each entry of J and pi changes by its rounding."""
    eps, total = np.finfo(float).eps, 0.0
    inputs = [(i, j) for i in range(3) for j in range(i, 3)] + [(i,) for i in range(3)]
    for entry in inputs:
        dJ, dpi = np.zeros_like(J), np.zeros_like(pi)
        if len(entry) == 2:
            i, j = entry
            dJ[:, i, j] = dJ[:, j, i] = eps * np.sqrt(J[:, i, i] * J[:, j, j])
        else:
            dpi[:, entry[0]] = eps * np.linalg.norm(pi, axis=1)
        _, changes = jax.jvp(lambda J, pi: motion(J, pi, t), (J, pi), (dJ, dpi))
        total = total + largest(changes)
    return total


def largest(arrays):
    return np.max([np.abs(np.asarray(x)).reshape(len(x), -1).max(1) for x in arrays], axis=0)


def tell(name, errors):
    worst = f"99 % below {np.quantile(errors, 0.99):.2g}, worst {np.max(errors):.2g}"
    print(f"{name}: {len(errors)} cases, median {np.median(errors):.2g}, {worst}", flush=True)


def test_values_and_derivatives():
    J, pi, t = drawn(SAMPLES)
    size = np.maximum(np.linalg.norm(pi, axis=1), 1)
    phase = size / np.linalg.eigvalsh(J)[:, 0] * t
    random, part = rng(72), slice(DERIVATIVES)
    dJ = random.normal(size=(SAMPLES, 3, 3)) / 10
    dJ, dpi = (dJ + np.swapaxes(dJ, 1, 2)) / 2, random.normal(size=(SAMPLES, 3)) / 10
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        wanted = pool.map(value, zip(J, pi, t, strict=True), chunksize=20)
        wanted = list(map(np.stack, zip(*wanted, strict=True)))
        cases = zip(J[part], pi[part], t[part], dJ[part], dpi[part], strict=True)
        slopes = list(map(np.stack, zip(*pool.map(slope, cases, chunksize=5), strict=True)))
    found = motion(J, pi, t)
    errors = largest([a - b for a, b in zip(found, wanted, strict=True)]) / size
    rounding = sensitivity(J, pi, t) / size
    usual = rounding < 1e-13 * (1 + phase / 100)
    tell("value, where rounding of the input does less than 1e-13", errors[usual])
    tell("value, elsewhere, over what rounding does", errors[~usual] / rounding[~usual])
    bound = 1e-13 * (1 + phase / 100) + 4 * rounding
    tell("value, over 1e-13 (1 + phase / 100) and four roundings", errors / bound)
    _, tangents = jax.jvp(lambda J, pi: motion(J, pi, t), (J, pi), (dJ, dpi))
    differences = [a[part] - b for a, b in zip(tangents, slopes, strict=True)]
    slope_errors = largest(differences) / np.maximum(largest(slopes), size[part])
    tell("derivative, the same cases", slope_errors[usual[part]])
    tell("derivative, over 1e-13 (1 + phase / 100) and four roundings", slope_errors / bound[part])
    assert np.max(errors / bound) < 1
    assert np.quantile(slope_errors / bound[part], 0.95) < 1
    assert np.all(np.isfinite(slope_errors))
