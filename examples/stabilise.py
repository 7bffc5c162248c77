"""Feedback: which gains of an attitude controller settle a body best?

    python examples/stabilise.py
    python examples/stabilise.py --plot stabilise.png

A geometric PD law turns a body by 0.8 rad to its set point, as flight software would: it is
evaluated ten times a second, and its torque is held in between. The gains are then improved by
gradient descent through the simulation.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import lgvi

jax.config.update("jax_enable_x64", True)

BODY = lgvi.RigidBody.from_principal_moments(jnp.array([1.0, 2.0, 2.5]))
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=0.1)
STEPS = 80
R0 = lgvi.so3.exp(0.8 * jnp.array([2.0, -1.0, 2.0]) / 3)


class GeometricPD(eqx.Module):
    """The torque -k_R e_R - k_omega omega with e_R = vee(R - R^T)/2.

    T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC
    2010, doi:10.1109/CDC.2010.5717652.
    """

    body: lgvi.RigidBody
    attitude_gain: Float[Array, ""]
    rate_gain: Float[Array, ""]

    def __call__(self, t: Array, R: Array, pi: Array) -> Array:
        error = lgvi.so3.vee((R - R.T) / 2)
        return -self.attitude_gain * error - self.rate_gain * self.body.angular_velocity(pi)


def simulate(controller: GeometricPD) -> lgvi.Trajectory:
    return INTEGRATOR.simulate(BODY, R0, jnp.zeros(3), steps=STEPS, controller=controller)


def angles(R: Float[Array, "states 3 3"]) -> Float[Array, " states"]:
    """Angles to the set point, rad."""
    return jnp.linalg.norm(jax.vmap(lgvi.so3.log)(R), axis=1)


def cost(gains: Float[Array, "2"], controller: GeometricPD) -> Float[Array, ""]:
    """Mean square of the sine of the angle, plus a hundredth of the mean square of the torque."""
    tuned = with_gains(controller, gains)
    R, pi, _ = simulate(tuned)
    torque = jax.vmap(tuned, in_axes=(None, 0, 0))(jnp.zeros(()), R, pi)
    sines = jax.vmap(lambda R: lgvi.so3.vee((R - R.T) / 2))(R)
    return jnp.mean(jnp.sum(sines**2, axis=1)) + 0.01 * jnp.mean(jnp.sum(torque**2, axis=1))


def with_gains(controller: GeometricPD, gains: Float[Array, "2"]) -> GeometricPD:
    return GeometricPD(controller.body, jnp.exp(gains[0]), jnp.exp(gains[1]))


def tune(controller: GeometricPD, iterations: int) -> tuple[GeometricPD, list[float]]:
    """The controller after some steps of Adam on the logarithms of its gains, and the costs."""
    optimiser = optax.adam(0.1)
    # Arrays that are not weakly typed: else `improve` would compile twice.
    gains = jnp.log(jnp.stack([controller.attitude_gain, controller.rate_gain])).astype(float)

    @eqx.filter_jit
    def improve(gains, state):
        value, gradient = jax.value_and_grad(cost)(gains, controller)
        updates, state = optimiser.update(gradient, state)
        return optax.apply_updates(gains, updates), state, value

    state, costs = optimiser.init(gains), []
    for _ in range(iterations):
        gains, state, value = improve(gains, state)
        costs.append(float(value))
    return with_gains(controller, jnp.asarray(gains)), costs


def plot(file: Path, before: Array, after: Array) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    t = 0.1 * np.arange(STEPS + 1)
    axis.semilogy(t, before, color="gray", label="first gains")
    axis.semilogy(t, after, color="crimson", label="tuned gains")
    axis.set(xlabel="time (s)", ylabel="angle to the set point (rad)", ylim=(1e-5, 2))
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    figure.savefig(file, dpi=150)
    print(f"picture: {file}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--iterations", type=int, default=60, help="steps of gradient descent")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw both responses")
    arguments = parser.parse_args()

    controller = GeometricPD(BODY, jnp.asarray(4.0), jnp.asarray(4.5))
    tuned, costs = tune(controller, arguments.iterations)
    before, after = (angles(simulate(which).R) for which in (controller, tuned))
    print(f"angle at the start: {before[0]:.2f} rad")
    print(f"first gains {controller.attitude_gain:.2f} and {controller.rate_gain:.2f}: "
          f"{before[-1]:.1e} rad after 8 s, cost {costs[0]:.4f}")  # fmt: skip
    print(f"tuned gains {tuned.attitude_gain:.2f} and {tuned.rate_gain:.2f}: "
          f"{after[-1]:.1e} rad after 8 s, cost {costs[-1]:.4f}")  # fmt: skip
    if arguments.plot:
        plot(arguments.plot, before, after)


if __name__ == "__main__":
    main()
