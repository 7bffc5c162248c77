"""Force laws: forces in the body frame, at the centre of mass, with learnable leaves."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.typed_arrays import as_floats
from ..fields import described_by, float_array, require_function, require_shape
from ..printing import show

Force = Callable[..., ArrayLike]  # of t, R, omega and v


class AbstractForce(eqx.Module):
    """A force law: `force(t, R, omega, v)` is the force in the body frame, N.

    Laws are added with `+` and `-` to each other and to any function of the same arguments, and
    multiplied and divided by numbers. Where a force has a place too, and so a torque, it is a
    torque law with a `force_law`, such as a [`Thruster`][lgvi.Thruster].
    """

    def __repr__(self) -> str:
        return show(self)

    @abstractmethod
    def __call__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"],
        v: Float[ArrayLike, "3"],
    ) -> Float[Array, "3"]:
        """Force (3,) in the body frame, N.

        It takes the time, s, the attitude (3, 3), the angular velocity (3,), body frame, rad/s, and
        the velocity of the centre of mass (3,), space frame, m/s. A law that does not use the
        velocity needs no motion of the centre of mass.
        """

    def during(self, times: Callable[[], Array], throw: bool) -> "AbstractForce":
        """The law for a simulation over `times()`: itself, unless it is known at some times only.

        If it does not cover them, it raises if `throw`, and else is NaN.
        """
        return self

    def __add__(self, other: Force) -> "ForceSum":
        return ForceSum((self, other)) if callable(other) else NotImplemented

    def __radd__(self, other: Force | int) -> "AbstractForce":
        if not callable(other) and other == 0:  # where `sum` begins
            return self
        return ForceSum((other, self)) if callable(other) else NotImplemented

    def __sub__(self, other: Force) -> "ForceSum":
        return ForceSum((self, ScaledForce(-1.0, other))) if callable(other) else NotImplemented

    def __mul__(self, factor: ArrayLike) -> "ScaledForce":
        return ScaledForce(factor, self)

    __rmul__ = __mul__

    def __truediv__(self, divisor: ArrayLike) -> "ScaledForce":
        return ScaledForce(1.0 / divisor, self)

    def __neg__(self) -> "ScaledForce":
        return ScaledForce(-1.0, self)


class ForceSum(AbstractForce):
    """The sum of force laws, which `+` makes.

    Parameters
    ----------
    terms
        The laws: modules, or functions of `t`, `R`, `omega` and `v`.
    """

    terms: tuple[Force, ...]

    def __check_init__(self):
        if not (isinstance(self.terms, tuple) and self.terms):
            raise TypeError(f"Argument `terms` must be a tuple of laws, but is {self.terms!r}.")
        for i, term in enumerate(self.terms):
            require_force(f"terms[{i}]", term)

    def __call__(self, t: Any, R: Any, omega: Any, v: Any) -> Float[Array, "3"]:
        """Force (3,) in the body frame, N."""
        forces = (jnp.asarray(term(t, R, omega, v)) for term in self.terms)
        first, *others = as_floats(**{f"terms[{i}]": (f, (3,)) for i, f in enumerate(forces)})
        return sum(others, start=first)

    def during(self, times: Callable[[], Array], throw: bool) -> "ForceSum":
        """The sum of the laws for a simulation."""
        return ForceSum(tuple(during(term, times, throw) for term in self.terms))


class ScaledForce(AbstractForce):
    """A number times a force law, which `*` makes.

    Parameters
    ----------
    factor
        The number, a learnable leaf.
    force
        The law: a module, or a function of `t`, `R`, `omega` and `v`.

    Raises
    ------
    ValueError, TypeError
        If `factor` is not a number.
    """

    factor: Float[Array, ""] = eqx.field(
        converter=float_array("factor"), metadata=described_by("1")
    )
    force: Force

    def __check_init__(self):
        require_shape("factor", self.factor, ())
        require_force("force", self.force)

    def __call__(self, t: Any, R: Any, omega: Any, v: Any) -> Float[Array, "3"]:
        """Force (3,) in the body frame, N."""
        force = jnp.asarray(self.force(t, R, omega, v))
        factor, force = as_floats(factor=(self.factor, ()), force=(force, (3,)))
        return factor * force

    def during(self, times: Callable[[], Array], throw: bool) -> "ScaledForce":
        """The number times the law for a simulation."""
        return ScaledForce(self.factor, during(self.force, times, throw))


def require_force(name: str, force: Any) -> None:
    """Check that an argument is a force law, or a function that can be one."""
    if hasattr(force, "force_law"):
        raise TypeError(
            f"Argument `{name}` must be a force law, but is the torque law {force!r}: give it as "
            "`torque`, and a `mass` for the force that it has."
        )
    require_function(name, force, ("t", "R", "omega", "v"))


def during(force: Force, times: Callable[[], Array], throw: bool) -> Force:
    """A law, or a function, for a simulation."""
    return force.during(times, throw) if isinstance(force, AbstractForce) else force
