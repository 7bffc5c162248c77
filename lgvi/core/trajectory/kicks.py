r"""Kicks: what acts on a body, and how it changes the momentum at one instant.

A kick changes the momentum by the torque of one instant times a part of the step. It may also take
the double bracket of kicks with drifts,

$$K = 2\,\bigl(\tau\times a - D\tau[a]\bigr),\qquad a = J^{-1}\tau,$$

times $h^3$, with $D\tau[a]$ the change of the torque when the body turns along $a$. Two drifts
then make a method of fourth order, where a composition needs five. For the torque of a potential
$K$ is that of the potential $\tau\cdot J^{-1}\tau$, the force gradient.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, ArrayLike

from ..kernels.vectors import Mat3, Vec3, matmul
from ..typed_arrays import Shape, example_of


class Forcing(NamedTuple):
    """What acts on a body, as torques (3,) in its frame. The functions are pytrees."""

    law: Callable[[Array, Array], ArrayLike] | None = None  # of time and attitude
    rate_law: Callable[[Array, Array, Array], ArrayLike] | None = None  # and angular velocity
    # of time, attitude and momentum at the start of each step, held for all of it
    controller: Callable[[Array, Array, Array], ArrayLike] | None = None
    damping: Array | None = None  # D (3, 3) of the torque -D omega
    drag: Array | None = None  # C (3, 3) of the torque -|omega| C omega

    def examples(self, t: Array, R: Array, pi: Array) -> dict[str, tuple[Array, Shape]]:
        """Its torques at a state, and its matrices, for `as_floats`."""
        examples = {}
        if self.law is not None:
            name = "torque(t, R)"
            examples[name] = example_of(name, self.law, t, R), (3,)
        if self.rate_law is not None:
            name = "torque(t, R, omega)"
            examples[name] = example_of(name, self.rate_law, t, R, pi), (3,)
        if self.controller is not None:
            name = "controller(t, R, pi)"
            examples[name] = example_of(name, self.controller, t, R, pi), (3,)
        for name, matrix in (("matrix", self.damping), ("drag", self.drag)):
            if matrix is not None:
                examples[name] = matrix, (3, 3)
        return examples


class Acting(NamedTuple):
    """The arrays of torques: arguments of the functions of `Kicks`."""

    J: Array
    damping: Array | None
    drag: Array | None
    of_law: list[Array]
    of_rate_law: list[Array]
    of_controller: list[Array]


class Part(NamedTuple):
    """A kick, in parts of the step."""

    time: float | Array  # from the step's start
    size: float | Array
    gradient: float | Array | None = None  # of h^3, for the torque's own variation


class Kicks(NamedTuple):
    """The functions of torques, which close over no array."""

    law: Callable[..., Array]
    rate_law: Callable[..., Array] | None
    controller: Callable[..., Array] | None
    depend_on_momentum: bool

    def torque(self, acting: Acting, t: Array, R: Array) -> Array:
        return self.law(t, R, *acting.of_law)

    def held(self, acting: Acting, t: Array, R: Array, pi: Array) -> Array:
        """The controller's torque, for all of a step."""
        if self.controller is None:
            return jnp.zeros_like(pi)
        return self.controller(t, R, pi, *acting.of_controller)

    def impulse(
        self,
        acting: Acting,
        h: Array,
        rotor: Array | None,
        part: Part,
        t: Array,
        R: Array,
        pi: Array,
        tau: Array,
    ) -> Array:
        """Change of the momentum under the torque `tau` of the law and the controller.

        A law of the rate is evaluated at the middle of the kick, which an Euler step predicts: the
        explicit midpoint rule, of order two.
        """
        size, of_body = part.size * h, pi if rotor is None else pi - rotor
        law = self.rate_law
        if law is None:
            impulse = size * tau
            if part.gradient is not None:
                bracket = _bracket(acting.J, lambda R: self.torque(acting, t, R), R, tau)
                impulse -= part.gradient * h**3 * bracket
            return _damped(acting, size, of_body, impulse)

        def from_rate(at: Array) -> Array:
            torque = law(t, R, _solve(acting.J, at), *acting.of_rate_law)
            return _damped(acting, size, of_body, size * (tau + torque))

        return from_rate(of_body + from_rate(of_body) / 2)


