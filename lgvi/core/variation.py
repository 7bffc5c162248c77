r"""Tangents of a trajectory and their adjoints, from the linearised equation of each step.

A variation of the motion is $d\pi$ and $\xi = \operatorname{vee}(R^T dR)$ before each step, in
the body frame. With $p = h\pi$, $A = \partial r/\partial c$ of the divided equation and
$\eta = \operatorname{vee}(dF\,F^T)$ of the step,

$$\eta = \tfrac{2}{1+c\cdot c}(I+\hat c)A^{-1}\bigl[\tfrac12 D\,dp - dJ\,c\bigr],\qquad
  D = I-\hat c+cc^T,$$
$$\xi' = F^T(\xi + \eta),\qquad d\pi' = F^T(d\pi + \pi\times\eta) + d(\text{impulse}).$$

With $T$ for the matrix from $d\pi$ to $\eta$ and $\bar\xi$, $\bar\pi$ for the cotangents of
the states, the adjoint variables $\chi$ of $\xi$ and $\lambda$ of $d\pi$ run backwards from zero:

$$\chi = \bar\xi + F\chi',\qquad
  \lambda = \bar\pi + F\lambda' + T^T\bar\eta,\qquad \bar\eta = F\chi' + F\lambda'\times\pi.$$

All else is done in passes over all steps and bodies at once.
"""

from collections.abc import Sequence
from functools import partial
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from . import components as xyz
from . import equation, rotations
from .components import Vector
from .primitives import Arrays, linear
from .reduction import with_empty_step, with_value_of_empty_step

# Numbers of each component, over steps and bodies, that the adjoint treats at once: few enough
# for all that it computes from them to stay in the cache.
AT_ONCE = 32768


def motion_tangents(at: Arrays, given: Arrays) -> Arrays:
    """Tangents of R, pi, q and c for those of R0, pi0, J, h, rotors and, if any, impulses."""
    J, h, R, pi, q, c, rotor = at
    dR0, dpi0, dJ, dh, drotor, *impulses = given
    rotor, drotor = (_vectors(x) for x in (rotor, drotor))
    J, dJ, h, dh = _over_trace(J, J, dJ, h, dh)
    J, dJ = (xyz.split_matrix(with_value_of_empty_step(x), axis=1) for x in (J, dJ))
    g, dg = with_empty_step(h), with_empty_step(dh)
    pi, q, c = xyz.split(pi, axis=1), rotations.split(q, axis=1), xyz.split(c, axis=1)
    r = rotor and xyz.scale(g, rotor)
    inverse = xyz.inverse(equation.jacobian(J, xyz.scale(g, pi), c, r))

    def turn(right: Vector) -> Vector:
        dc = xyz.apply(inverse, right)
        return xyz.scale(2 / (1 + xyz.dot(c, c)), xyz.add(dc, xyz.cross(c, dc)))

    def momentum(dpi, step):
        T, c, pi, source = step
        turned = xyz.add(dpi, xyz.cross(pi, xyz.apply(T, dpi)))
        return xyz.add(rotations.turn_back(c, turned), source), dpi

    def attitude(xi, step):
        c, eta = step
        return rotations.turn_back(c, xyz.add(xi, eta)), xi

    axes = xyz.unit_vectors(dpi0.dtype)
    x, y, z = (turn(xyz.scale(0.5 * g, equation.divided(c, axis))) for axis in axes)
    T = xyz.transpose((x, y, z))
    right = xyz.subtract(xyz.scale(0.5 * dg, equation.divided(c, pi, rotor)), xyz.apply(dJ, c))
    if drotor is not None:
        right = xyz.add(right, xyz.scale(0.5 * g, equation.by_rotor(c, drotor)))
    known = turn(right)
    source = rotations.turn_back(c, xyz.cross(pi, known))
    for dimpulses in impulses:
        source = xyz.add(source, xyz.split(with_empty_step(dimpulses), axis=1))
    _, dpi = jax.lax.scan(momentum, xyz.split(dpi0, axis=0), (T, c, pi, source))
    eta = xyz.add(xyz.apply(T, dpi), known)
    start = xyz.split(jnp.zeros_like(dpi0), axis=0)
    _, xi = jax.lax.scan(attitude, start, (c, eta))
    dR = rotations.turn_rows(dR0[None], q)
    dR += xyz.join_matrix(xyz.cross_rows(xyz.split_matrix(R, axis=1), xi), axis=1)
    # The tangents of q and c serve derivatives of this rule.
    dq = rotations.scale(0.5, rotations.multiply(q, (0.0, xi)))
    dc = xyz.scale(0.5, equation.divided(c, eta))
    return dR, xyz.join(dpi, axis=1), rotations.join(dq, axis=1), xyz.join(dc, axis=1)


