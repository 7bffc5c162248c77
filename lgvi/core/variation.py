r"""Tangents of a trajectory and their adjoints, from the linearised equation of each step.

A variation of the motion is $d\pi$ and $\xi = \operatorname{vee}(R^T dR)$ before each step, in
the body frame. With $p = h\pi$, $A = \partial r/\partial c$ of the divided equation and
$\eta = \operatorname{vee}(dF\,F^T)$ of the step,

$$\eta = \tfrac{2}{1+c\cdot c}(I+\hat c)A^{-1}\bigl[\tfrac12 D\,dp - dJ\,c\bigr],\qquad
  D = I-\hat c+cc^T,$$
$$\xi' = F^T(\xi + \eta),\qquad d\pi' = F^T(d\pi + \pi\times\eta) + d(\text{impulse}).$$

With $\bar\xi$, $\bar\pi$ for the cotangents of the states, the adjoint variables $\chi$ of $\xi$
and $\lambda$ of $d\pi$ run backwards from zero:

$$\bar\eta = F\chi' + F\lambda'\times\pi,\qquad
  s = A^{-T}\,\tfrac{2}{1+c\cdot c}(I-\hat c)\,\bar\eta,$$
$$\chi = \bar\xi + F\chi',\qquad \lambda = \bar\pi + F\lambda' + \tfrac h2 D^T s,\qquad
  \bar J = -\textstyle\sum s\,c^T.$$

Each is one loop over the steps that solves for one vector in each: no matrix is stored.

Where torques depend on the state, the motion feeds back on itself. With
$z = (\xi, d\tau, d\pi)$, where the torque $\tau$ is held over several steps, matrices $N$
(steps, 3, 3), $K$ (steps, 3, columns) and $H$ (steps, 3, 9) give

$$d\tau \mathrel{\gets} H z + d\tau_\text{given},\qquad
  \tfrac12 D\,dp - dJ\,c + N\,d\pi,\qquad
  d(\text{impulse}) = K z' + d(\text{impulse})_\text{given}$$

before the step, in its brackets and after it; the adjoint has the transposes of the three. $K$ has
columns for as much of $z$ as it needs. What a motion has not is an array of no steps.
"""

from collections.abc import Sequence
from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from . import rotations
from .components import Matrix, Vector
from .equation import by_rotor, divided, divided_back, jacobian, materialise, with_rotors
from .primitives import Arrays, linear
from .reduction import scan_steps, with_empty_step, with_value_of_empty_step


def motion_tangents(at: Arrays, given: Arrays) -> Arrays:
    """Tangents of R, pi, q and c for those of R0, pi0, J, h, rotors and, if any, impulses.

    With feedback, also for those of the torque that is held, if any. R may be of every second,
    third, ... state only.
    """
    J, h, R, pi, q, c, rotor, *feedback = at
    dR0, dpi0, dJ, dh, drotor, *dimpulses = given
    N, K, H = _feedback(feedback)
    J, dJ, h, dh = _over_trace(J, J, dJ, h, dh)
    steps = [
        *(_six(with_value_of_empty_step(x)) for x in (J, dJ)),
        with_empty_step(h),
        with_empty_step(dh),
        pi,
        c,
        *(_of_rotors(x) for x in (rotor, drotor)),
        with_empty_step(dimpulses[0]) if dimpulses else None,
        *(N, K, H),
        with_empty_step(dimpulses[1]) if H else None,
    ]

    def step(variation, of_step):
        J, dJ, g, dg, pi, c, rotor, drotor, dimpulse, N, K, H, dheld = of_step
        J, dJ = xyz.symmetric(J), xyz.symmetric(dJ)
        pi, c = xyz.split(pi, axis=0), xyz.split(c, axis=0)
        xi, *held, dpi = (xyz.split(x, axis=0) for x in variation)
        if H:
            held = [xyz.add(_times(H, xi, *held, dpi), xyz.split(dheld, axis=0))]
        dp = xyz.add(xyz.scale(g, dpi), xyz.scale(dg, pi))
        right = xyz.scale(0.5, divided(c, with_rotors(dp)))
        if rotor is not None:
            rotor, drotor = xyz.split(rotor, axis=0), xyz.split(drotor, axis=0)
            dr = xyz.add(xyz.scale(g, drotor), xyz.scale(dg, rotor))
            right = xyz.add(right, xyz.scale(0.5, by_rotor(c, dr)))
        right = xyz.add(right, _times(N, dpi)) if N else right
        right = materialise(xyz.subtract(right, xyz.apply(dJ, c)))
        dc = materialise(xyz.solve(_jacobian(J, g, pi, c, rotor), right))
        eta = xyz.scale(2 / (1 + xyz.dot(c, c)), xyz.add(dc, xyz.cross(c, dc)))
        dpi = rotations.turn_back(c, xyz.add(dpi, xyz.cross(pi, eta)))
        xi = rotations.turn_back(c, xyz.add(xi, eta))
        dpi = xyz.add(dpi, _times(K, xi, *held, dpi)) if K else dpi
        dpi = dpi if dimpulse is None else xyz.add(dpi, xyz.split(dimpulse, axis=0))
        after = [xyz.join(x, axis=0) for x in (xi, *held, dpi)]
        return after, (variation[0], variation[-1], xyz.join(dc, axis=0))

    zero = jnp.zeros_like(dpi0)
    start = [zero, zero, dpi0] if H else [zero, dpi0]
    _, (xi, dpi, dc) = scan_steps(step, start, steps)
    xi_, q_ = xyz.split(xi, axis=1), rotations.split(q, axis=1)
    xi_of_R, q_of_R = xyz.split(_of(R, xi), axis=1), rotations.split(_of(R, q), axis=1)
    dR = rotations.turn_rows(dR0[None], q_of_R)
    dR += xyz.join_matrix(xyz.cross_rows(xyz.split_matrix(R, axis=1), xi_of_R), axis=1)
    # The tangents of q and c serve derivatives of this rule.
    dq = rotations.scale(0.5, rotations.multiply(q_, (0.0, xi_)))
    return dR, dpi, rotations.join(dq, axis=1), dc


