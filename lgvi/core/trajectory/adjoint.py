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

States that are not finite, after a step that did not converge, take zero cotangents to zero, and
others to NaN: a loss that leaves these states out by a mask has a finite gradient.

Where torques depend on the state, the motion feeds back on itself. With a torque $\tau$ that is
held for one step or several, and $z = (\xi, d\tau, d\pi)$, matrices $H$ (steps, 3, 6 or 9),
$B$ and $K$ (steps, 3, columns) and $N$ (steps, 3, 3) add

$$d\tau = H\,(\xi, d\pi, d\tau) + d\tau_\text{given},\qquad
  d\pi \mathrel{+}= B z + d(\text{impulse})_\text{before},\qquad
  [\,\dots + N\,d\pi\,],\qquad
  d\pi' \mathrel{+}= K z' + d(\text{impulse})$$

in this order: before the step, in its brackets and after it. The adjoint has the transposes.
$B$ and $K$ have columns for the parts of $z$ that they need. A matrix that a motion does not have
is an array of zero steps.
"""

from collections.abc import Sequence
from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.finite import finite, finite_matrix
from ..kernels.primitives import Arrays, linear
from ..kernels.quaternions import Quaternion, rotate_rows
from ..kernels.vectors import Mat3, Vec3
from ..step.equation import (
    jacobian,
    materialise,
    right_hand_side,
    right_hand_side_transposed,
    rotor_part,
    with_rotors,
)
from .inertias import (
    changes_of_steps,
    cotangents_of_inertias,
    of_steps,
    over_trace,
    six,
    times_change,
)
from .reduction import scan_steps, with_empty_step, with_value_of_empty_step


def propagate_tangents(at: Arrays, given: Arrays) -> Arrays:
    """Tangents of R and pi, xi, and the tangents of c and of the momenta at the start of steps.

    The momenta at the start are taken after the impulses before the steps. The tangents are linear
    in changes of R0, pi0, J, h, rotors and, if any, impulses; with feedback, also in changes of the
    impulses before the steps and of the torque that is held, if any. R may have every second,
    third, ... state only.
    """
    matrices, factors, h, R, pi, q, c, rotor, *feedback = at
    dR0, dpi0, dmatrices, dfactors, dh, drotor, *others = given
    N, B, K, H = _feedback(feedback)
    J = of_steps(matrices, factors)
    dJ = changes_of_steps(J, matrices, factors, dmatrices, dfactors)
    J, h, dh = over_trace(J, J, h, dh)
    others = map(with_empty_step, others)
    dimpulses, dbefore, dheld = (next(others, None) if there else None for there in (True, B, H))
    J, g, dg = with_value_of_empty_step(J), with_empty_step(h), with_empty_step(dh)
    dJ = [with_value_of_empty_step(x) for x in dJ]
    rotor, drotor = _of_rotors(rotor), _of_rotors(drotor)
    steps = [
        six(J),
        g,
        pi,
        c,
        rotor,
        _given_of_steps(pi, c, g, dg, dJ, rotor, drotor),
        *(N, B, K, H),
        *(dimpulses, dbefore, dheld),
    ]

    def step(variation, of_step):
        J, g, pi, c, rotor, given, N, B, K, H, dimpulse, dbefore, dheld = of_step
        J, pi, c = Mat3.of_six(J, axis=0), Vec3.of(pi, axis=0), Vec3.of(c, axis=0)
        F = Quaternion(1.0, c)
        xi, *held, dpi = (Vec3.of(x, axis=0) for x in variation)
        if H:
            held = [_times(H, xi, dpi, *held) + Vec3.of(dheld, axis=0)]
        if B:
            dpi += _times(B, xi, *held, dpi) + Vec3.of(dbefore, axis=0)
        after_impulse = [dpi.array(axis=0)] if B else []
        right = 0.5 * right_hand_side(c, with_rotors(g * dpi))
        right = right + _times(N, dpi) if N else right
        right = materialise(right + Vec3.of(given, axis=0))
        rotor = None if rotor is None else Vec3.of(rotor, axis=0)
        dc = materialise(_jacobian(J, g, pi, c, rotor).solve(right))
        eta = 2 / (1 + c.dot(c)) * (dc + c.cross(dc))
        dpi = F.rotate_back(dpi + pi.cross(eta))
        xi = F.rotate_back(xi + eta)
        dpi = dpi + _times(K, xi, *held, dpi) if K else dpi
        dpi = dpi if dimpulse is None else dpi + Vec3.of(dimpulse, axis=0)
        after = [x.array(axis=0) for x in (xi, *held, dpi)]
        return after, (variation[0], variation[-1], dc.array(axis=0), *after_impulse)

    zero = jnp.zeros_like(dpi0)
    start = [zero, zero, dpi0] if H else [zero, dpi0]
    _, (xi, dpi, dc, *dstart) = scan_steps(step, start, steps)
    xi_of_R, q_of_R = Vec3.of(_of(R, xi), axis=1), Quaternion.of(_of(R, q), axis=1)
    dR = rotate_rows(dR0[None], q_of_R)
    dR += Mat3.of(R, axis=1).cross(xi_of_R).array(axis=1)
    # dc and the last result serve derivatives of this rule.
    return dR, dpi, xi, dc, *(dstart or [dpi])


def _given_of_steps(
    pi: Array,
    c: Array,
    g: Array,
    dg: Array,
    dJ: Arrays,
    rotor: Array | None,
    drotor: Array | None,
) -> Array:
    """What changes of J, h and rotors add to the brackets of all steps (steps+1, 3)."""
    c_ = Vec3.of(c, axis=1)
    given = 0.5 * right_hand_side(c_, with_rotors(dg * Vec3.of(pi, axis=1)))
    if rotor is not None and drotor is not None:
        dr = g * Vec3.of(drotor, axis=1) + dg * Vec3.of(rotor, axis=1)
        given += 0.5 * rotor_part(c_, dr)
    return (given - times_change(dJ, c_)).array(axis=1)


def propagate_adjoint(at: Arrays, cotangents: Sequence[Array | None]) -> Arrays:
    """Cotangents of the arguments of `propagate_tangents`, from those of its results or None."""
    matrices, factors, h, R, pi, q, c, rotor, *feedback = at
    N, B, K, H = _feedback([finite(x) for x in feedback])
    some = jax.tree.leaves(cotangents)[0]
    batch = some.shape[some.ndim - (matrices.ndim - 3) :]
    R_bar, pi_bar, xi_bar, c_bar, start_bar = cotangents
    pi_bar, xi_bar, start_bar = (_nan_where_used(x, pi) for x in (pi_bar, xi_bar, start_bar))
    c_bar = _nan_where_used(c_bar, c)
    J = finite_matrix(of_steps(matrices, factors), axis=1)
    unit, g = over_trace(J, J, finite(h))
    g, pi, c, rotor = with_empty_step(g), *map(finite, (pi, c, rotor))
    q_of_R = Quaternion.of(_of(R, q), axis=1)
    steps = [
        six(with_value_of_empty_step(unit)),
        g,
        pi,
        c,
        _of_rotors(rotor),
        xi_bar if R_bar is None else _with_that_of_R(xi_bar, R, R_bar, len(pi)),
        pi_bar,
        c_bar,
        start_bar,
        *(N, B, K, H),
    ]

    def step(later, of_step):
        J, g, pi, c, rotor, xi_bar, pi_bar, c_bar, start_bar, N, B, K, H = of_step
        J, pi, c = Mat3.of_six(J, axis=0), Vec3.of(pi, axis=0), Vec3.of(c, axis=0)
        rotor = None if rotor is None else Vec3.of(rotor, axis=0)
        F = Quaternion(1.0, c)
        chi, *held, lam = (Vec3.of(x, axis=0) for x in later)
        if K:
            chi, *held, lam = _add_times_back(K, lam, chi, *held, lam)
            chi = materialise(chi)  # K is then read in one place
        chi, lam = F.rotate(chi), F.rotate(lam)
        eta_bar = chi + lam.cross(pi)
        if c_bar is not None:
            eta_bar += 0.5 * right_hand_side_transposed(c, Vec3.of(c_bar, axis=0))
        right = 2 / (1 + c.dot(c)) * (eta_bar - c.cross(eta_bar))
        s = materialise(_jacobian(J, g, pi, c, rotor).T.solve(right))
        lam += 0.5 * g * right_hand_side_transposed(c, s)
        (lam,) = _add_times_back(N, s, lam)
        lam = lam if start_bar is None else lam + Vec3.of(start_bar, axis=0)
        given = [lam] if B else []
        chi, *held, lam = _add_times_back(B, lam, chi, *held, lam)
        if H:
            given += held
            zero = jax.tree.map(jnp.zeros_like, held[0])
            chi, lam, *held = _add_times_back(H, held[0], chi, lam, zero)
        chi = chi if xi_bar is None else chi + Vec3.of(xi_bar, axis=0)
        lam = lam if pi_bar is None else lam + Vec3.of(pi_bar, axis=0)
        s, *given = (x.array(axis=0) for x in (s, *given))
        return [x.array(axis=0) for x in (chi, *held, lam)], (s, later[-1], *given)

    end = [jnp.zeros((3, *batch), some.dtype)] * (3 if H else 2)
    (*_, pi0_bar), (s, impulses_bar, *given_bar) = scan_steps(step, end, steps, reverse=True)
    J_bar, h_bar, rotor_bar = _cotangents_of_steps(J, g, pi, c, rotor, s)
    of_inertias = cotangents_of_inertias(J_bar, *map(finite, (matrices, factors)))
    R0_bar = jnp.zeros((3, 3, *batch), some.dtype)
    if R_bar is not None:
        back = rotate_rows(R_bar, q_of_R.conjugate())
        R0_bar = jnp.sum(jnp.where(_is_unused(R_bar), 0, back), axis=0)
    others = (x[:-1] for x in (impulses_bar, *given_bar))
    return R0_bar, pi0_bar, *of_inertias, h_bar, rotor_bar, *others


def _cotangents_of_steps(
    J: Array, g: Array, pi: Array, c: Array, rotor: Array, s: Array
) -> tuple[Array, Array, Array]:
    """Cotangents of the inertia, the step sizes and the rotors, from s of all steps."""
    c_, s_, rotors = Vec3.of(c, axis=1), Vec3.of(s, axis=1), _of_rotors(rotor)
    rotor_ = None if rotors is None else Vec3.of(rotors, axis=1)
    h_bar = 0.5 * s_.dot(right_hand_side(c_, with_rotors(Vec3.of(pi, axis=1), rotor_)))
    rotor_bar = jnp.zeros((0, *s.shape[1:]), s.dtype)
    if rotor_ is not None:
        rotor_bar = (0.5 * g * rotor_part(c_, s_)).array(axis=1)[:-1]
        if len(rotor) < len(rotor_bar):
            rotor_bar = jnp.sum(rotor_bar, axis=0, keepdims=True)
    J_bar = (-s[:, :, None] * c[:, None])[:-1]
    J_bar, h_bar = over_trace(J, J_bar, h_bar[:-1])
    return J_bar, h_bar, rotor_bar


def _feedback(matrices: Sequence[Array]) -> list[list[Array]]:
    """N, B, K and H, each with an empty step and as blocks of three columns, if any.

    Without the blocks the loop would read a whole matrix for each vector that it multiplies.
    """
    return [
        [with_empty_step(x[:, :, i : i + 3]) for i in range(0, x.shape[2], 3) if len(x) > 0]
        for x in matrices
    ] or [[], [], [], []]


def _of(R: Array, x: Array) -> Array:
    """The entries of x at the states of R."""
    return x[:: (len(x) - 1) // (len(R) - 1)]


def _times(blocks: Sequence[Array], *vectors: Vec3) -> Vec3:
    """The matrix of these blocks times as many of the vectors as it has columns for."""
    matrices = (Mat3.of(block, axis=0) for block in blocks)
    return reduce(add, (M @ v for M, v in zip(matrices, vectors, strict=False)))


def _add_times_back(blocks: Sequence[Array], y: Vec3, *vectors: Vec3) -> list[Vec3]:
    """The vectors, with the matrix transposed times y added to as many as it has columns for."""
    matrices = (Mat3.of(block, axis=0) for block in blocks)
    added = [v + M.T @ y for M, v in zip(matrices, vectors, strict=False)]
    return [*added, *vectors[len(blocks) :]]


def _of_rotors(rotor: Array) -> Array | None:
    """Momenta of rotors, with one for the empty step; None without rotors."""
    return with_value_of_empty_step(rotor) if len(rotor) > 0 else None


def _jacobian(J: Mat3, g: Array, pi: Vec3, c: Vec3, rotor: Vec3 | None) -> Mat3:
    return jacobian(J, with_rotors(g * pi, None if rotor is None else g * rotor), c)


def _is_unused(R_bar: Array) -> Array:
    """Whether cotangents of attitudes (states, 3, 3, *batch) are zero (states, 1, 1, *batch)."""
    return jnp.all(R_bar == 0, axis=(1, 2), keepdims=True)


def _nan_where_used(x_bar: Array | None, x: Array) -> Array | None:
    """The cotangents, NaN where they are not zero and a vector x (states, 3, *batch) is not finite.

    The coefficients of the loop are finite, so without this a cotangent would be a wrong number.
    """
    if x_bar is None:
        return None
    valid = jnp.all(jnp.isfinite(x), axis=1, keepdims=True)
    return jnp.where(valid | (x_bar == 0), x_bar, jnp.nan)


def _with_that_of_R(xi_bar: Array | None, R: Array, R_bar: Array, states: int) -> Array:
    """The cotangent of xi, plus the cotangent of R, which xi turns in the body frame."""
    rows = zip(Mat3.of(R_bar, axis=1), Mat3.of(R, axis=1), strict=True)
    x, y, z = (row_bar.cross(row) for row_bar, row in rows)
    by_R = (x + y + z).array(axis=1)
    by_R = jnp.where(_is_unused(R_bar)[:, 0], 0, by_R)
    between = (states - 1) // (len(R) - 1) - 1
    edges = [(0, 0, between), *[(0, 0, 0)] * (by_R.ndim - 1)]
    by_R = jax.lax.pad(by_R, jnp.zeros((), by_R.dtype), edges)
    return by_R if xi_bar is None else xi_bar + by_R


propagate_variation = linear(propagate_tangents, propagate_adjoint, results=5)
