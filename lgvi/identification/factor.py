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
from .batches import over_windows
from .model import Free, Model
from .residuals import InitialStates, Residuals, residuals
from .windows import Windows


class Factors(NamedTuple):
    """Of each window."""

    triangle: Array  # (windows, 7+p, 7+p)
    cost: Array  # (windows,), sum of the losses; infinite where a step did not converge
    residuals: Residuals  # (windows, readings, 3), whitened
    gap: Array | None  # (windows, 6, 13+p), as in `Rows` but not whitened


@eqx.filter_jit
def factors(
    model: Model,
    free: Free,
    theta: Array,
    states: InitialStates,
    windows: Windows,
    integrator: MoserVeselovIntegrator,
    batch: int,
    least_curvature: Array,
) -> Factors:
    """Linearise windows, `batch` of them at a time.

    A robust loss has at least that curvature along a residual, relative to that across it.
    """

    def of_window(given):
        state, following, joined, window = given

        def weighted(z):
            at = free.model(model, z[6:])
            found, motion = residuals(at, state.moved(z[:6]), window, integrator)
            cost, rows, sides = jnp.zeros((), z.dtype), [], []
            for sensor, r in zip(at.sensors, found, strict=True):
                if sensor is not None and r is not None:
                    of_sensor, row, side = _weighted(sensor.loss, r, least_curvature)
                    cost += of_sensor
                    rows.append(row.ravel())
                    sides.append(side.ravel())
            cost = jnp.where(motion.usable, cost, jnp.inf)
            gap = None if joined is None else motion.end.gap(following)
            aux = jnp.concatenate(sides), found, cost, motion.end
            return (jnp.concatenate(rows), gap), aux

        still = jnp.zeros(6, theta.dtype)
        z = jnp.concatenate([still, theta])
        (jacobian, of_gap), (side, found, cost, end) = jax.jacfwd(weighted, has_aux=True)(z)
        table = jnp.column_stack([jacobian, side])
        short = max(0, table.shape[1] - table.shape[0])
        triangle = jnp.linalg.qr(jnp.pad(table, ((0, short), (0, 0))), mode="r")
        gap = None
        if joined is not None:
            of_following = jax.jacfwd(lambda phi: end.gap(following.moved(phi)))(still)
            gap = jnp.column_stack([of_following, of_gap, end.gap(following)])
            gap = jnp.where(joined, gap, 0)
        return Factors(triangle, cost, found, gap)

    following = jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), states)
    given = states, following, windows.joined, windows
    return over_windows(of_window, given, len(states.omega), batch)


def _weighted(
    loss: AbstractLoss | None, r: Array, least_curvature: Array
) -> tuple[Array, Array, Array]:
    r"""The loss of residuals (readings, 3), rows whose derivative $A$ is, and the side $b$.

    $A^Tb$ is half the gradient of the loss, and $A^TA$ half its second derivative as far as that is
    enough: $\rho'$ across a residual and $\rho' + 2\rho''s$ along it.
    """
    if loss is None:
        return jnp.sum(r * r), r, r
    s = jnp.sum(r * r, axis=1)
    value = jnp.sum(loss(s))
    s, fixed = jax.lax.stop_gradient((s, r))
    weight, change = jax.jvp(loss.weight, (s,), (jnp.ones_like(s),))
    along = jnp.sqrt(jnp.maximum(1 + 2 * s * change / weight, least_curvature))
    unit = fixed / jnp.sqrt(jnp.where(s > 0, s, 1))[:, None]
    radial = jnp.sum(unit * r, axis=1)
    root = jnp.sqrt(weight)
    rows = root[:, None] * (r - ((1 - along) * radial)[:, None] * unit)
    return value, rows, jax.lax.stop_gradient((root / along)[:, None] * r)
