r"""Each window's residuals and their Jacobian, compressed to a small triangle.

Of the columns $[J_\phi, J_\theta, r]$, derivatives with respect to the window's initial state and
to the free leaves, and residuals, $QR$ leaves a triangle of 7 + p rows that knows all about the
least-squares problem.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..modules.integrator import MoserVeselovIntegrator
from ..modules.loss import AbstractLoss
from .model import Free, Model
from .residuals import InitialStates, Residuals, residuals
from .windows import Windows

LEAST_CURVATURE = 0.05  # of a robust loss along a residual, relative to that across it


class Factors(NamedTuple):
    """Of each window."""

    triangle: Array  # (windows, 7+p, 7+p)
    cost: Array  # (windows,), sum of the losses; infinite where a step did not converge
    residuals: Residuals  # (windows, readings, 3), whitened


@eqx.filter_jit
def factors(
    model: Model,
    free: Free,
    theta: Array,
    states: InitialStates,
    windows: Windows,
    integrator: MoserVeselovIntegrator,
    batch: int,
) -> Factors:
    """Linearise windows, `batch` of them at a time."""

    def of_window(given):
        state, window = given

        def weighted(z):
            at = free.model(model, z[6:])
            found, usable = residuals(at, state.moved(z[:6]), window, integrator)
            cost, rows, sides = jnp.zeros((), z.dtype), [], []
            for sensor, r in zip(at.sensors, found, strict=True):
                if sensor is not None and r is not None:
                    of_sensor, row, side = _weighted(sensor.loss, r)
                    cost += of_sensor
                    rows.append(row.ravel())
                    sides.append(side.ravel())
            cost = jnp.where(usable, cost, jnp.inf)
            return jnp.concatenate(rows), (jnp.concatenate(sides), found, cost)

        z = jnp.concatenate([jnp.zeros(6, theta.dtype), theta])
        jacobian, (side, found, cost) = jax.jacfwd(weighted, has_aux=True)(z)
        table = jnp.column_stack([jacobian, side])
        short = max(0, table.shape[1] - table.shape[0])
        triangle = jnp.linalg.qr(jnp.pad(table, ((0, short), (0, 0))), mode="r")
        return Factors(triangle, cost, found)

    if len(states.omega) <= batch:
        return jax.vmap(of_window)((states, windows))
    return jax.lax.map(of_window, (states, windows), batch_size=batch)


def _weighted(loss: AbstractLoss | None, r: Array) -> tuple[Array, Array, Array]:
    r"""The loss of residuals (readings, 3), rows whose derivative $A$ is, and the side $b$.

    $A^Tb$ is half the gradient of the loss, and $A^TA$ half its second derivative as far as that is
    positive: $\rho'$ across a residual and $\rho' + 2\rho''s$ along it.
    """
    if loss is None:
        return jnp.sum(r * r), r, r
    s = jnp.sum(r * r, axis=1)
    value = jnp.sum(loss(s))
    s, fixed = jax.lax.stop_gradient((s, r))
    weight, change = jax.jvp(loss.weight, (s,), (jnp.ones_like(s),))
    along = jnp.sqrt(jnp.maximum(1 + 2 * s * change / weight, LEAST_CURVATURE))
    unit = fixed / jnp.sqrt(jnp.where(s > 0, s, 1))[:, None]
    radial = jnp.sum(unit * r, axis=1)
    root = jnp.sqrt(weight)
    rows = root[:, None] * (r - ((1 - along) * radial)[:, None] * unit)
    return value, rows, jax.lax.stop_gradient((root / along)[:, None] * r)
