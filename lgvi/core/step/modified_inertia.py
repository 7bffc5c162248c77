r"""The modified inertia, which gives a step of order two a high order, for a body without torque.

The momentum of a free body after a discrete Moser-Veselov step lies on the curve of the exact
motion. The only errors are in time and in a rotation about the spatial momentum. So the same step
with the inertia

$$\tilde J^{-1} = \alpha J^{-1} + \beta I$$

is of order $p$ if $\alpha$ and $\beta$ are suitable power series in $h^2$, truncated. They are
constant along the motion and along the steps; so one inertia serves a whole trajectory. After
McLachlan & Zanna 2005 and Hairer & Vilmart 2006, who go to order ten.

Their series are in the invariants of $J^{-1}$, which are large for a thin body and cancel. Here all
terms are at most about one for every physical body, however thin. With the unit of inertia
$\operatorname{tr} J = 1$ and the discrete inertia $J_d = I/2 - J$ the variables are

$$u = 2\pi\cdot\omega,\quad w = \frac{\omega\cdot J J_d\,\omega}{2\det J},\quad
s = 4\det J,\quad q = \frac{\det J_d}{4(\det J)^2},\quad r = 1 + qs,$$

of which $u$ and $w$ are constant along the motion.
"""

from functools import partial, reduce
from operator import mul
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..kernels.finite import finite, finite_matrix
from ..kernels.vectors import Mat3, Vec3, matmul
from ..typed_arrays import as_count

ORDERS = 2, 4, 6, 8, 10, 12


def as_order(order: int) -> int:
    """Check a static order.

    Raises
    ------
    TypeError
        If `order` is not an integer known while tracing.
    ValueError
        If it is not one of `ORDERS`.
    """
    order = as_count("order", order, 2)
    if order not in ORDERS:
        raise ValueError(f"Argument `order` must be one of {ORDERS}, but is {order}.")
    return order


class _Terms(NamedTuple):
    """Terms of order $h^{2n}$ of alpha and beta, over a common denominator.

    The key (b, i, j) stands for $u^{n-b} w^b r^i s^j$, with $q^{-j}$ for $s^j$ where j is negative.
    """

    denominator: int
    alpha: dict[tuple[int, int, int], int]
    beta: dict[tuple[int, int, int], int]


