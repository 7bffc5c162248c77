r"""The inertia with which a step of order two is one of high order, for a body without torque.

The discrete Moser-Veselov step of a free body follows the exact motion's curve and is late or early
only. So the same step with the inertia

$$\tilde J^{-1} = \alpha J^{-1} + \beta I$$

is of order $p$ if $\alpha$ and $\beta$ are suitable power series in $h^2$, truncated. Of the
motion they need only its energy $H = \tfrac12\pi\cdot J^{-1}\pi$ and $C = \tfrac12\pi\cdot\pi$,
which both the motion and the step conserve; so one inertia serves a whole trajectory.

After McLachlan & Zanna 2005 and Hairer & Vilmart 2006, who go to order ten.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..checks import as_count
from ..kernels import vectors as xyz

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

    The key (b, j, k) stands for $x^{n-b} y^b e_1^i e_2^j e_3^k$ with $x = h^2H$, $y = h^2C$ and
    $e_1, e_2, e_3$ of the inverse inertia: its trace, second invariant and determinant. As
    all terms have the same physical unit, $i + 2j + 3k$ is $n + b$ in alpha, one more in beta.
    """

    denominator: int
    alpha: dict[tuple[int, int, int], int]
    beta: dict[tuple[int, int, int], int]


# fmt: off
_TERMS = [_Terms(*terms) for terms in (
    (6, {
        (0, 0, 0): -2, (1, 1, 0): 1,
    }, {
        (0, 1, 0): 1, (1, 0, 1): -2,
    }),
    (60, {
        (0, 0, 0): 2, (0, 1, 0): -1, (1, 1, 0): -2, (1, 0, 1): 8, (2, 2, 0): 2, (2, 0, 1): -6,
    }, {
        (0, 1, 0): -1, (0, 0, 1): -6, (1, 2, 0): -1, (1, 0, 1): 8, (2, 1, 1): -1,
    }),
    (2520, {
        (0, 0, 0): -4, (0, 1, 0): 4, (0, 0, 1): 72, (1, 1, 0): 6, (1, 2, 0): 41, (1, 0, 1): -212,
        (2, 2, 0): -36, (2, 0, 1): 132, (2, 1, 1): -30, (3, 3, 0): 17, (3, 1, 1): -66,
        (3, 0, 2): 100,
    }, {
        (0, 1, 0): 2, (0, 2, 0): -26, (0, 0, 1): 60, (1, 2, 0): 13, (1, 0, 1): -64, (1, 1, 1): 110,
        (2, 3, 0): 2, (2, 1, 1): -2, (2, 0, 2): -176, (3, 2, 1): -19, (3, 0, 2): 72,
    }),
    (45360, {
        (0, 0, 0): 2, (0, 1, 0): -3, (0, 2, 0): 153, (0, 0, 1): -486, (1, 1, 0): -4,
        (1, 2, 0): -264, (1, 0, 1): 1104, (1, 1, 1): -828, (2, 2, 0): 156, (2, 3, 0): 18,
        (2, 0, 1): -612, (2, 1, 1): 180, (2, 0, 2): 1908, (3, 3, 0): -154, (3, 1, 1): 612,
        (3, 2, 1): 282, (3, 0, 2): -2256, (4, 4, 0): 62, (4, 2, 1): -342, (4, 0, 2): 378,
        (4, 1, 2): 291,
    }, {
        (0, 1, 0): -1, (0, 2, 0): -6, (0, 0, 1): -126, (0, 1, 1): 459, (1, 2, 0): -30,
        (1, 3, 0): 194, (1, 0, 1): 128, (1, 1, 1): -552, (1, 0, 2): -1296, (2, 3, 0): -30,
        (2, 1, 1): 114, (2, 2, 1): -798, (2, 0, 2): 2136, (3, 4, 0): -1, (3, 2, 1): 222,
        (3, 0, 2): -864, (3, 1, 2): 684, (4, 3, 1): -61, (4, 1, 2): 243, (4, 0, 3): -610,
    }),
    (4989600, {
        (0, 0, 0): -4, (0, 1, 0): 8, (0, 2, 0): -1638, (0, 0, 1): 10044, (0, 1, 1): -15282,
        (1, 1, 0): 10, (1, 2, 0): 5241, (1, 3, 0): -7339, (1, 0, 1): -21124, (1, 1, 1): 31338,
        (1, 0, 2): 59508, (2, 2, 0): -2776, (2, 3, 0): -360, (2, 0, 1): 11064, (2, 1, 1): -3852,
        (2, 2, 1): 45924, (2, 0, 2): -167256, (3, 3, 0): 4154, (3, 4, 0): 2759, (3, 1, 1): -16596,
        (3, 2, 1): -39228, (3, 0, 2): 145320, (3, 1, 2): -45948, (4, 4, 0): -4148,
        (4, 2, 1): 24876, (4, 3, 1): 3494, (4, 0, 2): -33156, (4, 1, 2): -30372, (4, 0, 3): 68000,
        (5, 5, 0): 1382, (5, 3, 1): -9672, (5, 1, 2): 16578, (5, 2, 2): 11067, (5, 0, 3): -33300,
    }, {
        (0, 1, 0): 2, (0, 2, 0): -1110, (0, 3, 0): 4338, (0, 0, 1): 1020, (0, 1, 1): -4266,
        (0, 0, 2): -16848, (1, 2, 0): 251, (1, 3, 0): -774, (1, 0, 1): -1024, (1, 1, 1): 12198,
        (1, 2, 1): -48285, (1, 0, 2): 63288, (2, 3, 0): 876, (2, 4, 0): -4380, (2, 1, 1): -3484,
        (2, 2, 1): 31128, (2, 0, 2): -81984, (2, 1, 2): 107172, (3, 4, 0): 251, (3, 2, 1): -8790,
        (3, 3, 1): 12444, (3, 0, 2): 31104, (3, 1, 2): -45960, (3, 0, 3): -110664, (4, 5, 0): 2,
        (4, 3, 1): 3626, (4, 1, 2): -14526, (4, 2, 2): -20730, (4, 0, 3): 94596, (5, 4, 1): -1384,
        (5, 2, 2): 8559, (5, 0, 3): -12096, (5, 1, 3): -3270,
    }),
)]
# fmt: on