def motion_adjoint(at: Arrays, cotangents: Sequence[Array | None]) -> Arrays:
    """Cotangents of R0, pi0, J, h, rotors and impulses for those of R, pi, q, c, None if zero."""
    J, h, R, pi, q, c, rotor = at
    some = jax.tree.leaves(cotangents)[0]
    batch = some.shape[some.ndim - (J.ndim - 3) :]
    unit, g = _over_trace(J, J, h)
    R_bar, pi_bar, q_bar, c_bar = cotangents
    q = rotations.split(q, axis=1)
    xi_bar = _by_turning(R, q, R_bar, q_bar)
    of_steps = None if len(J) == 1 else with_value_of_empty_step(unit)
    of_rotor = None
    if len(rotor) > 0:
        of_rotor = with_value_of_empty_step(rotor)
        of_rotor = jnp.broadcast_to(of_rotor, (len(pi), *rotor.shape[1:]))
    steps = with_empty_step(g), of_steps, of_rotor, pi, c, xi_bar, pi_bar, c_bar
    first, J_bar, wanted = _in_blocks(partial(_adjoint_steps, unit), steps, batch)
    h_bar, J_bars, rotor_bar, after = wanted
    if J_bars is not None:
        J_bar = J_bars[:-1]
    R0_bar = jnp.zeros((3, 3, *batch), some.dtype)
    if R_bar is not None:
        R0_bar = jnp.sum(rotations.turn_rows(R_bar, rotations.conjugate(q)), axis=0)
    J_bar, h_bar = _over_trace(J, J_bar, h_bar[:-1])
    if rotor_bar is None:
        rotor_bar = jnp.zeros((0, 3, *batch), some.dtype)
    else:
        rotor_bar = xyz.join(rotor_bar, axis=1)[:-1]
        if len(rotor) < len(rotor_bar):
            rotor_bar = jnp.sum(rotor_bar, axis=0, keepdims=True)
    after = xyz.join(after, axis=1)[:-1]
    return R0_bar, xyz.join(first, axis=0), J_bar, h_bar, rotor_bar, after


def _vectors(array: Array) -> Vector | None:
    """Vectors of all steps and the empty one, or one for all, if there are any."""
    return xyz.split(with_value_of_empty_step(array), axis=1) if len(array) > 0 else None


def _over_trace(J: Array, *arrays: Array) -> list[Array]:
    # c is the same for J and h divided by one number, so that number is not differentiated.
    trace = jax.lax.stop_gradient(jnp.trace(J, axis1=1, axis2=2))
    return [x / jnp.expand_dims(trace, range(1, 1 + x.ndim - trace.ndim)) for x in arrays]


