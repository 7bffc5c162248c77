"""Detumbling with wheels: three reaction wheels take up the momentum of a spacecraft.

    python examples/detumble.py [--plot detumble.png]

No torque acts from outside, so that the total momentum in space stays what it was: it goes from the
body into the wheels, as far as their motors allow.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

jax.config.update("jax_enable_x64", True)

INERTIA = lgvi.inertia_from_principal_moments(
    jnp.array([8.0, 10.0, 12.0]), lgvi.so3.exp(jnp.array([0.2, 0.1, -0.3]))
)  # kg m²
RATES = jnp.array([0.06, -0.04, 0.08])  # rad/s
GAIN, MOST = 0.8, 0.02  # N m s; N m of each motor
DT = 0.5  # s
INTEGRATOR = lgvi.MoserVeselovIntegrator(DT)


def step(state, _):
    """The motors brake the body; their torque changes the momentum of the wheels."""
    R, pi, wheels = state
    omega = lgvi.Gyrostat(INERTIA, wheels).angular_velocity(pi)
    torque = jnp.clip(GAIN * omega, -MOST, MOST)  # on the wheels, N m
    middle = lgvi.Gyrostat(INERTIA, wheels + DT / 2 * torque)
    R_next, pi_next, _ = INTEGRATOR.step(middle, R, pi)
    states = omega, wheels, lgvi.spatial_momentum(R, pi)
    return (R_next, pi_next, wheels + DT * torque), states


@jax.jit
def detumble():
    """Rates, momenta of the wheels, and momenta in space."""
    return jax.lax.scan(step, (jnp.eye(3), INERTIA @ RATES, jnp.zeros(3)), length=401)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--plot", metavar="FILE", help="draw rates and wheels")
    file = parser.parse_args().plot
    print("compiling ...", flush=True)
    omega, wheels, momentum = map(np.asarray, detumble())
    before, after, of_wheels, of_all = (
        np.linalg.norm(vector) for vector in (omega[0], omega[-1], wheels[-1], momentum[0])
    )
    change, t = np.max(abs(momentum - momentum[0])) / of_all, DT * np.arange(len(omega))
    print(f"rates: {before:.3f} rad/s at the start, {after:.1e} after {t[-1]:.0f} s")
    print(f"wheels: {of_wheels:.3f} kg m²/s at the end, of {of_all:.3f} in all")
    print(f"the total momentum in space changes by {change:.0e} of it")
    if file:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
        labels = ("rates of the body (rad/s)", "momentum of the wheels (kg m²/s)")
        for axis, values, label in zip(axes, (omega, wheels), labels, strict=True):
            lines = axis.plot(t, values)
            axis.set(xlabel="time (s)", ylabel=label)
            axis.legend(lines, ["x", "y", "z"], frameon=False)
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main()