# fmt: off
_TERMS = [_Terms(*terms) for terms in (
    (6, {
        (0, 1, 0): -1, (1, 0, 0): -1,
    }, {
        (1, 0, 0): 2,
    }),
    (240, {
        (0, 0, -1): -3, (0, 2, 0): 2, (1, 0, 0): -8, (1, 1, 0): 16, (2, 0, 0): 2, (2, 1, 1): -12,
    }, {
        (0, 0, -1): 6, (1, 1, 0): -16, (2, 0, 0): -4,
    }),
    (10080, {
        (0, 0, -1): -18, (0, 1, -1): 33, (0, 3, 0): -2, (1, 0, -1): 33, (1, 1, 0): 106,
        (1, 2, 0): -138, (2, 0, 0): 120, (2, 1, 0): -138, (2, 2, 1): 132, (3, 0, 0): -2,
        (3, 0, 1): -100, (3, 1, 1): 132,
    }, {
        (0, 1, -1): -30, (1, 0, -1): -66, (1, 2, 0): 64, (2, 0, 0): -176, (2, 1, 0): 212,
        (3, 0, 0): 4, (3, 1, 1): -144,
    }),
    (1451520, {
        (0, 0, -2): 189, (0, 1, -1): 486, (0, 2, -1): -612, (0, 4, 0): 4, (1, 0, -1): 2160,
        (1, 1, -1): -2736, (1, 2, 0): -2208, (1, 3, 0): 2464, (2, 0, -1): -612, (2, 0, 0): 3816,
        (2, 1, 0): -12816, (2, 2, 0): 9456, (2, 3, 1): -2448, (3, 0, 0): -2400, (3, 1, 0): 2464,
        (3, 1, 1): 9024, (3, 2, 1): -10944, (4, 0, 0): 4, (4, 0, 1): 2328, (4, 1, 1): -2448,
        (4, 2, 2): 3024,
    }, {
        (0, 0, -2): -378, (0, 2, -1): 252, (1, 0, -1): -2592, (1, 1, -1): 3744, (1, 3, 0): -512,
        (2, 0, -1): 1224, (2, 1, 0): 8544, (2, 2, 0): -9456, (3, 0, 0): 4288, (3, 1, 0): -4416,
        (3, 2, 1): 6912, (4, 0, 0): -8, (4, 0, 1): -4880, (4, 1, 1): 3888,
    }),
    (159667200, {
        (0, 0, -2): 7236, (0, 1, -2): -8289, (0, 2, -1): -5022, (0, 3, -1): 5532, (0, 5, 0): -4,
        (1, 0, -2): -8289, (1, 0, -1): 29754, (1, 1, -1): -106164, (1, 2, -1): 82908,
        (1, 3, 0): 21124, (1, 4, 0): -22148, (2, 0, -1): -74376, (2, 1, -1): 82908,
        (2, 1, 0): -167256, (2, 2, 0): 428256, (2, 3, 0): -265360, (2, 4, 1): 22128,
        (3, 0, -1): 5532, (3, 0, 0): -180104, (3, 1, 0): 442248, (3, 2, 0): -265360,
        (3, 2, 1): -290640, (3, 3, 1): 331632, (4, 0, 0): 22048, (4, 0, 1): 136000,
        (4, 1, 0): -22148, (4, 1, 1): -454488, (4, 2, 1): 331632, (4, 3, 2): -132624,
        (5, 0, 0): -4, (5, 0, 1): -21936, (5, 1, 1): 22128, (5, 1, 2): 133200, (5, 2, 2): -132624,
    }, {
        (0, 0, -2): -8424, (0, 1, -2): 10530, (0, 3, -1): -1020, (1, 0, -2): 16578,
        (1, 1, -1): 63288, (1, 2, -1): -76284, (1, 4, 0): 2048, (2, 0, -1): 117648,
        (2, 1, -1): -134712, (2, 2, 0): -163968, (2, 3, 0): 172688, (3, 0, -1): -11064,
        (3, 0, 0): 221328, (3, 1, 0): -572928, (3, 2, 0): 358032, (3, 3, 1): -124416,
        (4, 0, 0): -42048, (4, 1, 0): 42248, (4, 1, 1): 378384, (4, 2, 1): -358128, (5, 0, 0): 8,
        (5, 0, 1): 26160, (5, 1, 1): -40176, (5, 2, 2): 96768,
    }),
)]
# fmt: on


class Series(NamedTuple):
    """Sums of products of powers of u, w, r, s and q."""

    exponents: np.ndarray  # (products, 5)
    numerators: np.ndarray  # of $h^2, h^4, \\dots$ in alpha and in beta (2, order/2 - 1, products)
    denominators: np.ndarray  # (order/2 - 1,)


