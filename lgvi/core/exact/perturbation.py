r"""How the motion changes where the principal axes turn.

The axes of two nearly equal moments turn far for a small change of the inertia, while the motion
hardly changes. So the entries $b_{ij}$ of the change of $J^{-1}$ beside the diagonal, in principal
axes, are taken as a perturbation $\sum b_{ij}\pi_i\pi_j$ of the energy. Up to a time $t$ it changes
the state as its integral over the time before does, taken as an energy, in unit time:

$$\delta R = R\,\hat\xi,\quad \delta\pi = \pi\times\xi,\quad
  \xi = \sum b_{ij}\,\nabla_\pi\int_{-t}^0\pi_i\pi_j\,d\tau,$$

where the integral is $(\pi_k(0) - \pi_k(-t))/\alpha_k$, a function of the momentum at the end.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.vectors import Mat3, Vec3
from .axes import arranged, swapped
from .constants import roots_of
from .sigma import clock_of, lattice_of, sigma_functions


def turn_by_products(moments: Vec3, pi0: Vec3, pi: Vec3, t: Array, entries: Vec3) -> Vec3:
    """The vector xi at times `t`, in principal axes, for the entries b_12, b_20, b_01.

    For ascending moments, the momentum `pi0` at time zero, and `pi` at times `t`.
    """
    order = arranged(moments, pi0)
    lattice, first, second = roots_of(order)[:3]

    def functions(first, second):
        lattice_now = lattice_of(lattice.hyperbolic, first, second)
        return sigma_functions(lattice_now, clock_of(lattice_now, order.scale * t))

    now = functions(first, second)
    one, zero = jnp.ones_like(first), jnp.zeros_like(first)
    by_first = jax.jvp(functions, (first, second), (one, zero))[1]
    by_second = jax.jvp(functions, (first, second), (zero, one))[1]

    a_h, a_l, pi = order.a_h, order.a_l, swapped(order.swap, pi)
    h, m, l = pi  # noqa: E741
    none, one = jnp.zeros_like(h), jnp.ones_like(h)
    # Gradients of the two differences of roots, which are constant along the motion.
    of_first = Vec3(2 * a_l * h, none, -2 * a_h * l)
    of_second = Vec3(none, 2 * a_h * a_l * m, 2 * a_h * l)
    units = Mat3(Vec3(one, none, none), Vec3(none, one, none), Vec3(none, none, one))

    def integrals(pi, functions):
        return _integrals(pi, order.alpha, a_l, *functions)

    def derivative(unit, of_first, of_second):
        change = jax.tree.map(lambda x, y: of_first * x + of_second * y, by_first, by_second)
        return jax.jvp(integrals, (pi, now), (unit, change))[1]

    entries = order.sign / order.scale * swapped(order.swap, entries)
    derivatives = map(derivative, units, of_first, of_second)
    return order.restored(Vec3(*(entries.dot(of_integrals) for of_integrals in derivatives)))


def _integrals(pi: Vec3, alpha: Vec3, a_l: Array, S: Array, C: Vec3) -> Vec3:
    """Of pi_i pi_j from -t to 0: (pi_k(0) - pi_k(-t)) / alpha_k, also where alpha_k is small."""
    D = C.x * C.x + a_l * pi.x**2 * S * S
    square, product_of_alpha = S * S / D, alpha.x * alpha.y * alpha.z

    def integral(k, i, j):
        x, y, product = pi[i] ** 2, pi[j] ** 2, C[i] * C[j] / D
        # (product^2 - 1) / alpha_k; where the product is negative, alpha_k is not small.
        rest = square * (alpha[j] * x + alpha[i] * y) + square**2 * (product_of_alpha * x * y)
        plus = product > 0
        rest = jnp.where(plus, rest / jnp.where(plus, product + 1, 1), (product - 1) / alpha[k])
        return S * C[k] / D * (pi[i] * pi[j]) - pi[k] * rest

    return Vec3(integral(0, 1, 2), integral(1, 2, 0), integral(2, 0, 1))