def _adjoint_steps(J, later, own, g, of_steps, rotor, pi, c, xi_bar, pi_bar, c_bar):
    """One block: adjoint variables before it, those after each step, and what is wanted of it.

    `later` are the variables after the block. Wanted are the cotangents of J, summed over the
    `own` steps if it is one for all, of h and rotors, and `lambda` after each step, that of the
    impulse.
    """
    batch = later[0][0].shape
    J = xyz.split_matrix(J if of_steps is None else of_steps, axis=1)
    pi, c = xyz.split(pi, axis=1), xyz.split(c, axis=1)
    rotor = None if rotor is None else xyz.split(rotor, axis=1)
    A = equation.jacobian(J, xyz.scale(g, pi), c, rotor and xyz.scale(g, rotor))
    linearised = xyz.inverse(xyz.transpose(A)), c, g

    def to_right(linearised, eta_bar: Vector) -> Vector:
        inverse, c, _ = linearised
        dc_bar = xyz.subtract(eta_bar, xyz.cross(c, eta_bar))
        return xyz.apply(inverse, xyz.scale(2 / (1 + xyz.dot(c, c)), dc_bar))

    def to_momentum(linearised, eta_bar: Vector) -> Vector:
        _, c, g = linearised
        return xyz.scale(0.5 * g, equation.divided_back(c, to_right(linearised, eta_bar)))

    def attitude(chi, step):
        c, xi_bar = step
        return xyz.add(rotations.turn((1.0, c), chi), xi_bar), chi

    def momentum(lam, step):
        linear, c, pi, eta_bar, pi_bar = step
        turned = rotations.turn((1.0, c), lam)
        change = apply(linear, xyz.add(eta_bar, xyz.cross(turned, pi)))
        return xyz.add(xyz.add(pi_bar, turned), change), lam

    zero = xyz.split(jnp.zeros((len(g), 3, *batch), g.dtype), axis=1)
    xi_bar, pi_bar = (zero if x is None else xyz.split(x, axis=1) for x in (xi_bar, pi_bar))
    chi0, chi = jax.lax.scan(attitude, later[0], (c, xi_bar), reverse=True)
    eta_bar = rotations.turn((1.0, c), chi)
    if c_bar is not None:
        more = equation.divided_back(c, xyz.split(c_bar, axis=1))
        eta_bar = xyz.add(eta_bar, xyz.scale(0.5, more))
    linear, apply = linearised, to_momentum
    if not batch:
        # The loop is then small enough for XLA to compile it as a whole. Over a batch one
        # matrix more is one more pass through memory.
        x, y, z = (to_momentum(linearised, axis) for axis in xyz.unit_vectors(g.dtype))
        linear, apply = xyz.transpose((x, y, z)), xyz.apply
    steps = linear, c, pi, eta_bar, pi_bar
    lam0, lam = jax.lax.scan(momentum, later[1], steps, reverse=True)
    turned = rotations.turn((1.0, c), lam)
    right = to_right(linearised, xyz.add(eta_bar, xyz.cross(turned, pi)))
    # The right side is half of D dp, less dJ c.
    h_bar = 0.5 * xyz.dot(right, equation.divided(c, pi, rotor))
    rotor_bar = None if rotor is None else xyz.scale(0.5 * g, equation.by_rotor(c, right))
    x, y, z = right
    J_bars = xyz.scale(-x, c), xyz.scale(-y, c), xyz.scale(-z, c)
    if of_steps is not None:
        J_bars = xyz.join_matrix(J_bars, axis=1)
        return (chi0, lam0), (chi, lam), None, (h_bar, J_bars, rotor_bar, lam)
    own = jnp.expand_dims(own, range(1, g.ndim))
    sums = [[jnp.sum(jnp.where(own, x, 0), axis=0) for x in row] for row in J_bars]
    sums = jnp.stack([*map(jnp.stack, sums)])[None]
    return (chi0, lam0), (chi, lam), sums, (h_bar, None, rotor_bar, lam)


def _by_turning(R, q, R_bar, q_bar) -> Array | None:
    """Cotangent of xi, which turns R and q in the body frame."""
    xi_bar = None
    if R_bar is not None:
        rows = zip(xyz.split_matrix(R_bar, axis=1), xyz.split_matrix(R, axis=1), strict=True)
        x, y, z = (xyz.cross(row_bar, row) for row_bar, row in rows)
        xi_bar = xyz.join(xyz.add(xyz.add(x, y), z), axis=1)
    if q_bar is not None:
        _, v = rotations.multiply(rotations.conjugate(q), rotations.split(q_bar, axis=1))
        by_q = xyz.join(xyz.scale(-0.5, v), axis=1)  # `conjugate` has a minus sign
        xi_bar = by_q if xi_bar is None else xi_bar + by_q
    return xi_bar


def _in_blocks(adjoint_steps, steps, batch):
    """`lambda` before the first step, J_bar and what else is wanted, block by block from the end.

    The last block is put so that it ends with the steps. Those which it has in common with the
    block before are left to that one.
    """
    total = len(steps[0])
    length = total
    if all(isinstance(size, int) for size in batch):  # else of symbolic size, for `jax.export`
        length = min(total, max(AT_ONCE // max(prod(batch), 1), 1))
    start = np.arange(0, total, length)
    common = np.maximum(start + length - total, 0)

    def block(state, where):
        (later, J_bar), (start, common) = state, where
        cut = partial(jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=length)
        of_own = jnp.arange(length) >= common
        before, after, more, wanted = adjoint_steps(later, of_own, *jax.tree.map(cut, steps))
        own = partial(jax.lax.dynamic_index_in_dim, index=common - 1, keepdims=False)
        inside = jax.tree.map(own, after)
        before = jax.tree.map(partial(jnp.where, common > 0), inside, before)
        return (before, jax.tree.map(jnp.add, J_bar, more)), wanted

    def joined(x):
        return jnp.concatenate([x[:-1].reshape(start[-1], *x.shape[2:]), x[-1, common[-1] :]])

    end = xyz.split(jnp.zeros((3, *batch), steps[0].dtype), axis=0)
    J_bar = jnp.zeros((1, 3, 3, *batch), end[0].dtype) if steps[1] is None else None
    state = (end, end), J_bar
    ((_, lam), J_bar), wanted = jax.lax.scan(block, state, (start - common, common), reverse=True)
    return lam, J_bar, jax.tree.map(joined, wanted)


variation = linear(motion_tangents, motion_adjoint, results=4)