def motion_adjoint(at: Arrays, cotangents: Sequence[Array | None]) -> Arrays:
    """Cotangents of R0, pi0, J, h, rotors, impulses and of the torque that is held, if any, for
    those of R, pi, q, c, None if zero.
    """
    J, h, R, pi, q, c, rotor, *feedback = at
    N, K, H = _feedback(feedback)
    some = jax.tree.leaves(cotangents)[0]
    batch = some.shape[some.ndim - (J.ndim - 3) :]
    unit, g = _over_trace(J, J, h)
    g = with_empty_step(g)
    R_bar, pi_bar, q_bar, c_bar = cotangents
    q_of_R, q = rotations.split(_of(R, q), axis=1), rotations.split(q, axis=1)
    steps = [
        _six(with_value_of_empty_step(unit)),
        g,
        pi,
        c,
        _of_rotors(rotor),
        _by_turning(R, q, R_bar, q_bar),
        pi_bar,
        c_bar,
        # The kick before each state: it is added to what is carried, so it is read only once.
        *(N, [jnp.roll(block, 1, axis=0) for block in K], H),
    ]

    def step(later, of_step):
        J, g, pi, c, rotor, xi_bar, pi_bar, c_bar, N, K, H = of_step
        J, pi, c = xyz.symmetric(J), xyz.split(pi, axis=0), xyz.split(c, axis=0)
        rotor = None if rotor is None else xyz.split(rotor, axis=0)
        chi, *held, lam = (xyz.split(x, axis=0) for x in later)
        chi, lam = (rotations.turn((1.0, c), x) for x in (chi, lam))
        eta_bar = xyz.add(chi, xyz.cross(lam, pi))
        if c_bar is not None:
            eta_bar = xyz.add(eta_bar, xyz.scale(0.5, divided_back(c, xyz.split(c_bar, axis=0))))
        right = xyz.scale(2 / (1 + xyz.dot(c, c)), xyz.subtract(eta_bar, xyz.cross(c, eta_bar)))
        A = _jacobian(J, g, pi, c, rotor)
        s = materialise(xyz.solve(xyz.transpose(A), right))
        lam = xyz.add(lam, xyz.scale(0.5 * g, divided_back(c, s)))
        (lam,) = _add_times_back(N, s, lam)
        if H:
            x, y, z = map(jnp.zeros_like, held[0])
            chi, *held, lam = _add_times_back(H, held[0], chi, (x, y, z), lam)
        chi = chi if xi_bar is None else xyz.add(chi, xyz.split(xi_bar, axis=0))
        lam = lam if pi_bar is None else xyz.add(lam, xyz.split(pi_bar, axis=0))
        of_step = [xyz.join(s, axis=0), xyz.join(lam, axis=0), *later[1:-1]]
        chi, *held, lam = _add_times_back(K, lam, chi, *held, lam)
        return [xyz.join(x, axis=0) for x in (chi, *held, lam)], of_step

    end = [jnp.zeros((3, *batch), some.dtype)] * (3 if H else 2)
    _, (s, lam, *held_bar) = scan_steps(step, end, steps, reverse=True)
    c_, s_ = xyz.split(c, axis=1), xyz.split(s, axis=1)
    rotors = _of_rotors(rotor)
    rotor_ = None if rotors is None else xyz.split(rotors, axis=1)
    h_bar = 0.5 * xyz.dot(s_, divided(c_, with_rotors(xyz.split(pi, axis=1), rotor_)))
    rotor_bar = jnp.zeros((0, 3, *batch), some.dtype)
    if rotor_ is not None:
        rotor_bar = xyz.join(xyz.scale(0.5 * g, by_rotor(c_, s_)), axis=1)[:-1]
        if len(rotor) < len(rotor_bar):
            rotor_bar = jnp.sum(rotor_bar, axis=0, keepdims=True)
    J_bar = -s[:, :, None] * c[:, None]
    J_bar = jnp.sum(J_bar, axis=0, keepdims=True) if len(J) == 1 else J_bar[:-1]
    J_bar = (J_bar + jnp.swapaxes(J_bar, 1, 2)) / 2
    J_bar, h_bar = _over_trace(J, J_bar, h_bar[:-1])
    R0_bar = jnp.zeros((3, 3, *batch), some.dtype)
    if R_bar is not None:
        R0_bar = jnp.sum(rotations.turn_rows(R_bar, rotations.conjugate(q_of_R)), axis=0)
    of_held = [x[:-1] for x in held_bar]
    return R0_bar, lam[0], J_bar, h_bar, rotor_bar, lam[1:], *of_held


