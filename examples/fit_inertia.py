"""Fit the inertia of a body to its attitudes by gradient through the simulator, with optax.

    python examples/fit_inertia.py [--data FILE.csv]      without a file: eight tosses, tosses.csv

Columns are `t,qw,qx,qy,qz` (seconds; unit quaternion, scalar first, body to space) and, for several
tosses, `trajectory`. Without torque attitudes tell the inertia up to a factor.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax

import lgvi
from lgvi.identification import Recordings

jax.config.update("jax_enable_x64", True)
TOSSES, TRUTH = Path(__file__).with_name("tosses.csv"), [0.20, 0.36, 0.44]  # parts of the trace
STEPS = 600
OPTIMISER: Any = optax.adam(optax.cosine_decay_schedule(0.15, STEPS), b1=0.95, b2=0.97)


def loss(unknowns, t, R, mask):
    """Mean square of the angles to the recorded attitudes, about each axis, mrad²."""
    body, turn, omega0 = unknowns
    R0 = R[:, 0] @ jax.vmap(lgvi.so3.cayley)(turn)  # the first is as noisy as any other
    simulate = jax.vmap(partial(lgvi.MoserVeselovIntegrator().simulate, body, substeps=6))
    squares = jnp.sum((simulate(R0, omega0=omega0, times=t).R - R) ** 2, axis=(2, 3))
    return 1e6 * jnp.mean(squares, where=mask) / 6  # a square is twice that of a small angle


@jax.jit
def fit(t, R, mask):
    """The moments, as parts of the trace, and the loss at the last step."""
    turn = jax.vmap(lgvi.so3.cayley_inverse)(R[:, 0].mT @ R[:, 1])  # half of it, if it is small
    start = lgvi.PhysicalRigidBody(jnp.zeros(6)), 0 * turn, 2 * turn / (t[:, 1:2] - t[:, :1])

    def improve(state, _) -> Any:
        unknowns, memory = state
        value, gradient = jax.value_and_grad(loss)(unknowns, t, R, mask)
        change, memory = OPTIMISER.update(gradient, memory)
        return (optax.apply_updates(unknowns, change), memory), value

    ((body, *_), _), values = jax.lax.scan(improve, (start, OPTIMISER.init(start)), length=STEPS)
    return jnp.linalg.eigvalsh(body.inertia / jnp.trace(body.inertia)), values[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, default=TOSSES, metavar="FILE.csv", help="attitudes")
    file = parser.parse_args().data
    try:
        tosses = Recordings.from_csv(file, attitude=("qw", "qx", "qy", "qz"), comment="#")
    except (OSError, ValueError) as problem:
        parser.exit(2, f"{problem}\n")
    print(f"{tosses}\ncompiling, then {STEPS} steps of the optimiser ...", flush=True)
    recorded = tosses.channels["attitude"]  # padded with the last sample of each toss
    moments, mean_square = fit(recorded.t, recorded.value, recorded.mask)
    print(f"residual for each axis: {mean_square**0.5:.3f} mrad")
    print("moments, as parts of the trace:", *(f"{moment:.5f}" for moment in moments))
    if file == TOSSES:
        print("true ones:                     ", *(f"{moment:.5f}" for moment in TRUTH))


if __name__ == "__main__":
    main()