def series(order: int, H: Any, C: Any, e1: Any, e2: Any, e3: Any) -> list[tuple[Any, Any]]:
    """Coefficients of $h^2, h^4, \\dots$ in alpha and in beta, for numbers of any kind."""
    powers = [[1, x] for x in (H, C, e1, e2, e3)]
    for known in powers:
        for _ in range(order - 2):
            known.append(known[-1] * known[1])

    def total(n, weight, terms):
        products = []
        for (b, j, k), product in terms.items():
            i = n + b + weight - 2 * j - 3 * k
            for known, exponent in zip(powers, (n - b, b, i, j, k), strict=True):
                product = product * known[exponent] if exponent else product
            products.append(product)
        return sum(products[1:], start=products[0])

    return [
        (total(n, 0, terms.alpha) / terms.denominator, total(n, 1, terms.beta) / terms.denominator)
        for n, terms in enumerate(_TERMS[: order // 2 - 1], start=1)
    ]


def modified_inertia(J: Array, pi: Array, h: Array, order: int) -> Array:
    """Inertia (*steps, 3, 3) for steps `h` (*steps,) of a free body with momentum `pi`.

    It has the unit of `J`, and is not the inertia of a body.
    """
    trace = jax.lax.stop_gradient(jnp.trace(J))
    return trace * _modified(order, J / trace, pi / trace, h)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _modified(order: int, J: Array, p: Array, h: Array) -> Array:
    """The same for an inertia of about unit trace."""
    return _combined(_factors(order, *_invariants(J, p)[0], h), _powers(J))


@_modified.defjvp
def _(order, primals, tangents):
    """Through the few numbers on which the factors depend: a short program, as is its transpose."""
    (J, p, h), (dJ, dp, dh) = primals, tangents
    numbers, (adjugate, solved) = _invariants(J, p)
    ds1 = jnp.trace(dJ)
    dnumbers = (
        ds1,
        numbers[0] * ds1 - jnp.sum(J * dJ),
        jnp.sum(adjugate * dJ),
        jnp.dot(solved, dp) - jnp.sum(solved[:, None] * dJ * solved[None]) / 2,
        jnp.dot(p, dp),
        dh,
    )
    numbers, change = (*numbers, h), jnp.zeros((3, *h.shape), J.dtype)
    factors = _factors(order, *numbers)
    units = [
        jnp.broadcast_to(jnp.expand_dims(unit, range(1, 1 + x.ndim)), (6, *x.shape))
        for unit, x in zip(jnp.eye(6, dtype=J.dtype), numbers, strict=True)
    ]
    partials = jax.vmap(lambda *along: jax.jvp(partial(_factors, order), numbers, along)[1])(*units)
    for by, along in zip(partials, dnumbers, strict=True):
        change += by * jnp.expand_dims(along, range(by.ndim - along.ndim))
    powers, dpowers = jax.jvp(_powers, (J,), (dJ,))
    return _combined(factors, powers), _combined(change, powers) + _combined(factors, dpowers)


def _invariants(J: Array, p: Array):
    """Trace, second invariant and determinant of J, H and C; and the adjugate of J, and J^-1 p."""
    x, y, z = xyz.split_matrix(J)
    columns = xyz.cross(y, z), xyz.cross(z, x), xyz.cross(x, y)
    s1, s3 = jnp.trace(J), xyz.dot(x, columns[0])
    s2 = (s1 * s1 - jnp.sum(J * J)) / 2
    adjugate = xyz.join_matrix(xyz.transpose(columns))
    solved = xyz.matmul(adjugate, p) / s3
    return (s1, s2, s3, jnp.dot(p, solved) / 2, jnp.dot(p, p) / 2), (adjugate, solved)


def _factors(order: int, s1, s2, s3, H, C, h: Array) -> Array:
    """Factors (3, *steps) of 1, tr(J) J - J^2 and J in the modified inertia."""
    pairs = series(order, H, C, s2 / s3, s1 / s3, 1 / s3)
    # Else XLA would compute them anew for every step.
    coefficients = jax.lax.optimization_barrier(jnp.stack([jnp.stack(pair) for pair in pairs]))
    square, alpha, beta = h * h, jnp.ones_like(h), jnp.zeros_like(h)
    power = jnp.ones_like(h)
    for of_alpha, of_beta in coefficients:
        power = power * square
        alpha, beta = alpha + of_alpha * power, beta + of_beta * power
    # J (alpha + beta J)^-1 by Cayley and Hamilton, without J^-1, which a thin body would spoil.
    determinant = alpha**3 + alpha**2 * beta * s1 + alpha * beta**2 * s2 + beta**3 * s3
    factors = jnp.stack([beta**2 * s3, alpha * beta, alpha**2])
    # A barrier here too: else each of nine entries would have factors of its own.
    return jax.lax.optimization_barrier(factors / determinant[None])


def _powers(J: Array) -> list[Array]:
    one = jnp.eye(3, dtype=J.dtype)
    return [one, xyz.matmul(J, jnp.trace(J) * one - J), J]


def _combined(factors: Array, powers: list[Array]) -> Array:
    of_one, of_square, of_itself = (
        jnp.expand_dims(factor, (-2, -1)) * jnp.expand_dims(power, range(factor.ndim))
        for factor, power in zip(factors, powers, strict=True)
    )
    return of_one + of_square + of_itself


def turns_less_than_a_right_angle(J: Array, pi: Array, h: Array) -> Array:
    """Whether the modified inertia is of use for steps `h` (*steps,) with `pi` (*steps, 3).

    The discrete equation has no solution that turns by more. From there on, that of the
    modified inertia is another one, which has nothing to do with the motion.
    """
    trace = jnp.trace(J)
    turn = xyz.solve(xyz.split_matrix(J / trace), xyz.scale(h / trace, xyz.split(pi)))
    return xyz.dot(turn, turn) < (jnp.pi / 2) ** 2