def _feedback(matrices: Sequence[Array]) -> list[list[Array]]:
    """N, K and H with those of the empty step, each as blocks of three columns, if any.

    Else the loop would read all of a matrix for each vector that it multiplies.
    """
    return [
        [with_empty_step(x[:, :, i : i + 3]) for i in range(0, x.shape[2], 3) if len(x) > 0]
        for x in matrices
    ] or [[], [], []]


def _of(R: Array, x: Array) -> Array:
    """Of the states of which R is known."""
    return x[:: (len(x) - 1) // (len(R) - 1)]


def _times(blocks: Sequence[Array], *vectors: Vector) -> Vector:
    """The matrix of these blocks times as many of the vectors as it has columns for."""
    matrices = (xyz.split_matrix(block, axis=0) for block in blocks)
    return reduce(xyz.add, map(xyz.apply, matrices, vectors))


def _add_times_back(blocks: Sequence[Array], y: Vector, *vectors: Vector) -> list[Vector]:
    """The vectors, with the matrix transposed times y added to as many as it has columns for."""
    matrices = (xyz.transpose(xyz.split_matrix(block, axis=0)) for block in blocks)
    added = [xyz.add(v, xyz.apply(M, y)) for M, v in zip(matrices, vectors, strict=False)]
    return [*added, *vectors[len(blocks) :]]


def _six(J: Array) -> Array:
    """The six numbers of the symmetric parts of matrices (n, 3, 3, *batch)."""
    return xyz.six(xyz.split_matrix((J + jnp.swapaxes(J, 1, 2)) / 2, axis=1))


def _of_rotors(rotor: Array) -> Array | None:
    """Momenta of rotors with that of the empty step, if there are any."""
    return with_value_of_empty_step(rotor) if len(rotor) > 0 else None


def _jacobian(J: Matrix, g: Array, pi: Vector, c: Vector, rotor: Vector | None) -> Matrix:
    rotor = None if rotor is None else xyz.scale(g, rotor)
    return jacobian(J, with_rotors(xyz.scale(g, pi), rotor), c)


def _over_trace(J: Array, *arrays: Array) -> list[Array]:
    # c is the same for J and h divided by one number, so that number is not differentiated.
    trace = jax.lax.stop_gradient(jnp.trace(J, axis1=1, axis2=2))
    return [x / jnp.expand_dims(trace, range(1, 1 + x.ndim - trace.ndim)) for x in arrays]


def _by_turning(R, q, R_bar, q_bar) -> Array | None:
    """Cotangent of xi, which turns R and q in the body frame."""
    xi_bar = None
    if R_bar is not None:
        rows = zip(xyz.split_matrix(R_bar, axis=1), xyz.split_matrix(R, axis=1), strict=True)
        x, y, z = (xyz.cross(row_bar, row) for row_bar, row in rows)
        xi_bar = xyz.join(xyz.add(xyz.add(x, y), z), axis=1)
        between = (len(q[0]) - 1) // (len(R) - 1) - 1
        edges = [(0, 0, between), *[(0, 0, 0)] * (xi_bar.ndim - 1)]
        xi_bar = jax.lax.pad(xi_bar, jnp.zeros((), xi_bar.dtype), edges)
    if q_bar is not None:
        _, v = rotations.multiply(rotations.conjugate(q), rotations.split(q_bar, axis=1))
        by_q = xyz.join(xyz.scale(-0.5, v), axis=1)  # `conjugate` has a minus sign
        xi_bar = by_q if xi_bar is None else xi_bar + by_q
    return xi_bar


variation = linear(motion_tangents, motion_adjoint, results=4)
