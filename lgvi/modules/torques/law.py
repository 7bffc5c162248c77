"""Torque laws: torques in the body frame as functions of the state, with learnable leaves."""

import inspect
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ...core.typed_arrays import Shape, as_floats
from ..body import AbstractRigidBody
from ..fields import described_by, float_array, require_function, require_shape
from ..forces.law import AbstractForce, Force, ForceSum, ScaledForce
from ..printing import show

Torque = Callable[..., ArrayLike]  # of t and R, or of t, R and omega
HIGHEST_ORDER = 8  # of a simulation under torques
_OF_ATTITUDE, _OF_RATE = ("t", "R"), ("t", "R", "omega")


class Summand(NamedTuple):
    """A factor, or None for one, times a law."""

    factor: Array | None
    law: "AbstractTorque"


class AbstractTorque(eqx.Module):
    """A torque law: `torque(t, R)`, or `torque(t, R, omega)` if it depends on the rate.

    Laws are added with `+` and `-` to each other and to any function of the same arguments, and
    multiplied and divided by numbers. A simulation goes by what a law says of itself in the
    properties below; a law of your own overrides a property that differs.
    """

    def __repr__(self) -> str:
        return show(self)

    @abstractmethod
    def __call__(self, *args: Any, **kwargs: Any) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m.

        It takes the time `t`, s, the attitude `R` (3, 3), and the angular velocity `omega` (3,),
        body frame, rad/s, if the law depends on the rate.
        """

    @property
    def depends_on_attitude(self) -> bool:
        """Whether the torque in the body frame depends on the attitude.

        If False, the law must not use `R`, which it then gets from any time.
        """
        return True

    @property
    def depends_on_rate(self) -> bool:
        """Whether the torque depends on the angular velocity."""
        return False

    @property
    def linear_damping(self) -> Float[Array, "3 3"] | None:
        r"""The matrix $D$ of a law that is $-D\omega$ and nothing else; None for other laws.

        With a matrix the integrator does not call the law. It takes the torque by the implicit
        midpoint rule, so that it never adds energy.
        """
        return None

    @property
    def quadratic_damping(self) -> Float[Array, "3 3"] | None:
        r"""The matrix $C$ of a law that is $-|\omega|\,C\omega$ and nothing else, or None."""
        return None

    @property
    def force_law(self) -> Force | None:
        """The force that the same cause has, as a law of `t`, `R`, `omega` and `v`; None if none.

        It acts at the centre of mass where a simulation or a model has a `mass`.
        """
        return None

    @property
    def _kind(self) -> str:
        return type(self).__name__

    @property
    def highest_order(self) -> int:
        """The highest order of a simulation: 2, or less, if the law depends on the rate."""
        return 2 if self.depends_on_rate else HIGHEST_ORDER

    @property
    def reason_for_highest_order(self) -> str:
        """Why there is no higher order, for the error message."""
        return (
            "methods of a higher one go back in time too, where damping gains energy, or take the "
            "variation of a torque that depends on the attitude alone"
        )

    def of_body(self, body: AbstractRigidBody) -> "AbstractTorque":
        """The law for the body that it acts on: itself, unless it depends on the body."""
        return self

    def during(self, times: Callable[[], Array], throw: bool) -> "AbstractTorque":
        """The law for a simulation over `times()`: itself, unless it is known at some times only.

        If it does not cover them, it raises if `throw`, and else is NaN.
        """
        return self

    def summands(self) -> tuple[Summand, ...]:
        """The laws of which it is the sum: itself, unless it is a sum or a multiple of one."""
        return (Summand(None, self),)

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
    """The sum of torque laws, which `+` makes. Its properties follow from those of its terms.

    Parameters
    ----------
    terms
        The laws: modules, or functions of `t` and `R`, or of `t`, `R` and `omega`.
    """

    terms: tuple[Torque, ...]

    def __check_init__(self):
        if not (isinstance(self.terms, tuple) and self.terms):
            raise TypeError(f"Argument `terms` must be a tuple of laws, but is {self.terms!r}.")
        self._laws()

    def _laws(self) -> list[AbstractTorque]:
        return [as_law(f"terms[{i}]", term) for i, term in enumerate(self.terms)]

    def __call__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"] | None = None,
    ) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        torques = (call(law, t, R, omega) for law in self._laws())
        values = {f"terms[{i}](t, R)": (torque, (3,)) for i, torque in enumerate(torques)}
        first, *others = as_floats(**values)
        return sum(others, start=first)

    @property
    def depends_on_attitude(self) -> bool:
        """Whether a term depends on the attitude."""
        return any(law.depends_on_attitude for law in self._laws())

    @property
    def depends_on_rate(self) -> bool:
        """Whether a term depends on the angular velocity."""
        return any(law.depends_on_rate for law in self._laws())

    @property
    def highest_order(self) -> int:
        """The least of the highest orders of the terms."""
        return min(law.highest_order for law in self._laws())

    @property
    def force_law(self) -> Force | None:
        """The sum of the forces of the terms."""
        forces = tuple(law.force_law for law in self._laws() if law.force_law is not None)
        return ForceSum(forces) if forces else None

    def of_body(self, body: AbstractRigidBody) -> "TorqueSum":
        """The sum of the laws for a body."""
        return TorqueSum(tuple(law.of_body(body) for law in self._laws()))

    def summands(self) -> tuple[Summand, ...]:
        """The summands of all terms."""
        return tuple(each for law in self._laws() for each in law.summands())


class ScaledTorque(AbstractTorque):
    """A number times a torque law, which `*` makes.

    Parameters
    ----------
    factor
        The number, a learnable leaf.
    torque
        The law: a module, or a function of `t` and `R`, or of `t`, `R` and `omega`.

    Raises
    ------
    ValueError, TypeError
        If `factor` is not a number.
    """

    factor: Float[Array, ""] = eqx.field(
        converter=float_array("factor"), metadata=described_by("1")
    )
    torque: Torque

    def __check_init__(self):
        require_shape("factor", self.factor, ())
        self._law()

    def _law(self) -> AbstractTorque:
        return as_law("torque", self.torque)

    def __call__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"] | None = None,
    ) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        torque = call(self._law(), t, R, omega)
        return multiply(self.factor, "torque(t, R)", torque, (3,))

    @property
    def depends_on_attitude(self) -> bool:
        """Whether the law depends on the attitude."""
        return self._law().depends_on_attitude

    @property
    def depends_on_rate(self) -> bool:
        """Whether the law depends on the angular velocity."""
        return self._law().depends_on_rate

    @property
    def highest_order(self) -> int:
        """The highest order of the law."""
        return self._law().highest_order

    @property
    def force_law(self) -> Force | None:
        """The number times the force of the law."""
        force = self._law().force_law
        return None if force is None else ScaledForce(self.factor, force)

    def of_body(self, body: AbstractRigidBody) -> "ScaledTorque":
        """The same number times the law for a body."""
        return ScaledTorque(self.factor, self._law().of_body(body))

    def _times(self, factor: Array | None) -> Array:
        return self.factor if factor is None else multiply(self.factor, "factor", factor, ())

    def summands(self) -> tuple[Summand, ...]:
        """The summands of the law, times the number."""
        return tuple(Summand(self._times(factor), law) for factor, law in self._law().summands())


class _FunctionTorque(AbstractTorque):
    """A function of `t` and `R`, or of `t`, `R` and `omega`, as a law."""

    function: Torque
    arguments: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    @property
    def depends_on_rate(self) -> bool:
        return "omega" in self.arguments

    @property
    def _kind(self) -> str:
        return f"function of ({', '.join(self.arguments)})"


def as_law(name: str, torque: Torque) -> AbstractTorque:
    """A torque law, or one that is a function.

    Raises
    ------
    TypeError
        If it is not a function of `t` and `R`, or of `t`, `R` and `omega`.
    """
    if isinstance(torque, AbstractTorque):
        return torque
    if isinstance(torque, AbstractForce):
        raise TypeError(
            f"Argument `{name}` must be a torque law, but is the force law {torque!r}: give it as "
            "`force`, with a `mass`; a `Thruster` is a force at a place."
        )
    known = (_OF_RATE, _OF_ATTITUDE) if _names_omega(torque) else (_OF_ATTITUDE, _OF_RATE)
    return _FunctionTorque(torque, require_function(name, torque, *known))


def require_arguments(law: AbstractTorque) -> None:
    """Check that a law takes the arguments that follow from what it says of itself.

    Raises
    ------
    TypeError
        If it does not.
    """
    depends = law.depends_on_rate
    if not isinstance(depends, bool):
        raise TypeError(
            f"`depends_on_rate` of `{law._kind}` must be True or False, as a property or a class "
            f"attribute, but is {depends!r}."
        )
    try:
        require_function("torque", law, _OF_RATE if depends else _OF_ATTITUDE)
    except TypeError as error:
        words = f"Property `depends_on_rate` of `{law._kind}` is {depends}."
        raise TypeError(f"{error} {words}") from None


def _names_omega(function: Any) -> bool:
    """Whether the third argument is called `omega`; it may have a default then."""
    try:
        return list(inspect.signature(function).parameters)[2:3] == ["omega"]
    except (TypeError, ValueError):  # not a function, or one that does not tell
        return False


def call(law: AbstractTorque, t: Any, R: Any, omega: Any) -> Any:
    """The torque of a law, which gets `omega` only if it depends on the rate."""
    return law(t, R, omega) if law.depends_on_rate else law(t, R)


def multiply(factor: Array, name: str, value: ArrayLike, shape: Shape) -> Array:
    """The product of a number and a torque or a matrix, in their common type."""
    factor, value = as_floats(**{"factor": (factor, ()), name: (value, shape)})
    return factor * value
