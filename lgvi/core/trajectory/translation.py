r"""The motion of the centre of mass along the steps of a rotation.

The rotation is known, as no torque depends on where the body is or how fast it moves. From the
accelerations $a_k$ at the ends of the steps the discrete Euler-Lagrange equations of the
translation give

$$v_{k+1/2} = v_k + \tfrac h2a_k,\qquad x_{k+1} = x_k + h\,v_{k+1/2},\qquad
  v_{k+1} = v_{k+1/2} + \tfrac h2a_{k+1}.$$

This is symmetric, of order two, and exact for a constant acceleration; the momentum changes by the
impulses alone. Where $a_{k+1}$ depends on $v_{k+1}$, Newton's method solves the last equation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.dependence import operations_of, reached
from ..kernels.vectors import Mat3, Vec3
from ..typed_arrays import Shape, example_of

NEWTON_ITERS = 4  # one is exact where the force is linear in the velocity

ArrayOrNumpy = Any  # arrays of JAX, and zeros of no precision
# Of what the rotation gives at an instant, any pytree, and of the velocity (3,).
Acceleration = Callable[[Any, Array], Array]


class CentrePath(NamedTuple):
    """Positions and velocities (..., 3) in the space frame, m and m/s."""

    x: ArrayOrNumpy
    v: ArrayOrNumpy


class CentreOfMass(NamedTuple):
    """The centre of mass of a body that turns: a pytree. All vectors are in the space frame."""

    start: CentrePath
    gravity: ArrayOrNumpy  # (3,), m/s²
    specific_force: Callable[..., Array]  # of t, R, omega and v, body frame, m/s²

    def examples(self, t: Array, R: Array, omega: Array) -> dict[str, tuple[Array, Shape]]:
        """Its arrays, for `as_floats`."""
        force = example_of("force(t, R, omega, v)", self.specific_force, t, R, omega, omega)
        arrays = {"x0": self.start.x, "v0": self.start.v, "gravity": self.gravity}
        return {name: (x, (3,)) for name, x in (arrays | {"force(t, R, omega, v)": force}).items()}

    def acceleration(self, instant: tuple[Array, Array, Array], v: Array) -> Array:
        """The acceleration (3,) in space, at a time, an attitude and a rate."""
        t, R, omega = instant
        force = jnp.asarray(self.specific_force(t, R, omega, v)).astype(v.dtype)
        return self.gravity + (Mat3.of(R) @ Vec3.of(force)).array()


def depends_on_velocity(acceleration: Acceleration, instant: Any, v: Array) -> bool:
    """Whether an acceleration depends on the velocity."""
    leaves, structure = jax.tree.flatten(instant)

    def of_arrays(*arrays: Array) -> Array:
        return acceleration(jax.tree.unflatten(structure, arrays[:-1]), arrays[-1])

    return any(reached(operations_of(of_arrays, *leaves, v), [len(leaves)]))


def translate(
    acceleration: Acceleration, start: CentrePath, h: Array, begins: Any, ends: Any
) -> CentrePath:
    """The path (steps+1, ...), with its start, for steps of sizes `h` (steps,).

    `begins` and `ends` (steps, ...) are what the rotation gives at both ends of each step.
    """
    first = jax.tree.map(lambda array: array[0], begins)
    if not depends_on_velocity(acceleration, first, start.v):
        of_ends = jax.vmap(acceleration, (0, None))
        before, after = (h[:, None] / 2 * of_ends(instants, start.v) for instants in (begins, ends))
        v = _sums(start.v, before + after)
        return CentrePath(_sums(start.x, h[:, None] * (v[:-1] + before)), v)

    def step(path: CentrePath, inputs: Any) -> tuple[CentrePath, CentrePath]:
        h, begin, end = inputs
        half = path.v + h / 2 * acceleration(begin, path.v)
        v = _solve(lambda v: half + h / 2 * acceleration(end, v), half)
        path = CentrePath(path.x + h * half, v)
        return path, path

    _, later = jax.lax.scan(step, start, (h, begins, ends))
    return jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), start, later)


def _solve(velocity: Callable[[Array], Array], start: Array) -> Array:
    """The velocity that equals a function of itself; NaN if Newton's method does not find it."""
    v = start
    for _ in range(NEWTON_ITERS):
        slope = jnp.eye(3, dtype=v.dtype) - jax.jacfwd(velocity)(v)
        v = v - Mat3.of(slope).solve(Vec3.of(v - velocity(v))).array()
    error, size = jnp.max(abs(v - velocity(v))), jnp.maximum(jnp.max(abs(v)), jnp.max(abs(start)))
    return jnp.where(error <= jnp.sqrt(jnp.finfo(v.dtype).eps) * size, v, jnp.nan)


def _sums(first: Array, changes: Array) -> Array:
    """A vector after each change (steps+1, ...), the first included."""
    return jnp.concatenate([first[None], first[None] + jnp.cumsum(changes, axis=0)])
