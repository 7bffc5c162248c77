"""Torque laws: body-frame torques as functions of time and attitude, with learnable leaves."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.checks import as_floats
from ..core.components import matmul
from .body import AbstractRigidBody
from .fields import float_array, require_function, require_shape

Frame = Literal["body", "space"]
Torque = Callable[..., ArrayLike]  # of t and R: a law of this package or any function


class AbstractTorque(eqx.Module):
    """A torque law, called as `torque(t, R)`.

    Laws are added with `+` and `-` to each other and to any function of the same signature, and
    multiplied and divided by numbers.
    """

    @abstractmethod
    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m, at the time `t`, s, and the attitude `R` (3, 3)."""

    def of_body(self, body: AbstractRigidBody) -> "AbstractTorque":
        """The law for the body that it acts on: itself, unless it depends on the body."""
        return self

    def __add__(self, other: Torque) -> "TorqueSum":
        return TorqueSum((self, other)) if callable(other) else NotImplemented

    def __radd__(self, other: Torque | int) -> "AbstractTorque":
        if not callable(other) and other == 0:  # where `sum` begins
            return self
        return TorqueSum((other, self)) if callable(other) else NotImplemented

    def __sub__(self, other: Torque) -> "TorqueSum":
        return TorqueSum((self, ScaledTorque(-1.0, other))) if callable(other) else NotImplemented

    def __rsub__(self, other: Torque) -> "TorqueSum":
        return TorqueSum((other, -self)) if callable(other) else NotImplemented

    def __mul__(self, factor: ArrayLike) -> "ScaledTorque":
        return ScaledTorque(factor, self)

    __rmul__ = __mul__

    def __truediv__(self, divisor: ArrayLike) -> "ScaledTorque":
        return ScaledTorque(1.0 / divisor, self)

    def __neg__(self) -> "ScaledTorque":
        return ScaledTorque(-1.0, self)


class TorqueSum(AbstractTorque):
    """The sum of torque laws, which `+` makes.

    Parameters
    ----------
    terms
        The laws: modules, or functions of `t` and `R`.
    """

    terms: tuple[Torque, ...]

    def __check_init__(self):
        if not (isinstance(self.terms, tuple) and self.terms):
            raise TypeError(f"Argument `terms` must be a tuple of laws, but is {self.terms!r}.")
        for i, term in enumerate(self.terms):
            require_function(f"terms[{i}]", term, "t", "R")

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        values = {f"terms[{i}](t, R)": (term(t, R), (3,)) for i, term in enumerate(self.terms)}
        first, *others = as_floats(**values)
        return sum(others, start=first)

    def of_body(self, body: AbstractRigidBody) -> "TorqueSum":
        """The sum of the laws for a body."""
        return TorqueSum(tuple(of_body(term, body) for term in self.terms))


class ScaledTorque(AbstractTorque):
    """A number times a torque law, which `*` makes.

    Parameters
    ----------
    factor
        The number, a learnable leaf.
    torque
        The law: a module, or a function of `t` and `R`.

    Raises
    ------
    ValueError, TypeError
        If `factor` is not a number.
    """

    factor: Float[Array, ""] = eqx.field(converter=float_array("factor"))
    torque: Torque

    def __check_init__(self):
        require_shape("factor", self.factor, ())
        require_function("torque", self.torque, "t", "R")

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        value = {"torque(t, R)": (self.torque(t, R), (3,))}
        factor, torque = as_floats(factor=(self.factor, ()), **value)
        return factor * torque

    def of_body(self, body: AbstractRigidBody) -> "ScaledTorque":
        """The same number times the law for a body."""
        return ScaledTorque(self.factor, of_body(self.torque, body))


class ConstantTorque(AbstractTorque):
    r"""A constant torque: $\tau$ in the body frame, or $R^T\tau$ for one in the space frame.

    Parameters
    ----------
    torque
        Torque (3,), N m, a learnable leaf.
    frame
        The frame in which it is constant, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    torque: Float[Array, "3"] = eqx.field(converter=float_array("torque"))
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        require_shape("torque", self.torque, (3,))
        _require_frame(self.frame)

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        torque, R = as_floats(torque=(self.torque, (3,)), R=(R, (3, 3)))
        return torque if self.frame == "body" else matmul(R.T, torque)


class SampledTorque(AbstractTorque):
    r"""Torques at given times, with linear interpolation between them.

    For trajectories of order 2: the kinks at the samples spoil any higher one. Before the first
    sample and after the last the torque is that of the sample; `simulate` refuses to leave them.

    Parameters
    ----------
    t
        Times (samples,), s, increasing. Where a step ends at a sample, derivatives with respect
        to times are those of one side.
    torque
        Torques (samples, 3), N m, a learnable leaf.
    frame
        The frame of the torques, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    t: Float[Array, " samples"] = eqx.field(converter=float_array("t"))
    torque: Float[Array, "samples 3"] = eqx.field(converter=float_array("torque"))
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        if self.t.ndim != 1 or len(self.t) == 0:
            raise ValueError(
                f"Argument `t` must have shape (samples,), but its shape is {self.t.shape}."
            )
        require_shape("torque", self.torque, (len(self.t), 3))
        _require_frame(self.frame)

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        (samples,) = self.t.shape
        times, torques, t, R = as_floats(
            times=(self.t, (samples,)),
            torques=(self.torque, (samples, 3)),
            t=(t, ()),
            R=(R, (3, 3)),
        )
        torque = jax.vmap(jnp.interp, in_axes=(None, None, 1))(t, times, torques)
        return torque if self.frame == "body" else matmul(R.T, torque)


def of_body(torque: Torque, body: AbstractRigidBody) -> Torque:
    return torque.of_body(body) if isinstance(torque, AbstractTorque) else torque


def _require_frame(frame: str) -> None:
    if frame not in ("body", "space"):
        raise ValueError(f'Argument `frame` must be "body" or "space", but is {frame!r}.')
