"""Rotors of a drone as a source of torque, momentum and thrust."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..core.decay import fall
from ..core.typed_arrays import as_floats
from .fields import described_by, float_array, shaped_array
from .printing import show


class Multirotor(eqx.Module):
    r"""Rotors with propellers, whose speeds are recorded: torque, momentum and thrust.

    A rotor at a place $r_i - c$ from the centre of mass that turns at $\Omega_i$ about a unit axis
    $a_i$ pushes along the axis, and the air brakes its turn, whose sense is $s_i$:

    $$\tau = \sum_i \Omega_i^2\,(k_i\,(r_i - c)\times a_i - s_i\,d_i\,a_i), \qquad
      \rho = \sum_i s_i\,I_i\,\Omega_i\,a_i.$$

    In a model with a `mass` the rotors also pull the body along. The blades of a rotor that moves
    through the air in its plane meet it faster on one side, which brakes the body:

    $$F = \sum_i \bigl(\Omega_i^2\,k_i\,a_i
      - \Omega_i\,\lambda_i\,(u - (u\cdot a_i)\,a_i)\bigr),\qquad u = R^Tv,$$

    with the velocity $v$ of the centre of mass in space. The torque of this drag about the centre
    of mass is left out, and so is the wind.

    The momentum $\rho$ is a part of that of the body, as in a [`Gyrostat`][lgvi.Gyrostat]: a rotor
    that speeds up turns the body the other way.

    Speeds are positive: the sense of rotation is in `spin`. They may be commands that are
    proportional to them, such as from 0 to 1; then thrust and drag are those at a command of one,
    and the inertia is the momentum. A speed follows its command with a `lag` $T$, if there is one:
    $T\,\dot\Omega = u - \Omega$.

    Parameters
    ----------
    arms
        Places $r_i$ (rotors, 3) of the rotors, body frame, m, from the centre of mass, or from any
        point from which the centre of mass is known or free; a learnable leaf. Thrust and arms are
        known as products: free one of them.
    axes
        Directions $a_i$ of thrust, body frame: (3,) for all rotors, or (rotors, 3), of any length
        but zero, a learnable leaf of which the length is never observable.
    thrust
        Thrust over the square of the speed $k_i$, N s²: a number or (rotors,), a learnable leaf.
    drag
        Torque of the air over the square of the speed $d_i$, N m s²: a number or (rotors,), a
        learnable leaf.
    lag
        Time constant $T$, s, with which speeds follow what is recorded, a learnable leaf. `None`
        where speeds are recorded themselves.
    spin
        Sense of rotation $s_i$ of each rotor about its axis (rotors,), 1 or -1. Static.
    inertia
        Spin inertia $I_i$, kg m²: a number or (rotors,), a learnable leaf; zero by default.
    behind
        With a lag, how far each speed is behind its command at the start (rotors,), rad/s; zero by
        default. Each trajectory has its own, which a fit eliminates with the initial state.
    centre
        Centre of mass $c$ (3,) from the point from which `arms` are measured, such as the middle of
        the rotors, body frame, m, a learnable leaf; zero by default. Along parallel axes it is
        never observable.
    in_plane_drag
        Drag in the plane of the rotor, over its speed and that of the body $\lambda_i$, N s²/m: a
        number or (rotors,), a learnable leaf; zero by default.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    arms: Float[Array, "rotors 3"] = eqx.field(metadata=described_by("m", "a known thrust"))
    axes: Float[Array, "*of_axes 3"] = eqx.field(
        metadata=described_by("1", "a prior on the length")
    )
    thrust: Float[Array, "*of_thrust"] = eqx.field(
        metadata=described_by(
            "N s²", "known arms, or a known inertia,", "`axes` or `arms` may be reversed"
        )
    )
    drag: Float[Array, "*of_drag"] = eqx.field(
        metadata=described_by(
            "N m s²", "turns about the axis of thrust", "the `spin` may be reversed"
        )
    )
    inertia: Float[Array, "*of_inertia"] = eqx.field(
        metadata=described_by("kg m²", "speeds that change quickly", "the `spin` may be reversed")
    )
    lag: Float[Array, ""] | None = eqx.field(
        metadata=described_by("s", "speeds that change", "the clock of the speeds may be late")
    )
    spin: tuple[int, ...] = eqx.field(static=True)
    behind: Float[Array, " rotors"] | None = eqx.field(metadata=described_by("rad/s"))
    centre: Float[Array, "3"] = eqx.field(
        metadata=described_by("m", "rotors that are not parallel")
    )
    in_plane_drag: Float[Array, "*of_in_plane_drag"] = eqx.field(
        metadata=described_by("N s²/m", "speeds that change", "wind may blow")
    )

    def __init__(
        self,
        arms: Float[ArrayLike, "rotors 3"],
        axes: Float[ArrayLike, "*of_axes 3"],
        thrust: Float[ArrayLike, "*of_thrust"],
        drag: Float[ArrayLike, "*of_drag"],
        lag: Float[ArrayLike, ""] | None,
        spin: Sequence[int],
        inertia: Float[ArrayLike, "*of_inertia"] = 0.0,
        behind: Float[ArrayLike, " rotors"] | None = None,
        centre: Float[ArrayLike, "3"] | None = None,
        in_plane_drag: Float[ArrayLike, "*of_in_plane_drag"] = 0.0,
    ):
        self.arms = float_array("arms")(arms)
        if self.arms.ndim != 2 or self.arms.shape[1] != 3 or not len(self.arms):
            raise ValueError(
                "Argument `arms` must have shape (rotors, 3), with a rotor at least, but its shape "
                f"is {self.arms.shape}."
            )
        self.axes = float_array("axes")(axes)
        self.thrust = float_array("thrust")(thrust)
        self.drag = float_array("drag")(drag)
        self.inertia = float_array("inertia")(inertia)
        centre = np.zeros(3, self.arms.dtype) if centre is None else centre
        self.centre = shaped_array("centre", centre, (3,))
        self.in_plane_drag = float_array("in_plane_drag")(in_plane_drag)
        count = len(self.arms)
        for name, shapes in {
            "axes": ((3,), (count, 3)),
            **dict.fromkeys(("thrust", "drag", "inertia", "in_plane_drag"), ((), (count,))),
        }.items():
            if (shape := getattr(self, name).shape) not in shapes:
                raise ValueError(
                    f"Argument `{name}` must have shape {shapes[0]} or {shapes[1]}, but its shape "
                    f"is {shape}."
                )
        self.spin = _as_spin(spin, count)
        known = self.axes if not isinstance(self.axes, Tracer) else np.ones(3)
        if not np.all(np.any(np.asarray(known) != 0, axis=-1)):
            raise ValueError(
                f"Argument `axes` must have a direction for each rotor, but is {self.axes}."
            )
        self.lag = self.behind = None
        if lag is not None:
            self.lag = shaped_array("lag", lag, ())
            if not isinstance(self.lag, Tracer) and not float(np.asarray(self.lag)) > 0:
                raise ValueError(f"Argument `lag` must be above 0 s, but is {self.lag}.")
            self.behind = jnp.zeros_like(self.arms[:, 0])
        if behind is not None:
            if lag is None:
                raise ValueError("Argument `behind` must be None where `lag` is None.")
            self.behind = shaped_array("behind", behind, (count,))

    def __repr__(self) -> str:
        return show(self)

    def torque(self, speeds: Float[ArrayLike, " rotors"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m, at speeds of the rotors, rad/s."""
        names = "thrust", "drag", "arms", "centre"
        speeds, axes, thrust, drag, arms, centre = self._at(speeds, *names)
        squares = speeds * speeds
        braking = (self._senses(axes) * drag * squares) @ axes
        return (thrust * squares) @ jnp.cross(arms - centre[None], axes) - braking

    def thrust_force(self, speeds: Float[ArrayLike, " rotors"]) -> Float[Array, "3"]:
        """Sum of the thrusts (3,) in the body frame, N, at speeds of the rotors, rad/s."""
        speeds, axes, thrust = self._at(speeds, "thrust")
        return (thrust * speeds * speeds) @ axes

    def drag_matrix(self, speeds: Float[ArrayLike, " rotors"]) -> Float[Array, "3 3"]:
        """Drag in the planes of the rotors over the velocity (3, 3), body frame, N s/m."""
        speeds, axes, drag = self._at(speeds, "in_plane_drag")
        sizes = drag * speeds
        along = jnp.sum(sizes[..., None, None] * (axes[:, :, None] * axes[:, None, :]), axis=0)
        return jnp.sum(sizes) * jnp.eye(3, dtype=axes.dtype) - along

    def follow(
        self, commands: Float[ArrayLike, "times rotors"], dt: Float[ArrayLike, " steps"]
    ) -> Float[Array, "times rotors"]:
        r"""Speeds (times, rotors) that follow commands, which are linear between the times.

        From a time to the next, $h$ later, they are
        $\Omega' = u' - g\,(u' - u) + e^{-h/T}\,(\Omega - u)$ with $g = (1 - e^{-h/T})\,T/h$.
        Without a lag they are the commands. With a lag that is not above zero they are NaN.
        """
        count, steps = len(self.arms), jnp.size(dt)
        arguments = {"commands": (commands, (steps + 1, count)), "dt": (dt, (steps,))}
        if self.lag is None or self.behind is None:
            return as_floats(**arguments)[0]
        arguments |= {"lag": (self.lag, ()), "behind": (self.behind, (count,))}
        u, h, lag, behind = as_floats(**arguments)
        ratio = h / jnp.where(lag > 0, lag, jnp.nan)
        kept, mean = jnp.exp(-ratio), 1 - ratio * fall(ratio)

        def step(speed: Array, each: tuple[Array, ...]) -> tuple[Array, Array]:
            before, after, kept, mean = each
            speed = after - mean * (after - before) + kept * (speed - before)
            return speed, speed

        start = u[0] - behind
        _, later = jax.lax.scan(step, start, (u[:-1], u[1:], kept, mean))
        return jnp.concatenate([start[None], later])

    def momentum(self, speeds: Float[ArrayLike, " rotors"]) -> Float[Array, "3"]:
        """Momentum of the rotors (3,) in the body frame, kg m²/s, at their speeds, rad/s."""
        speeds, axes, inertia = self._at(speeds, "inertia")
        return (self._senses(axes) * inertia * speeds) @ axes

    def _at(self, speeds: ArrayLike, *names: str) -> list[Array]:
        """Speeds, unit axes (rotors, 3) and other fields, in one precision."""
        count = len(self.arms)
        fields = {name: getattr(self, name) for name in ("axes", *names)}
        speeds, axes, *others = as_floats(
            speeds=(speeds, (count,)), **{name: (x, x.shape) for name, x in fields.items()}
        )
        axes = axes / jnp.sqrt(jnp.sum(axes * axes, axis=-1, keepdims=True))
        return [speeds, jnp.broadcast_to(axes, (count, 3)), *others]

    def _senses(self, like: Array) -> Array:
        return jnp.asarray(self.spin, like.dtype)


def _as_spin(spin: Sequence[int], count: int) -> tuple[int, ...]:
    try:
        senses = tuple(1 if sense == 1 else -1 if sense == -1 else 0 for sense in spin)
    except (TypeError, ValueError):  # no sequence, or one of arrays
        senses = ()
    if len(senses) != count or 0 in senses:
        raise ValueError(
            f"Argument `spin` must be 1 or -1 for each of {count} rotors, but is {spin!r}."
        )
    return senses
