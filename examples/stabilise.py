"""Feedback: which gains of an attitude controller settle a body best?

    python examples/stabilise.py [--plot stabilise.png]

A geometric PD law turns a body by 0.8 rad to its set point, as flight software would: it is
evaluated ten times a second, and its torque is held in between. The gains are then improved by
gradient descent through the simulation.
"""

import argparse
from functools import partial

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
FIRST_GAINS = np.array([4.0, 4.5])  # k_R, N m, and k_omega, N m s
OPTIMISER = optax.adam(0.1)


class GeometricPD(eqx.Module):
    """The torque -k_R e_R - k_omega omega with e_R = vee(R - R^T)/2.

    T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a quadrotor UAV on SE(3)", CDC
    2010, doi:10.1109/CDC.2010.5717652.
    """

    gains: Float[Array, "2"]  # k_R and k_omega

    def __call__(self, t: Array, R: Array, pi: Array) -> Array:
        return -self.gains[0] * error(R) - self.gains[1] * BODY.angular_velocity(pi)


def error(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """As long as the sine of the angle to the set point."""
    return lgvi.so3.vee((R - R.T) / 2)


def cost(log_gains: Float[Array, "2"]):
    """Mean square of the sine of the angle, plus a hundredth of the mean square of the torque.

    Also the angles to the set point, rad.
    """
    controller, rest = GeometricPD(jnp.exp(log_gains)), jnp.zeros(3)
    motion = INTEGRATOR.simulate(BODY, R0, omega0=rest, steps=STEPS, controller=controller)
    errors, torques = jax.vmap(error)(motion.R), jax.vmap(controller)(motion.t, motion.R, motion.pi)
    value = jnp.mean(jnp.sum(errors**2, axis=1)) + 0.01 * jnp.mean(jnp.sum(torques**2, axis=1))
    return value, jax.vmap(lgvi.so3.distance, (0, None))(motion.R, jnp.eye(3))


@partial(jax.jit, static_argnums=0)
def tune(iterations: int):
    """Gains, costs and angles before each step of Adam on the logarithms of the gains."""

    def improve(state, _):
        log_gains, memory = state
        results, gradient = jax.value_and_grad(cost, has_aux=True)(log_gains)
        change, memory = OPTIMISER.update(gradient, memory)
        return (log_gains + change, memory), (jnp.exp(log_gains), *results)

    log_gains = jnp.log(FIRST_GAINS)
    return jax.lax.scan(improve, (log_gains, OPTIMISER.init(log_gains)), length=iterations + 1)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--iterations", type=int, default=60, help="steps of Adam (60)")
    parser.add_argument("--plot", metavar="FILE", help="draw both responses")
    arguments = parser.parse_args()
    print("compiling ...", flush=True)
    gains, costs, angles = map(np.asarray, tune(arguments.iterations))
    for name, k in (("first", 0), ("tuned", -1)):
        print(f"{name} gains {gains[k, 0]:.2f} and {gains[k, 1]:.2f}: {angles[k, -1]:.1e} rad "
              f"after 8 s, cost {costs[k]:.4f}")  # fmt: skip
    if arguments.plot:
        import matplotlib.pyplot as plt

        figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
        axis.semilogy(0.1 * np.arange(STEPS + 1), angles[[0, -1]].T)
        axis.set(xlabel="time (s)", ylabel="angle to the set point (rad)", ylim=(1e-5, 2))
        axis.legend(["first gains", "tuned gains"], frameon=False)
        figure.savefig(arguments.plot, dpi=150)


if __name__ == "__main__":
    main()
