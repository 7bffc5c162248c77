"""The tangents of a trajectory and their adjoint, each against something else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.core.trajectory import adjoint
from lgvi.core.trajectory.prescribed import solve_prescribed

from ...systems import GENERIC, PI0, R0, rng

STEPS = 9


@pytest.mark.parametrize(
    ("batch", "inertias", "factors", "rotors", "columns"),
    [
        ((), STEPS, 0, 0, (3, 9, 9, 9)),
        ((2,), STEPS, 0, 1, (3, 0, 3, 0)),
        ((2,), 3, STEPS, 0, ()),
        pytest.param((), 1, 0, STEPS, (), marks=pytest.mark.slow),
        pytest.param((), 1, 0, STEPS, (0, 6, 6, 6), marks=pytest.mark.slow),
        pytest.param((2,), 1, 0, 0, (3, 6, 6, 0), marks=pytest.mark.slow),
    ],
)
def test_the_adjoint_is_the_transpose(batch, inertias, factors, rotors, columns):
    """With factors of the inertias, and feedback matrices N, B, K and H of so many columns."""
    random = rng(90)

    def normal(*shape):
        return random.normal(size=shape)

    one = (1,) * len(batch)
    sizes = np.linspace(1, 1.5, inertias).reshape(inertias, 1, 1, *one)
    J = GENERIC.reshape(1, 3, 3, *one) * sizes
    h = 0.1 + 0.01 * normal(STEPS, *one)
    rotor, impulses = 0.1 * normal(rotors, 3, *batch), 0.1 * normal(STEPS, 3, *batch)
    columns_of_factors = inertias if factors else 0
    factors = random.uniform(0.2, 0.4, (factors, columns_of_factors, *batch))
    start = [normal(3, 3, *batch), normal(3, *batch), J, factors, h, rotor, impulses]
    feedback = [normal(STEPS if n else 0, 3, n, *batch) for n in columns]
    every = 3 if columns else 1
    given = [normal(*x.shape[: x.ndim - len(batch)], *batch) for x in start]
    given[2] += np.swapaxes(given[2], 1, 2)  # inertias are symmetric, and so are their changes
    given += [normal(STEPS, 3, *batch) for n in columns[1::2] if n]
    weights = [normal(STEPS + 1, *shape, *batch) for shape in ((3, 3), *[(3,)] * 4)]
    weights[0] = weights[0][::every]

    # Made by NumPy, for which nothing is compiled.
    start, given, weights, feedback = jax.tree.map(jnp.asarray, (start, given, weights, feedback))
    _, _, J, factors, h, rotor, _ = start

    def both(start, given, weights):
        R, *others = solve_prescribed(8, *start)[:4]
        at = J, factors, h, R[::every], *others, rotor, *feedback
        each = [[w if i == j else None for j in range(5)] for i, w in enumerate(weights)]
        adjoints = [adjoint.propagate_adjoint(at, only) for only in each]
        return adjoint.propagate_tangents(at, given), adjoints

    tangents, adjoints = jax.jit(both)(start, given, weights)
    for weight, tangent, cotangents in zip(weights, tangents, adjoints, strict=True):
        forward = np.vdot(weight, tangent)
        backward = sum(np.vdot(x, y) for x, y in zip(cotangents, given, strict=True))
        size = np.linalg.norm(weight) * np.linalg.norm(tangent)
        assert abs(forward - backward) < 1e-13 * size


def steps_in_a_loop(pi0, J, dt, torques):
    def step(state, torque):
        R, pi = state
        R, pi, _ = lgvi.rigid_body_step(R, pi, J, torque, torque, dt)
        return (R, pi), (R, pi)

    return jax.lax.scan(step, (jnp.asarray(R0), pi0), torques)[1]


def trajectories_in_a_loop(pi0, J, dt, torques):
    def run(state, torques):
        R, pi = state
        Rs, pis, _ = lgvi.simulate_rigid_body(R, pi, J, torques, dt)
        return (Rs[-1], pis[-1]), (Rs, pis)

    return jax.lax.scan(run, (jnp.asarray(R0), pi0), torques.reshape(2, -1, 3))[1]


def pieces(pi0, J, dt, torques):
    return lgvi.simulate_rigid_body(R0, pi0, J, torques, dt)[:2]


def forward_over_reverse(f, x, direction):
    """The gradient and its change along the direction."""
    return jax.jvp(jax.grad(f), (x,), (direction,))


def reverse_over_reverse(f, x, direction):
    def along(x):
        gradient = jax.grad(f)(x)
        return jnp.vdot(gradient, direction), gradient

    change, gradient = jax.grad(along, has_aux=True)(x)
    return gradient, change


@pytest.mark.parametrize(
    ("simulate", "product"),
    [
        pytest.param(steps_in_a_loop, reverse_over_reverse, marks=pytest.mark.slow),
        pytest.param(trajectories_in_a_loop, reverse_over_reverse, marks=pytest.mark.slow),
        (pieces, forward_over_reverse),
    ],
)
def test_second_derivatives_through_loops(simulate, product, set_chunk_sizes):
    # JAX drops some kinds of rules of what is in a loop when it linearises the loop.
    set_chunk_sizes(chunk=3, long=5)
    random = rng(91)
    torques = jnp.asarray(0.1 * random.normal(size=(6, 3)))
    weights = [jnp.asarray(random.normal(size=(12, *x))) for x in ((3, 3), (3,))]

    def scalar(x):
        Rs, pis = simulate(x[:3], jnp.asarray(GENERIC) + jnp.diag(x[3:6]), x[6], x[7] * torques)
        Rs, pis = Rs.reshape(-1, 3, 3), pis.reshape(-1, 3)
        return jnp.sum(weights[0][: len(Rs)] * Rs) + jnp.sum(jnp.sin(weights[1][: len(pis)] + pis))

    x = jnp.asarray(np.concatenate([PI0, np.zeros(3), [0.1, 1.0]]))
    direction = jnp.asarray(random.normal(size=8))
    both, size = jax.jit(lambda x: product(scalar, x, direction)), 1e-4
    (_, actual), (ahead, _), (behind, _) = (both(x + s * size * direction) for s in (0, 1, -1))
    numeric = (ahead - behind) / (2 * size)
    np.testing.assert_allclose(actual, numeric, rtol=0, atol=1e-6 * np.max(np.abs(numeric)))


def test_the_gradient_of_no_bodies():
    def scalar(pi0):
        return jnp.sum(lgvi.simulate_free_rigid_body(R0, pi0, GENERIC, 0.1, 3)[0])

    assert jax.vmap(jax.grad(scalar))(jnp.zeros((0, 3))).shape == (0, 3)


WEIGHT = rng(92).normal(size=(STEPS + 1, 3, 3))


def weighed(*arguments):
    Rs, pis, _ = lgvi.simulate_rigid_body(*arguments)
    return jnp.sum(jnp.asarray(WEIGHT) * Rs) + jnp.sum(jnp.asarray(WEIGHT[:, 0]) * pis)


gradient_of_one = jax.jit(jax.grad(weighed, argnums=range(5)))


ARGUMENTS = ["R0", "pi0", "J", "torques", "dt"]


@pytest.mark.parametrize(
    "varied",
    [
        pytest.param(i, id=name, marks=() if name == "R0" else pytest.mark.slow)
        for i, name in enumerate(ARGUMENTS)
    ],
)
def test_a_batch_of_one_argument_alone(varied):
    torques = 0.1 * rng(93).normal(size=(STEPS + 1, 3))
    arguments = [jnp.asarray(x) for x in (R0, PI0, GENERIC, torques, 0.1)]
    several = [f * arguments[varied] for f in (1.0, 0.9, 1.1)]
    desired = [gradient_of_one(*arguments[:varied], x, *arguments[varied + 1 :]) for x in several]

    axes = [0 if i == varied else None for i in range(5)]
    arguments[varied] = jnp.stack(several)
    of_each = jax.vmap(jax.grad(weighed, argnums=range(5)), axes)

    def total(*arguments):
        return jnp.sum(jax.vmap(weighed, axes)(*arguments))

    each, of_all = jax.jit(lambda *x: (of_each(*x), jax.grad(total, argnums=range(5))(*x)))(
        *arguments
    )
    for i, one in enumerate(zip(*desired, strict=True)):
        size = np.max(np.abs(one))
        np.testing.assert_allclose(each[i], np.stack(one), rtol=0, atol=1e-13 * size)
        shared = one if i == varied else sum(one)
        np.testing.assert_allclose(of_all[i], shared, rtol=0, atol=1e-13 * size)