def series(order: int) -> Series:
    """The coefficients of alpha and beta up to an order."""
    terms = _TERMS[: order // 2 - 1]
    products = [(n, key) for n, power in enumerate(terms) for key in power.alpha | power.beta]
    exponents = [(n + 1 - b, b, i, max(j, 0), max(-j, 0)) for n, (b, i, j) in products]
    numerators = np.zeros((2, len(terms), len(products)), int)
    for column, (n, key) in enumerate(products):
        numerators[:, n, column] = terms[n].alpha.get(key, 0), terms[n].beta.get(key, 0)
    denominators = np.array([power.denominator for power in terms])
    return Series(np.array(exponents), numerators, denominators)


def modified_inertia(J: Array, pi: Array, h: Array, order: int) -> Array:
    """Inertia (*steps, 3, 3) for steps `h` (*steps,) of a free body with momentum `pi`.

    The result has the unit of `J`, and need not be the inertia of a body.
    """
    factors, powers = modified_inertia_terms(J, pi, h, order)
    of_one, of_square, of_itself = (
        jnp.expand_dims(factor, (-2, -1)) * jnp.expand_dims(power, range(factor.ndim))
        for factor, power in zip(factors, powers, strict=True)
    )
    return of_one + of_square + of_itself


def modified_inertia_terms(J: Array, pi: Array, h: Array, order: int) -> tuple[Array, Array]:
    """Factors (3, *steps) of matrices (3, 3, 3) whose sum is the modified inertia.

    The matrices are 1, tr(J) J - J^2 and J, of unit trace.
    """
    # Free of units, so that nothing overflows: the longest turn takes the place of the rate.
    trace, longest = jax.lax.stop_gradient((jnp.trace(J), jnp.max(jnp.abs(h))))
    trace = jnp.where(jnp.isfinite(trace) & (trace != 0), trace, 1)
    longest = jnp.where(jnp.isfinite(longest) & (longest > 0), longest, 1)
    factors, powers = _terms(order, J / trace, pi * (longest / trace), h / longest)
    return trace * factors, powers


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _terms(order: int, J: Array, p: Array, h: Array) -> tuple[Array, Array]:
    """The same for an inertia of unit trace."""
    variables, _ = _variables(J, p)
    products, _ = _products(order, variables)
    return _factors(_coefficients(order, products), variables, h), _powers(J)


@_terms.defjvp
def _(order, primals, tangents):
    """Through the few numbers on which the factors depend: derivative and transpose are short."""
    (J, p, h), (dJ, dp, dh) = (finite_matrix(primals[0]), *map(finite, primals[1:])), tangents
    # Homogeneous of degree one in J and p: what changes the trace is taken apart. `trace`
    # is one, whatever J is, but has the derivative of the trace, which second derivatives need.
    trace = jnp.trace(J)
    trace = 1 + (trace - jax.lax.stop_gradient(trace))
    growth = jnp.trace(dJ) / trace
    dJ, dp = (dJ - growth * J) / trace, (dp - growth * p) / trace
    J, p = J / trace, p / trace
    variables, (omega, of_discrete, adjugates) = _variables(J, p)
    _, w, _, s, q = variables
    determinant, v = s / 4, of_discrete / s  # v = J_d omega / (4 det J)
    spin = jnp.dot(omega, jnp.sum(dJ * omega[None], axis=1))
    of_J, of_Jd = (jnp.sum(adjugate * dJ) for adjugate in adjugates)
    relative = of_J / determinant
    du, dw = 4 * jnp.dot(omega, dp) - 2 * spin, 4 * jnp.dot(v, dp) - spin / s - w * relative
    ds, dq = 4 * of_J, -of_Jd / determinant / s - 2 * q * relative
    dvariables = jnp.stack([du, dw, q * ds + s * dq, ds, dq])
    products, slopes = _products(order, variables)
    dproducts = jnp.sum(slopes * dvariables[:, None], axis=0)
    coefficients, dcoefficients = (_coefficients(order, x) for x in (products, dproducts))
    factors, change = jax.jvp(
        _factors, (coefficients, variables, h), (dcoefficients, dvariables, dh)
    )
    factors, change = trace * factors, trace * (change + growth * factors)
    of_J, of_p, valid = map(jnp.isfinite, primals)
    valid &= jnp.all(of_J) & jnp.all(of_p) & jnp.any(primals[0] != 0)
    powers, dpowers = jax.jvp(_powers, (J,), (dJ,))
    return (jnp.where(valid[None], factors, jnp.nan), powers), (change, dpowers)


def _variables(J: Array, p: Array):
    """The variables u, w, r, s, q of the series (5,), for an inertia of unit trace.

    And omega, J_d omega, and the adjugates of J and J_d, of which the derivatives are made.
    """
    J_, p_ = Mat3.of(J), Vec3.of(p)
    Jd = _discrete_inertia(J_)
    (adjugate, det), (adjugate_d, det_d) = _adjugate(J_), _adjugate(Jd)
    omega = 1 / det * (adjugate @ p_)
    of_discrete = Jd @ omega
    s, q = 4 * det, det_d / det / (4 * det)
    variables = [2 * p_.dot(omega), p_.dot(of_discrete) / (2 * det), 1 + q * s, s, q]
    adjugates = adjugate.array(), adjugate_d.array()
    return jnp.stack(variables), (omega.array(), of_discrete.array(), adjugates)


def _adjugate(S: Mat3) -> tuple[Mat3, Array]:
    """Adjugate and determinant of a symmetric matrix."""
    adjugate = S.adjugate()
    return adjugate, S.x.dot(adjugate.x)


def _discrete_inertia(J: Mat3) -> Mat3:
    """The same as in `inertia.py`, but of full accuracy along the axis of a thin body too."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = J

    def entry(moment, x, y):  # The first difference is exact where the result is small.
        return (jnp.maximum(x, y) - moment + jnp.minimum(x, y)) / 2

    return Mat3(
        Vec3(entry(xx, yy, zz), -xy, -xz),
        Vec3(-xy, entry(yy, zz, xx), -yz),
        Vec3(-xz, -yz, entry(zz, xx, yy)),
    )


def _products(order: int, variables: Array) -> tuple[Array, Array]:
    """The products of powers (n,), and their derivatives with respect to each variable (5, n)."""
    exponents = series(order).exponents.T
    x, highest = variables[:, None], exponents.max()

    def powers(exponents):  # not by indices: a batch of them is slow to collect
        return reduce(mul, (jnp.where(exponents > n, x, 1) for n in range(highest)))

    factors = powers(exponents)
    slopes = jnp.asarray(exponents, x.dtype) * powers(exponents - 1)
    # The factors of each derivative, in which one is replaced by its slope.
    replaced = jnp.where(np.eye(5, dtype=bool)[:, :, None], slopes[:, None], factors[:, None])
    return reduce(mul, factors), reduce(mul, replaced)


def _coefficients(order: int, products: Array) -> Array:
    """Coefficients of $h^2, h^4, \\dots$ in alpha and in beta (2, order/2 - 1)."""
    _, numerators, denominators = series(order)
    weights = jnp.asarray(numerators / denominators[:, None], products.dtype)
    return jnp.sum(weights * products[None, None], axis=-1)


def _factors(coefficients: Array, variables: Array, h: Array) -> Array:
    """Factors (3, *steps) of 1, tr(J) J - J^2 and J in the modified inertia."""
    # Else XLA would compute them anew for every step.
    coefficients, (_, _, r, s, _) = jax.lax.optimization_barrier((coefficients, variables))
    square, alpha, beta = h * h, jnp.ones_like(h), jnp.zeros_like(h)
    power = jnp.ones_like(h)
    for of_alpha, of_beta in coefficients.T:
        power = power * square
        alpha, beta = alpha + of_alpha * power, beta + of_beta * power
    # J (alpha + beta J)^-1 by Cayley and Hamilton, without J^-1, which a thin body would spoil.
    second, third = 0.25 + s * r / 2, s / 4  # invariants of J
    determinant = alpha**3 + alpha**2 * beta + alpha * beta**2 * second + beta**3 * third
    factors = jnp.stack([beta**2 * third, alpha * beta, alpha**2])
    # A barrier here too: else each of nine entries would have factors of its own.
    return jax.lax.optimization_barrier(factors / determinant[None])


def _powers(J: Array) -> Array:
    one = jnp.eye(3, dtype=J.dtype)
    return jnp.stack([one, matmul(J, jnp.trace(J) * one - J), J])


def turns_less_than_a_right_angle(J: Array, pi: Array, h: Array) -> Array:
    """Whether the modified inertia is valid for steps `h` (*steps,) with `pi` (*steps, 3).

    The discrete equation has no solution that turns by more. For larger steps the equation with
    the modified inertia has another solution, which is unrelated to the motion.
    """
    trace = jnp.trace(J)
    turn = Mat3.of(J / trace).solve(h / trace * Vec3.of(pi))
    return turn.dot(turn) < (jnp.pi / 2) ** 2