def as_arguments(forcing: Forcing, J: Array, t: Array, R: Array, pi: Array) -> tuple[Kicks, Acting]:
    """The functions, with the arrays that they close over as arguments."""
    law, of_law = with_arguments(forcing.law, t, R)
    rate_law, of_rate_law, controller, of_controller = None, [], None, []
    if forcing.rate_law is not None:
        rate_law, of_rate_law = with_arguments(forcing.rate_law, t, R, pi)
    if forcing.controller is not None:
        controller, of_controller = with_arguments(forcing.controller, t, R, pi)
    damping, drag = (
        None if matrix is None else matrix.astype(pi.dtype)
        for matrix in (forcing.damping, forcing.drag)
    )
    depend_on_momentum = any(each is not None for each in (rate_law, damping, drag))
    kicks = Kicks(law, rate_law, controller, depend_on_momentum)
    return kicks, Acting(J, damping, drag, of_law, of_rate_law, of_controller)


def with_arguments(function: Callable[..., ArrayLike] | None, *arguments: Array):
    """A function with the arrays that it closes over as further arguments; and these arrays."""
    dtype = arguments[0].dtype

    def torque(*arguments):
        if function is None:
            return jnp.zeros(3, dtype)
        return jnp.asarray(function(*arguments)).astype(dtype)

    # Not `jax.closure_convert`, which leaves integers and keys in the closure.
    closed, count = jax.make_jaxpr(torque)(*arguments), len(arguments)
    jaxpr, arrays = closed.jaxpr, closed.consts

    def converted(*arguments):  # does not refer to the arrays, which may belong to a trace
        (result,) = jaxpr_as_fun(ClosedJaxpr(jaxpr, list(arguments[count:])))(*arguments[:count])
        return jnp.asarray(result)  # a constant is an array of NumPy

    return converted, arrays


def along(R: Array, xi: Array) -> Array:
    """R hat(xi), the change of an attitude when the body turns along `xi`."""
    return Vec3.of(R).cross(Vec3.of(xi)).array()


def _bracket(J: Array, torque: Callable[[Array], Array], R: Array, total: Array) -> Array:
    """2 (total x a - D torque [a]), where a = J^-1 total."""
    a = _solve(J, total)
    _, change = jax.jvp(torque, (R,), (along(R, a),))
    return 2 * (jnp.cross(total, a) - change)


def _damped(acting: Acting, h: Array, pi: Array, impulse: Array) -> Array:
    """The impulse plus the impulse of damping in a time `h`, if any, by the midpoint rule."""
    if acting.damping is None and acting.drag is None:
        return impulse

    def midpoint(damping: Array) -> Array:
        return _solve(acting.J + h / 2 * damping, pi + impulse / 2)

    damping = jnp.zeros_like(acting.J) if acting.damping is None else acting.damping
    if acting.drag is not None:
        # The speed at the midpoint, to the order of the rule; whatever it is, energy is lost.
        linear, omega = damping, _solve(acting.J, pi)
        for _ in range(2):
            damping = linear + _length(omega) * acting.drag
            omega = midpoint(damping)
    return impulse - h * matmul(damping, midpoint(damping))


def _length(v: Array) -> Array:
    """The length of a vector, with the derivative zero at zero."""
    square = jnp.sum(v * v)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


@jax.custom_jvp
def _solve(J: Array, b: Array) -> Array:
    trace = jnp.trace(J)  # or the determinant of a small body would underflow
    return Mat3.of(J / trace).solve(Vec3.of(b / trace)).array()


@_solve.defjvp
def _(primals, tangents):
    """By products of matrices, whose transpose is short."""
    (J, b), (dJ, db) = primals, tangents
    x, trace = _solve(J, b), jnp.trace(J)
    inverse = Mat3.of(J / trace).inverse().array()
    return x, matmul(inverse, (db - matmul(dJ, x)) / trace)
