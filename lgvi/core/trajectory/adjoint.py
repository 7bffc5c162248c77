r"""Tangents of a trajectory and their adjoints, from the linearised equation of each step.

A variation of the motion is $d\pi$ and $\xi = \operatorname{vee}(R^T dR)$ before each step, in
the body frame. With $p = h\pi$, $A = \partial r/\partial c$ of the quadratic equation of a step and
$\eta = \operatorname{vee}(dF\,F^T)$ of the step,

$$\eta = \tfrac{2}{1+c\cdot c}(I+\hat c)A^{-1}\bigl[D\,dp - 2\,dJ\,c\bigr],\qquad
  D = I-\hat c+cc^T,$$
$$\xi' = F^T(\xi + \eta),\qquad d\pi' = F^T(d\pi + \pi\times\eta) + d(\text{impulse}).$$

With $\bar\xi$, $\bar\pi$ for the cotangents of the states, the adjoint variables $\chi$ of $\xi$
and $\lambda$ of $d\pi$ run backwards from zero:

$$\bar\eta = F\chi' + F\lambda'\times\pi,\qquad
  s = A^{-T}\,\tfrac{2}{1+c\cdot c}(I-\hat c)\,\bar\eta,$$
$$\chi = \bar\xi + F\chi',\qquad \lambda = \bar\pi + F\lambda' + h D^T s,\qquad
  \bar J = -2\textstyle\sum s\,c^T.$$

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
from functools import partial, reduce
from operator import add
from typing import NamedTuple

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


class Motion(NamedTuple):
    """The motion about which changes are small. Its inertias are as in `inertias.py`."""

    matrices: Array
    factors: Array
    h: Array  # sizes of the steps (steps,)
    R: Array  # attitudes (steps+1, 3, 3), or every second, third, ... of them
    pi: Array  # momenta at the start of each step, and the last (steps+1, 3)
    q: Array  # attitudes relative to the first, as quaternions wxyz (steps+1, 4)
    c: Array  # Rodrigues vectors of the steps, and zero (steps+1, 3)
    rotor: Array  # momenta of rotors, (1, 3) or (steps, 3); without rotors (0, 3)


class _Feedback(NamedTuple):
    """The matrices of the feedback, as blocks of three columns; no block for no matrix."""

    N: Sequence[Array] = ()
    B: Sequence[Array] = ()
    K: Sequence[Array] = ()
    H: Sequence[Array] = ()


class _Step(NamedTuple):
    """The motion in a step; before the loop, in all of them."""

    twice_inertia: Array  # the six numbers of twice the inertia, of which the trace is two
    g: Array  # the size of the step over the trace of the inertia
    pi: Array
    c: Array
    rotor: Array | None

    def jacobian(self, pi: Vec3, c: Vec3) -> Mat3:
        r = None if self.rotor is None else self.g * Vec3.of(self.rotor, axis=0)
        return jacobian(Mat3.of_six(self.twice_inertia, axis=0), with_rotors(self.g * pi, r), c)


class _Sources(NamedTuple):
    """The changes in a step that do not follow from those before it."""

    bracket: Array  # by J, h and rotors
    impulse: Array | None  # after the step
    before: Array | None  # of the impulse before the step
    held: Array | None  # of the torque that is held


class _Cotangents(NamedTuple):
    """The cotangents of the results of a step."""

    xi: Array | None
    pi: Array | None
    c: Array | None
    start: Array | None  # of the momentum after the impulse before the step


# Of trees of arrays (3, *batch) or None.
_vectors = partial(jax.tree.map, partial(Vec3.of, axis=0))


def propagate_tangents(at: Arrays, changes: Arrays) -> Arrays:
    """Tangents of R and pi, xi, and the tangents of c and of the momenta at the start of steps.

    They are taken at a `Motion`, followed by N, B, K and H if it has feedback. The momenta at the
    start are those after the impulses before the steps. The tangents are linear in changes of R0,
    pi0, J, h, rotors and, if any, impulses; with feedback, also in changes of the impulses before
    the steps and of the torque that is held, if any.
    """
    feedback = _feedback(at[len(Motion._fields) :])
    matrices, factors, h, R, pi, q, c, rotor = Motion(*at[: len(Motion._fields)])
    dR0, dpi0, dmatrices, dfactors, dh, drotor, *others = changes
    J = of_steps(matrices, factors)
    dJ = changes_of_steps(J, matrices, factors, dmatrices, dfactors)
    J, h, dh = over_trace(J, J, h, dh)
    others = map(with_empty_step, others)
    impulse, before, held = (
        next(others, None) if there else None for there in (True, feedback.B, feedback.H)
    )
    J, g, dg = with_value_of_empty_step(J), with_empty_step(h), with_empty_step(dh)
    dJ = [with_value_of_empty_step(x) for x in dJ]
    rotor, drotor = _with_empty_step_if_any(rotor), _with_empty_step_if_any(drotor)
    bracket = _changes_of_brackets(pi, c, g, dg, dJ, rotor, drotor)
    steps = _Step(six(2 * J), g, pi, c, rotor), _Sources(bracket, impulse, before, held), feedback

    def step(variation, of_step):
        at, sources, (N, B, K, H) = of_step
        (pi, c), sources = _vectors((at.pi, at.c)), _vectors(sources)
        F = Quaternion(1.0, c)
        xi, *dtau, dpi = _vectors(variation)
        if H:
            dtau = [_multiply(H, xi, dpi, *dtau) + sources.held]
        if B:
            dpi += _multiply(B, xi, *dtau, dpi) + sources.before
        after_impulse = [dpi.array(axis=0)] if B else []
        right = right_hand_side(c, with_rotors(at.g * dpi))
        right = right + _multiply(N, dpi) if N else right
        right = materialise(right + sources.bracket)
        dc = materialise(at.jacobian(pi, c).solve(right))
        eta = 2 / (1 + c.dot(c)) * (dc + c.cross(dc))
        dpi = F.rotate_back(dpi + pi.cross(eta))
        xi = F.rotate_back(xi + eta)
        dpi = dpi + _multiply(K, xi, *dtau, dpi) if K else dpi
        dpi = dpi if sources.impulse is None else dpi + sources.impulse
        after = [x.array(axis=0) for x in (xi, *dtau, dpi)]
        return after, (variation[0], variation[-1], dc.array(axis=0), *after_impulse)

    zero = jnp.zeros_like(dpi0)
    start = [zero, zero, dpi0] if feedback.H else [zero, dpi0]
    _, (xi, dpi, dc, *dstart) = scan_steps(step, start, steps)
    xi_of_R = Vec3.of(_at_states_of(R, xi), axis=1)
    q_of_R = Quaternion.of(_at_states_of(R, q), axis=1)
    dR = rotate_rows(dR0[None], q_of_R)
    dR += Mat3.of(R, axis=1).cross(xi_of_R).array(axis=1)
    # dc and the last result serve derivatives of this rule.
    return dR, dpi, xi, dc, *(dstart or [dpi])


def _changes_of_brackets(
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
    change = right_hand_side(c_, with_rotors(dg * Vec3.of(pi, axis=1)))
    if rotor is not None and drotor is not None:
        dr = g * Vec3.of(drotor, axis=1) + dg * Vec3.of(rotor, axis=1)
        change += rotor_part(c_, dr)
    return (change - 2 * times_change(dJ, c_)).array(axis=1)


def propagate_adjoint(at: Arrays, cotangents: Sequence[Array | None]) -> Arrays:
    """Cotangents of the arguments of `propagate_tangents`, from those of its results or None."""
    feedback = _feedback([finite(x) for x in at[len(Motion._fields) :]])
    matrices, factors, h, R, pi, q, c, rotor = Motion(*at[: len(Motion._fields)])
    some = jax.tree.leaves(cotangents)[0]
    batch = some.shape[some.ndim - (matrices.ndim - 3) :]
    R_bar, pi_bar, xi_bar, c_bar, start_bar = cotangents
    pi_bar, xi_bar, start_bar = (_nan_where_used(x, pi) for x in (pi_bar, xi_bar, start_bar))
    c_bar = _nan_where_used(c_bar, c)
    inertias = finite_matrix(of_steps(matrices, factors), axis=1)
    unit, g = over_trace(inertias, inertias, finite(h))
    g, pi, c, rotor = with_empty_step(g), *map(finite, (pi, c, rotor))
    q_of_R = Quaternion.of(_at_states_of(R, q), axis=1)
    twice_J = six(2 * with_value_of_empty_step(unit))
    if R_bar is not None:
        xi_bar = _with_that_of_R(xi_bar, R, R_bar, len(pi))
    cotangents = _Cotangents(xi_bar, pi_bar, c_bar, start_bar)
    steps = _Step(twice_J, g, pi, c, _with_empty_step_if_any(rotor)), cotangents, feedback

    def step(later, of_step):
        at, of_results, (N, B, K, H) = of_step
        (pi, c), of_results = _vectors((at.pi, at.c)), _vectors(of_results)
        F = Quaternion(1.0, c)
        chi, *of_tau, lam = _vectors(later)
        if K:
            chi, *of_tau, lam = _add_transposed(K, lam, chi, *of_tau, lam)
            chi = materialise(chi)  # K is then read in one place
        chi, lam = F.rotate(chi), F.rotate(lam)
        of_eta = chi + lam.cross(pi)
        if of_results.c is not None:
            of_eta += 0.5 * right_hand_side_transposed(c, of_results.c)
        right = 2 / (1 + c.dot(c)) * (of_eta - c.cross(of_eta))
        s = materialise(at.jacobian(pi, c).T.solve(right))
        lam += at.g * right_hand_side_transposed(c, s)
        (lam,) = _add_transposed(N, s, lam)
        lam = lam if of_results.start is None else lam + of_results.start
        of_changes = [lam] if B else []
        chi, *of_tau, lam = _add_transposed(B, lam, chi, *of_tau, lam)
        if H:
            of_changes += of_tau
            zero = jax.tree.map(jnp.zeros_like, of_tau[0])
            chi, lam, *of_tau = _add_transposed(H, of_tau[0], chi, lam, zero)
        chi = chi if of_results.xi is None else chi + of_results.xi
        lam = lam if of_results.pi is None else lam + of_results.pi
        s, *of_changes = (x.array(axis=0) for x in (s, *of_changes))
        return [x.array(axis=0) for x in (chi, *of_tau, lam)], (s, later[-1], *of_changes)

    end = [jnp.zeros((3, *batch), some.dtype)] * (3 if feedback.H else 2)
    (*_, pi0_bar), (s, *of_changes) = scan_steps(step, end, steps, reverse=True)
    J_bar, h_bar, rotor_bar = _cotangents_of_steps(inertias, g, pi, c, rotor, s)
    of_inertias = cotangents_of_inertias(J_bar, *map(finite, (matrices, factors)))
    R0_bar = jnp.zeros((3, 3, *batch), some.dtype)
    if R_bar is not None:
        back = rotate_rows(R_bar, q_of_R.conjugate())
        R0_bar = jnp.sum(jnp.where(_is_unused(R_bar), 0, back), axis=0)
    return R0_bar, pi0_bar, *of_inertias, h_bar, rotor_bar, *(x[:-1] for x in of_changes)


def _cotangents_of_steps(
    J: Array, g: Array, pi: Array, c: Array, rotor: Array, s: Array
) -> tuple[Array, Array, Array]:
    """Cotangents of the inertia, the step sizes and the rotors, from s of all steps."""
    c_, s_, rotors = Vec3.of(c, axis=1), Vec3.of(s, axis=1), _with_empty_step_if_any(rotor)
    rotor_ = None if rotors is None else Vec3.of(rotors, axis=1)
    h_bar = s_.dot(right_hand_side(c_, with_rotors(Vec3.of(pi, axis=1), rotor_)))
    rotor_bar = jnp.zeros((0, *s.shape[1:]), s.dtype)
    if rotor_ is not None:
        rotor_bar = (g * rotor_part(c_, s_)).array(axis=1)[:-1]
        if len(rotor) < len(rotor_bar):
            rotor_bar = jnp.sum(rotor_bar, axis=0, keepdims=True)
    J_bar = (-2 * s[:, :, None] * c[:, None])[:-1]
    J_bar, h_bar = over_trace(J, J_bar, h_bar[:-1])
    return J_bar, h_bar, rotor_bar


def _feedback(matrices: Arrays) -> _Feedback:
    """The feedback of N, B, K and H, each with an empty step, or of no matrices.

    Without the blocks the loop would read a whole matrix for each vector that it multiplies.
    """
    return _Feedback(
        *(
            [with_empty_step(x[:, :, i : i + 3]) for i in range(0, x.shape[2], 3) if len(x) > 0]
            for x in matrices
        )
    )


def _at_states_of(R: Array, x: Array) -> Array:
    """The entries of x at the states of R."""
    return x[:: (len(x) - 1) // (len(R) - 1)]


def _multiply(blocks: Sequence[Array], *vectors: Vec3) -> Vec3:
    """The matrix of these blocks times as many of the vectors as it has columns for."""
    matrices = (Mat3.of(block, axis=0) for block in blocks)
    return reduce(add, (M @ v for M, v in zip(matrices, vectors, strict=False)))


def _add_transposed(blocks: Sequence[Array], y: Vec3, *vectors: Vec3) -> list[Vec3]:
    """The vectors, with the matrix transposed times y added to as many as it has columns for."""
    matrices = (Mat3.of(block, axis=0) for block in blocks)
    added = [v + M.T @ y for M, v in zip(matrices, vectors, strict=False)]
    return [*added, *vectors[len(blocks) :]]


def _with_empty_step_if_any(rotor: Array) -> Array | None:
    """Momenta of rotors, with one for the empty step; None without rotors."""
    return with_value_of_empty_step(rotor) if len(rotor) > 0 else None


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
