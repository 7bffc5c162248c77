"""Feedback: which gains of an attitude controller settle a body best?

    python examples/stabilise.py
    python examples/stabilise.py --plot stabilise.png

A geometric PD law turns a body by 0.8 rad to its set point, as flight software would: it is
evaluated ten times a second, and its torque is held in between. The gains are then improved by
gradient descent through the simulation.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

import lgvi

jax.config.update("jax_enable_x64", True)

BODY = lgvi.RigidBody.from_principal_moments([1.0, 2.0, 2.5])
INTEGRATOR = lgvi.MoserVeselovIntegrator(dt=0.1)
STEPS = 80
R0 = lgvi.so3.exp(0.8 * jnp.array([2.0, -1.0, 2.0]) / 3)
FIRST_GAINS = jnp.array([4.0, 4.5])  # k_R, N m, and k_omega, N m s


class GeometricPD(eqx.Module):
    """The torque -k_R e_R - k_omega omega with e_R = vee(R - R^T)/2.

    T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC
    2010, doi:10.1109/CDC.2010.5717652.
    """

    body: lgvi.RigidBody
    gains: Float[Array, "2"]  # k_R and k_omega

    def __call__(self, t: Array, R: Array, pi: Array) -> Array:
        error = lgvi.so3.vee((R - R.T) / 2)
        return -self.gains[0] * error - self.gains[1] * self.body.angular_velocity(pi)


def simulate(gains: Float[Array, "2"]) -> lgvi.Trajectory:
    controller = GeometricPD(BODY, gains)
    return INTEGRATOR.simulate(BODY, R0, jnp.zeros(3), steps=STEPS, controller=controller)


def angles(R: Float[Array, "states 3 3"]) -> Float[Array, " states"]:
    """Angles to the set point, rad."""
    return jnp.linalg.norm(jax.vmap(lgvi.so3.log)(R), axis=1)


def cost(log_gains: Float[Array, "2"]) -> Float[Array, ""]:
    """Mean square of the sine of the angle, plus a hundredth of the mean square of the torque."""
    gains = jnp.exp(log_gains)
    R, pi, _ = simulate(gains)
    torque = jax.vmap(GeometricPD(BODY, gains), in_axes=(None, 0, 0))(jnp.zeros(()), R, pi)
    sines = jax.vmap(lambda R: lgvi.so3.vee((R - R.T) / 2))(R)
    return jnp.mean(jnp.sum(sines**2, axis=1)) + 0.01 * jnp.mean(jnp.sum(torque**2, axis=1))


def tune(gains: Float[Array, "2"], iterations: int) -> Float[Array, "2"]:
    """The gains after some steps of Adam on their logarithms."""
    optimiser = optax.adam(0.1)

    @jax.jit
    def improve(log_gains, memory):
        updates, memory = optimiser.update(jax.grad(cost)(log_gains), memory)
        return optax.apply_updates(log_gains, updates), memory

    log_gains = jnp.log(gains)
    memory = optimiser.init(log_gains)
    for _ in range(iterations):
        log_gains, memory = improve(log_gains, memory)
    return jnp.exp(log_gains)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--iterations", type=int, default=60, help="steps of Adam (60)")
    parser.add_argument("--plot", metavar="FILE", help="draw both responses")
    given = parser.parse_args()

    responses = {}
    tuned = tune(FIRST_GAINS, given.iterations)
    for name, gains in (("first", FIRST_GAINS), ("tuned", tuned)):
        responses[name] = angles(simulate(gains).R)
        print(f"{name} gains {gains[0]:.2f} and {gains[1]:.2f}: {responses[name][-1]:.1e} rad "
              f"after 8 s, cost {cost(jnp.log(gains)):.4f}")  # fmt: skip
    if given.plot:
        draw(given.plot, responses)


def draw(file: str, responses: dict[str, Array]) -> None:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    for name, angle in responses.items():
        axis.semilogy(0.1 * np.arange(STEPS + 1), angle, label=f"{name} gains")
    axis.set(xlabel="time (s)", ylabel="angle to the set point (rad)", ylim=(1e-5, 2))
    axis.legend(frameon=False)
    figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
