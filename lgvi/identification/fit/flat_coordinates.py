"""Coordinates of the free leaves in which the prior is flat, and the posterior about normal.

The prior is flat in the numbers in which the inertia of a body is linear: its second moments of
mass. A motion depends on them smoothly, also where the least of them vanishes, at the limit of
what a body can have; their logarithms, which are the leaves, do not. Numbers have limits: the
density is continued beyond a limit by its mirror image, so that a sampler goes everywhere.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.inertia import inertia_from_discrete, log_cholesky_from_inertia
from ...modules.body import PhysicalRigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..model.free_leaves import Free, FreeBody, bodies_in, inertias_and_derivatives
from ..uncertainty.information import Information
from ..uncertainty.observability import find_unobservable_scales

SMALL = 0.02  # second moment, of the largest, at least where the problem is linearised
NOT_SEEN = 1e-4  # part of a direction that is observable, up to which the direction is not
LOWER = np.tril_indices(3)


class SecondMoments(NamedTuple):
    """The second moments of a body, as numbers in the place of its leaves.

    About the principal axes of the estimate, the largest first, a matrix of second moments
    $S = ((B, v), (v^T, s))$ has the numbers $B$, $v$ and $s - v^T B^{-1} v$, which is positive
    where $S$ is, and has the limit 0. Volumes of the numbers are those of $S$, as only a function
    of the others is subtracted from $s$. Without `axes` the numbers are those along known axes.
    """

    at: tuple[int, ...]  # among the free leaves
    axes: np.ndarray | None  # (3, 3), in columns

    def matrix(self, numbers: Array) -> Array:
        """$S$ (3, 3) about the axes."""
        if self.axes is None:
            along = numbers if len(self.at) == 3 else numbers[np.array([0, 0, 1])]
            return jnp.diag(along)
        S = jnp.zeros((3, 3), numbers.dtype).at[LOWER].set(numbers)
        (a, b, c), (v, w) = (S[0, 0], S[1, 0], S[1, 1]), S[2, :2]
        S = S.at[2, 2].add((v * v * c - 2 * v * w * b + w * w * a) / (a * c - b * b))
        return S + jnp.tril(S, -1).T

    def leaves(self, S: Array) -> Array:
        """The leaves of the body; NaN where no body has such second moments."""
        if self.axes is None:
            return jnp.log(jnp.diagonal(S)[-len(self.at) :])
        axes = jnp.asarray(self.axes, S.dtype)
        return log_cholesky_from_inertia(inertia_from_discrete(axes @ S @ axes.T))


class Limits(NamedTuple):
    """Limits (n,) of some numbers, of which that of most weight is first."""

    values: np.ndarray  # (n,), of the numbers at zero coordinates
    normals: np.ndarray  # (n, k), their derivatives
    directions: np.ndarray  # (n, k), that change a number by 1, and none before it
    lower: np.ndarray  # (n,)
    upper: np.ndarray  # (n,)

    def mirror(self, z: Array) -> Array:
        """Coordinates (k,) within the limits, of which `z` is the mirror image, or `z` itself."""
        for value, normal, direction, lower, upper in zip(*map(jnp.asarray, self), strict=True):
            number = value + normal @ z
            z = z + direction * (_mirror(number, lower, upper) - number)
        return z


class SameScale(NamedTuple):
    """Numbers that are known as parts of the trace of second moments alone."""

    bodies: tuple[int, ...]  # whose traces are added, among those with second moments
    others: np.ndarray  # (p,), True for other leaves
    size: int  # number of all numbers
    trace: np.ndarray  # at the estimate


class FlatCoordinates(NamedTuple):
    """From standard normal coordinates (k,), about, to the free leaves (p,)."""

    numbers: np.ndarray  # (p,), in the places of the leaves, at the estimate
    lower: np.ndarray  # (p,), limits of the numbers
    upper: np.ndarray  # (p,)
    of_numbers: np.ndarray  # (p, k), the derivative of the numbers
    of_theta: np.ndarray  # (p, k), of the leaves, where second moments do not vanish
    limits: Limits
    bodies: tuple[SecondMoments, ...]
    scales: tuple[SameScale, ...]

    def leaves_at(self, z: Array) -> tuple[Array, Array]:
        """The free leaves (p,), NaN where there are none, and the logarithm of a volume.

        Coordinates are within limits. Numbers that are known over their trace alone are those over
        their trace, of which the volume is that for a volume of coordinates. To first order it is
        constant. A function of n numbers that keeps volumes and multiples, such as that from the
        numbers to $S$, changes the volume of their ratios by the n-th power of the trace.
        """
        numbers = jnp.asarray(self.numbers) + jnp.asarray(self.of_numbers) @ z
        within = (jnp.asarray(self.lower) <= numbers) & (numbers <= jnp.asarray(self.upper))
        theta = jnp.where(within, numbers, jnp.nan)
        volume = jnp.zeros((), z.dtype)
        moments = [body.matrix(theta[np.array(body.at)]) for body in self.bodies]
        for scale in self.scales:
            trace = sum(jnp.trace(moments[k]) for k in scale.bodies)
            factor = jnp.asarray(scale.trace, z.dtype) / trace
            theta = jnp.where(jnp.asarray(scale.others), theta * factor, theta)
            for k in scale.bodies:
                moments[k] = moments[k] * factor
            volume = volume + scale.size * jnp.log(factor)
        for body, S in zip(self.bodies, moments, strict=True):
            theta = theta.at[np.array(body.at)].set(body.leaves(S))
        return theta, volume


def make_inner(parameters: Any, free: Free) -> Free:
    """The free leaves where no second moment of a body is much smaller than the largest.

    There the logarithms of second moments are as good coordinates as the second moments.
    """
    theta = free.theta.copy()
    J, _ = inertias_and_derivatives(parameters, free)
    for inertia, body in zip(J, free.bodies, strict=True):
        kind = _class_of(parameters, body)
        if kind is KnownAxesRigidBody:
            largest = np.max(theta[body.at])
            theta[body.at] = np.maximum(theta[body.at], largest + np.log(SMALL))
        elif kind is PhysicalRigidBody:
            sizes, axes = np.linalg.eigh(_second_moments(inertia))
            if sizes[0] < SMALL * sizes[2]:
                S = axes * np.maximum(sizes, SMALL * sizes[2]) @ axes.T
                J_inner = np.trace(S) * np.eye(3) - S
                theta[body.at] = np.asarray(log_cholesky_from_inertia(J_inner))
    return free._replace(theta=theta)


def make_flat_coordinates(
    parameters: Any,
    free: Free,
    inner: Free,
    of_theta: np.ndarray,
    known: Information,
) -> FlatCoordinates:
    """Coordinates about the estimate, with the derivative (p, k) of the leaves at the inner point.

    No leaf of a body has bounds.
    """
    numbers, lower, upper = free.theta.copy(), free.lower.copy(), free.upper.copy()
    of_numbers, bodies, with_moments = of_theta.copy(), [], []
    J, derivatives = inertias_and_derivatives(parameters, inner)
    J_estimate, _ = inertias_and_derivatives(parameters, free)
    for k, body in enumerate(free.bodies):
        kind, places = _class_of(parameters, body), tuple(np.flatnonzero(body.at).tolist())
        if kind is KnownAxesRigidBody:
            numbers[body.at] = np.exp(free.theta[body.at])
            of_numbers[body.at] *= np.exp(inner.theta[body.at])[:, None]
            lower[body.at] = 0
            bodies.append(SecondMoments(places, None))
            with_moments.append(k)
        elif kind is PhysicalRigidBody:
            axes = np.linalg.eigh(_second_moments(J_estimate[k]))[1][:, ::-1]
            numbers[body.at] = (axes.T @ _second_moments(J_estimate[k]) @ axes)[LOWER]
            S_of_z = _second_moments(np.moveaxis(derivatives[k] @ of_theta, -1, 0))
            of_numbers[body.at] = (axes.T @ S_of_z @ axes)[:, *LOWER].T
            lower[places[-1]] = 0
            bodies.append(SecondMoments(places, axes))
            with_moments.append(k)
    scales = []
    traces = np.trace(J, axis1=1, axis2=2)
    slopes = np.trace(derivatives, axis1=1, axis2=2) @ of_theta
    for scale in find_unobservable_scales(free, known).values():
        members = [k for k, body in enumerate(free.bodies) if scale.theta[body.at].any()]
        others = np.isin(free.leaves, scale.leaves)
        at = others | np.any([free.bodies[k].at for k in members], axis=0)
        slope = slopes[members].sum(0) / traces[members].sum()
        of_numbers[at] -= np.multiply.outer(numbers[at], slope)
        trace = np.trace(J_estimate[members], axis1=1, axis2=2).sum() / 2
        positions = tuple(with_moments.index(k) for k in members)
        scales.append(SameScale(positions, others, int(np.sum(at)), np.array(trace)))
    limits = _order_limits(numbers, of_numbers, lower, upper)
    return FlatCoordinates(
        numbers, lower, upper, of_numbers, of_theta, limits, tuple(bodies), tuple(scales)
    )


def _class_of(parameters: Any, body: FreeBody) -> type:
    return type(bodies_in(parameters)[body.position])


def _second_moments(J: np.ndarray) -> np.ndarray:
    """Second moments of mass (..., 3, 3) of inertias."""
    return np.trace(J, axis1=-2, axis2=-1)[..., None, None] / 2 * np.eye(3) - J


def _order_limits(
    numbers: np.ndarray, of_numbers: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> Limits:
    """The limits of numbers, the nearest first, without those that depend on nearer ones."""
    widths = np.linalg.norm(of_numbers, axis=1)
    limited = (np.isfinite(lower) | np.isfinite(upper)) & (widths > 0)
    room = np.minimum(numbers - lower, upper - numbers) / np.where(limited, widths, 1)
    chosen, basis, directions = [], np.zeros((0, of_numbers.shape[1])), []
    for i in sorted(np.flatnonzero(limited), key=lambda i: room[i]):
        across = of_numbers[i] - basis.T @ (basis @ of_numbers[i])
        length = np.linalg.norm(across)
        if length > NOT_SEEN * widths[i]:
            chosen.append(i)
            directions.append(across / length**2)
            basis = np.concatenate([basis, across[None] / length])
    return Limits(
        numbers[chosen],
        of_numbers[chosen],
        np.reshape(directions, (-1, of_numbers.shape[1])),
        lower[chosen],
        upper[chosen],
    )


def _mirror(number: Array, lower: Array, upper: Array) -> Array:
    """A number between limits, of which a number is the mirror image; limits may be infinite."""
    has_lower, has_upper = jnp.isfinite(lower), jnp.isfinite(upper)
    low, high = jnp.where(has_lower, lower, 0), jnp.where(has_upper, upper, 0)
    width = jnp.where(has_lower & has_upper, high - low, 1)
    between = low + abs(jnp.mod(number - low + width, 2 * width) - width)
    one_sided = jnp.where(has_lower, low + abs(number - low), high - abs(high - number))
    return jnp.where(has_lower & has_upper, between, one_sided)
