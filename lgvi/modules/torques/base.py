"""Torque laws: body-frame torques as functions of time and attitude, with learnable leaves."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ...core.checks import as_floats
from ..body import AbstractRigidBody
from ..fields import float_array, require_function, require_shape

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


def of_body(torque: Torque, body: AbstractRigidBody) -> Torque:
    return torque.of_body(body) if isinstance(torque, AbstractTorque) else torque
