r"""A body with a wheel that friction couples to it, by the implicit midpoint rule.

The total momentum $\pi$ and the axial momentum $k$ of a wheel with spin inertia $I$ about the axis
$a$ have the energy, with the inertia $J'$ of the body without that of the wheel about its axis,

$$T = \tfrac12(\pi - ka)\cdot J'^{-1}(\pi - ka) + \tfrac{k^2}{2I},$$

of which $\omega = \partial T/\partial\pi$ is the angular velocity of the body, and
$\Omega = \partial T/\partial k$ the speed of the wheel relative to the body. Friction is
$\dot k = -f\,\Omega$. With all that is on the right at the middle of a step,

$$\pi_{n+1} - \pi_n = h\,\pi\times\omega,\qquad k_{n+1} - k_n = -hf\,\Omega.$$

As $T$ is quadratic, its change is exactly $-hf\,\Omega^2$. With the Rodrigues vector
$x = h\omega/2$ of the rotation of a step, $F = \operatorname{cay}(x)$, the first equation is
$\pi_{n+1} = F^T\pi_n$, so that $R\pi$ is kept exactly, and what is left to solve is the quadratic

$$y + x\times y = \pi_n,\qquad y = \tfrac2h\bigl(J' + \kappa\,aa^T\bigr)x + \tfrac{k_n}{1+s}\,a,
\qquad s = \tfrac{hf}{2I},\quad \kappa = \tfrac{Is}{1+s},$$

where $y$ is the momentum at the middle.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.quaternions import Quaternion, rotate_rows
from ..kernels.vectors import Mat3, Vec3

ITERATIONS = 6  # of Newton's method, from the solution for a slow turn
MARGIN = 100.0  # multiple of the rounding unit that a residual may be, over the momentum
LARGEST = 1.0  # of the Rodrigues vector of a step: a quarter of a turn


class DampedStates(NamedTuple):
    """States (states, ...), and whether the steps to each of them from the one before converged."""

    R: Array
    pi: Array
    wheel: Array  # axial momentum of the wheel
    converged: Array


@partial(jax.jit, static_argnames=("steps", "save_every"))
def simulate_damped(
    R0: Array,
    pi0: Array,
    wheel0: Array,
    J: Array,
    axis: Array,
    wheel_inertia: Array,
    friction: Array,
    h: Array,
    steps: int,
    save_every: int,
) -> DampedStates:
    """The initial state, and one of every `save_every` states.

    `J` is the inertia without that of the wheel about its axis, and `axis` has length one.
    """
    # Of unit trace, so that no product of moments underflows.
    scale = jnp.trace(J)
    J, pi0, wheel0, I, friction = (  # noqa: E741
        x / scale for x in ((J + J.T) / 2, pi0, wheel0, wheel_inertia, friction)
    )
    a = Vec3.of(axis)
    s = h * friction / (2 * I)
    M = 2 / h * (Mat3.of(J) + I * s / (1 + s) * a.outer(a))

    def step(state, _):
        q, pi, k, converged = state
        b = k / (1 + s) * a
        x = M.solve(pi - b)
        for _ in range(ITERATIONS):
            y = M @ x + b
            jacobian = (M - M.cross(x).T).plus_hat(-1.0 * y)
            x = x - jacobian.solve(y + x.cross(y) - pi)
        y = M @ x + b
        left = y + x.cross(y) - pi
        bound = MARGIN * jnp.finfo(k.dtype).eps * (pi.norm() + b.norm())
        solved = (left.norm() <= bound) & (x.norm() < LARGEST)
        w = jax.lax.rsqrt(1 + x.dot(x))
        q = q * Quaternion(w, w * x)
        middle = (k + I * s * (2 / h) * a.dot(x)) / (1 + s)
        return (q, Quaternion(1.0, x).rotate_back(pi), 2 * middle - k, converged & solved), None

    def stored(state, _):
        state, _ = jax.lax.scan(step, (*state[:3], jnp.array(True)), length=save_every)
        return state, state

    zero = jnp.zeros_like(wheel0)
    start = Quaternion(zero + 1, Vec3(zero, zero, zero)), Vec3.of(pi0), wheel0, jnp.array(True)
    _, states = jax.lax.scan(stored, start, length=steps // save_every)
    q, pi, k, converged = jax.tree.map(lambda x, y: jnp.append(x, y), start, states)
    return DampedStates(rotate_rows(R0[None], q), scale * pi.array(), scale * k, converged[1:])
