"""No wrong number in silence: many random bodies, both precisions, against what is independent.

In one command, about ten minutes on two cores:
python -m pytest -n 0 -q -o python_files="proof_reliability.py" tests/benchmarks

Each line of the table tells how many were tried, how many failures were reported, how many were
silent, and the worst error over its bound.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Recordings

from ..identification.data import csv_oracle
from ..systems import rng
from . import long_double as exact

PART = 50_000  # bodies at a time
MARGIN = 4.0  # on the size of the rounding of one operation, amplified by the condition
ORDERS = 2, 4, 6, 8, 10, 12
PRECISIONS = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def bodies(count, *key):
    """Inertias (count, 3, 3) of unit trace: rods, plates, spheres, and ratios down to 1e-4."""
    random = rng(*key)
    second = 10 ** random.uniform(-4, 0, (count, 3))  # moments of the discrete inertia
    kind = random.integers(5, size=count)
    second[kind == 0] = np.sort(second[kind == 0]) * [1e-3, 1e-3, 1] + [0, 0, 1]  # rods
    second[kind == 1, 2] = 1e-4 * second[kind == 1, 0]  # plates
    second[kind == 2] = 1.0  # spheres, and what nearly is one
    second[kind == 3] = 1 + 1e-6 * random.normal(size=(np.sum(kind == 3), 3))
    moments = second.sum(1, keepdims=True) - second
    moments = np.maximum(moments, 1e-4 * moments.max(1, keepdims=True))
    moments /= moments.sum(1, keepdims=True)
    axes = Rotation.random(count, rng=random).as_matrix()
    J = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
    return (J + np.swapaxes(J, 1, 2)) / 2


def rates(count, least, most, *key):
    """Vectors (count, 3) in any direction, their lengths log-uniform."""
    random = rng(*key)
    direction = random.normal(size=(count, 3))
    length = np.exp(random.uniform(np.log(least), np.log(most), (count, 1)))
    return length * direction / np.linalg.norm(direction, axis=1, keepdims=True)


class Count:
    """What came of one kind of trial."""

    def __init__(self, name, dtype=None):
        self.name = name if dtype is None else f"{name}, {np.dtype(dtype)}"
        self.tried = self.reported = self.silent = 0
        self.worst = 0.0

    def add(self, ok, error_over_bound):
        """`ok` tells what the library vouches for (n,)."""
        ratio = np.where(ok, error_over_bound, 0).astype(float)
        self.tried += len(ratio)
        self.reported += int(np.sum(~ok))
        self.silent += int(np.sum(~(ratio <= 1)))  # NaN too
        self.worst = max(self.worst, float(np.max(np.nan_to_num(ratio, nan=np.inf))))

    def tell(self, line):
        line(
            f"{self.name:52} {self.tried:9,} {self.reported:8,} {self.silent:6,} {self.worst:9.2g}"
        )
        assert self.silent == 0


@pytest.fixture(scope="module", autouse=True)
def heading(request):
    from .conftest import LINES

    lines = request.config.stash.setdefault(LINES, [])
    lines.append(f"{'':52} {'tried':>9} {'reported':>8} {'silent':>6} {'worst':>9}")


@PRECISIONS
def test_steps_and_their_gradients(line, dtype):
    """Against long double; |h J^-1 pi| log-uniform to 0.999."""
    values, derivatives = Count("step", dtype), Count("gradient of a step", dtype)
    eps = float(np.finfo(dtype).eps)

    @jax.jit
    @jax.vmap
    def library(weights, pi, J):
        def loss(pi, J):
            F, info = lgvi.solve_F_with_info(pi, J, jnp.ones((), J.dtype), tolerance=None)
            return jnp.sum(weights * F), (F, info.converged)

        (_, (F, ok)), of = jax.value_and_grad(loss, (0, 1), has_aux=True)(pi, J)
        return F, ok, *of

    for part in range(20):
        J = bodies(PART, 301, part).astype(dtype)
        omega = rates(PART, 1e-6, 0.999, 302, part)
        pi = np.einsum("nij,nj->ni", J, omega).astype(dtype)
        weights = rng(303, part).normal(size=(PART, 3, 3)).astype(dtype)
        F, ok, of_pi, of_J = map(np.asarray, library(weights, pi, J))
        steps = exact.solve(pi, J, 1)
        solved = steps.residual < 1e-17
        # The sensitivity of the solution to rounding of the inertia and the momentum.
        condition = np.linalg.norm(steps.inverse.astype(float), axis=(1, 2))
        turn = 2 * exact.size(steps.c).astype(float)
        error = np.max(abs(F - steps.F), (1, 2))
        bound = MARGIN * eps * (1 + condition * turn)
        # Without an exact solution the library must not claim to have one.
        values.add(ok, np.where(solved, error / bound, np.inf))
        size = condition * exact.size(np.ones((PART, 3))) * np.max(abs(weights), (1, 2))
        bound = MARGIN * eps * size * (1 + condition) * (1 + condition * turn)
        expected_pi, expected_J = exact.gradients(steps, weights, pi, J, 1)
        error = exact.size(of_pi - expected_pi)
        symmetric = (of_J + np.swapaxes(of_J, 1, 2)) / 2
        expected_J = (expected_J + np.swapaxes(expected_J, 1, 2)) / 2
        error_J = np.max(abs(symmetric - expected_J), (1, 2))
        worst = np.maximum(error, error_J / np.maximum(turn, 1e-3)) / bound
        derivatives.add(ok & solved, worst)
    values.tell(line)
    derivatives.tell(line)


def exact_motion(J, pi, steps, terms=26):
    """Attitudes (bodies, steps + 1, 3, 3) of free motion from the attitude I, at times 0, 1, ...

    The momentum and the rows of the attitude all have the derivative x' = x x omega: their Taylor
    series in long double.
    """
    inverse = exact.inverse_of(J.astype(np.longdouble))
    x = np.concatenate([pi[:, None], np.tile(np.eye(3), (len(J), 1, 1))], 1)  # (bodies, 4, 3)
    x = x.astype(np.longdouble)
    attitudes = [x[:, 1:]]
    for _ in range(steps):
        series, omegas = [x], []
        for n in range(terms):
            omegas.append(exact.matvec(inverse, series[n][:, 0])[:, None])
            products = [np.cross(series[k], omegas[n - k]) for k in range(n + 1)]
            series.append(np.sum(products, 0) / np.longdouble(n + 1))
        x = np.sum(series, 0)
        attitudes.append(x[:, 1:])
    return np.stack(attitudes, 1)


FREE_STEPS = 20


@pytest.fixture(scope="module")
def free_motions():
    """Inertias, momenta, their motion, and h|omega| of the fastest step, at the start up to 0.6."""
    J, omega = bodies(10_000, 311), rates(10_000, 1e-3, 0.6, 312)
    J, omega = (x.astype(np.float32).astype(float) for x in (J, omega))
    pi = np.einsum("nij,nj->ni", J, omega).astype(np.float32).astype(float)
    R = exact_motion(J, pi, FREE_STEPS).astype(float)
    omega = np.linalg.solve(J[:, None], np.einsum("nkij,ni->nkj", R, pi)[..., None])
    return J, pi, R, np.max(np.linalg.norm(omega, axis=(2, 3)), 1)


@pytest.mark.parametrize("order", ORDERS)
def test_free_trajectories(line, order, free_motions):
    """In float64 against the motion, and in float32 against float64."""
    double, single = (Count(f"free, order {order}", dtype) for dtype in (np.float64, np.float32))

    def library(J, pi):
        eye, h = jnp.eye(3, dtype=J.dtype), jnp.ones((), J.dtype)
        R, _, info = lgvi.simulate_free_rigid_body(
            eye, pi, J, h, FREE_STEPS, tolerance=None, order=order
        )
        return R, jnp.all(info.converged)

    batch = jax.jit(jax.vmap(library))

    @jax.jit
    @jax.vmap
    def sensitivity(J, pi):
        return jnp.max(jnp.linalg.norm(jax.jacfwd(lambda pi: library(J, pi)[0])(pi), axis=-1))

    J, pi, expected, turn = free_motions
    # Rounding of an inertia of unit trace acts like a momentum of eps h|omega|.
    condition = FREE_STEPS + turn * sensitivity(J, pi)
    assert np.all(np.isfinite(condition))

    def rounding(dtype):
        return MARGIN * float(np.finfo(dtype).eps) * condition

    R, ok = map(np.asarray, batch(J, pi))
    truncation = FREE_STEPS * (0.8 * turn) ** (order + 1)
    double.add(ok, np.max(abs(R - expected), (1, 2, 3)) / (rounding(np.float64) + truncation))
    short, ok = map(np.asarray, batch(J.astype(np.float32), pi.astype(np.float32)))
    single.add(ok, np.max(abs(short - R), (1, 2, 3)) / rounding(np.float32))
    double.tell(line)
    single.tell(line)


@PRECISIONS
@pytest.mark.parametrize("rotor", [False, True])
def test_forced_trajectories(line, rotor, dtype):
    """Each step satisfies the equation of matrices in long double, and half impulses add up."""
    tried, steps = 10_000, 20
    count = Count("torques and rotors" if rotor else "torques", dtype)
    quiet = lgvi.MoserVeselovIntegrator(jnp.ones((), dtype), tolerance=None, throw=False)

    @jax.jit
    @jax.vmap
    def library(J, pi, torques, momentum):
        body = lgvi.Gyrostat(J, momentum) if rotor else lgvi.RigidBody(J)
        motion = quiet.simulate(body, jnp.eye(3, dtype=dtype), pi, body_torques=torques)
        return motion.R, motion.pi, jnp.all(motion.solver_info.converged)

    J = bodies(tried, 321).astype(dtype)
    omega = rates(tried, 1e-3, 0.5, 322)
    # About the momentum of the body along its thinnest axis: with more it speeds up beyond a step.
    smallest = np.linalg.eigvalsh(J)[:, :1].astype(float)
    momentum = smallest * rates(tried, 1e-3, 0.5, 323) * rotor
    pi = (np.einsum("nij,nj->ni", J, omega) + momentum).astype(dtype)
    torques = 1e-2 * rng(324).normal(size=(tried, steps + 1, 3))
    torques = np.einsum("nij,nkj->nki", J, torques).astype(dtype)
    momentum = momentum.astype(dtype)
    R, after, ok = (np.asarray(x) for x in library(J, pi, torques, momentum))
    R, after, J, torques, r = (
        np.asarray(x, np.longdouble) for x in (R, after, J, torques, momentum)
    )
    worst = np.zeros(tried)
    for k in range(steps):
        F = np.swapaxes(R[:, k], 1, 2) @ R[:, k + 1]
        p = after[:, k] + torques[:, k] / 2
        of_rotor = F @ exact.hat(r) / 2
        of_rotor = of_rotor - np.swapaxes(of_rotor, 1, 2)
        gained = exact.size(exact.left_side(F, J) + exact.vee(of_rotor) - p)
        kept = exact.size(
            exact.matvec(np.swapaxes(F, 1, 2), p) + torques[:, k + 1] / 2 - after[:, k + 1]
        )
        size = 1 + exact.size(p) + exact.size(r)  # of what is added up, for unit trace
        worst = np.maximum(worst, np.maximum(gained, kept) / size)
    count.add(ok, worst / (MARGIN * 2 * float(np.finfo(dtype).eps)))
    count.tell(line)


@PRECISIONS
@pytest.mark.parametrize("order", ORDERS)
def test_units(line, order, dtype):
    """Inertias of 1e-20 to 1e14 and momenta of 1e-9 to 1e6, against an inertia of unit trace."""
    tried, steps = 2_000, 5
    count = Count(f"units, order {order}", dtype)
    weights = rng(330).normal(size=(3, 3)).astype(dtype)

    @jax.jit
    @jax.vmap
    def library(J, pi, h):
        def loss(J, pi, h):
            R, _, info = lgvi.simulate_free_rigid_body(
                jnp.eye(3, dtype=dtype), pi, J, h, steps, tolerance=None, order=order
            )
            return jnp.sum(weights * R[-1]), (R, jnp.all(info.converged))

        (_, (R, ok)), of = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(J, pi, h)
        return R, ok, *of

    random = rng(331, order)
    J, turn = bodies(tried, 332, order).astype(dtype), rates(tried, 0.05, 0.5, 333, order)
    pi = np.einsum("nij,nj->ni", J, turn).astype(dtype)
    h = np.ones(tried, dtype)
    # Powers of two, so that nothing is rounded otherwise.
    size = 2.0 ** np.round(np.log2(10) * random.uniform(-20, 14, tried))
    speed = 2.0 ** np.round(np.log2(10) * random.uniform(-9, 6, tried))
    R, ok, *of = (np.asarray(x, float) for x in library(J, pi, h))
    factors = size, speed, size / speed
    others = (
        (x * factor.reshape(-1, *np.ones(x.ndim - 1, int))).astype(dtype)
        for x, factor in zip((J, pi, h), factors, strict=True)
    )
    found, also_ok, *of_found = (np.asarray(x, float) for x in library(*others))
    differences = [np.max(abs(found - R), (1, 2, 3))]
    for own, other, factor in zip(of, of_found, factors, strict=True):
        own, other = own.reshape(tried, -1), other.reshape(tried, -1) * factor[:, None]
        differences.append(np.max(abs(own - other), 1) / np.max(abs(own), 1))
    bound = MARGIN * float(np.finfo(dtype).eps)
    count.add((ok * also_ok) > 0, np.max(differences, 0) / bound)
    count.silent += int(np.sum(ok != also_ok))
    count.tell(line)


@PRECISIONS
@pytest.mark.parametrize("order", [2, 8])
def test_long_runs(line, order, dtype):
    """Energy, momentum and orthogonality drift like a random walk of roundings at most."""
    tried, steps = 64, 10**6
    count = Count(f"10^6 steps, order {order}", dtype)
    quiet = lgvi.MoserVeselovIntegrator(
        jnp.ones((), dtype), tolerance=None, throw=False, order=order
    )

    @jax.jit
    @jax.vmap
    def library(J, pi):
        body, eye = lgvi.RigidBody(J), jnp.eye(3, dtype=dtype)
        motion = quiet.simulate(body, eye, pi, steps=steps, save_every=steps // 100)
        return motion.R, motion.pi, jnp.all(motion.solver_info.converged)

    J = np.stack([np.diag(m) for m in rng(341).uniform(1, 1.9, (tried, 3))]).astype(dtype)
    pi = np.einsum("nij,nj->ni", J, rates(tried, 0.05, 0.5, 342)).astype(dtype)
    R, after, ok = (np.asarray(x) for x in library(J, pi))
    R, after = R.astype(float), after.astype(float)
    energy = np.einsum("nki,nij,nkj->nk", after, np.linalg.inv(J.astype(float)), after)
    momentum = np.einsum("nkij,nkj->nki", R, after)
    size = np.linalg.norm(pi, axis=1)[:, None]
    gram = np.swapaxes(R, 2, 3) @ R
    errors = (
        abs(energy / energy[:, :1] - 1),
        np.linalg.norm(momentum - momentum[:, :1], axis=2) / size,
        np.max(abs(gram - np.eye(3)), (2, 3)),
    )
    walk = np.sqrt(np.arange(R.shape[1]) * (steps // 100) + 1)
    bound = MARGIN * float(np.finfo(dtype).eps) * walk
    count.add(ok, np.max([np.max(error / bound, 1) for error in errors], 0))
    count.tell(line)


def test_malformed_files(line, tmp_path):
    """A file is read as the plainest reader reads it, or refused with its place."""
    count, random, file = Count("CSV files"), rng(350), tmp_path / "log.csv"
    for _ in range(10**5):
        data = csv_oracle.spoilt(random)
        file.write_bytes(data)
        try:
            found = Recordings.from_csv(file, angular_velocity=csv_oracle.RATES)
        except ValueError as error:
            named = f"{file}, line" in str(error) or f"{file}: Trajectory" in str(error)
            count.add(np.array([False]), np.zeros(1))
            count.silent += not named
            continue
        text = data.decode("utf-8-sig")
        if '"' in text:  # which the plain reader does not know
            continue
        expected = csv_oracle.table(text)
        same = expected is not None and found.names == tuple(expected)
        same = same and all(
            np.array_equal(np.column_stack(found.channels["angular_velocity"].of(i)), samples)
            for i, samples in enumerate((expected or {}).values())
        )
        count.add(np.array([True]), np.array([0.0 if same else np.inf]))
    count.tell(line)
