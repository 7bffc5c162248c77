r"""Each window's residuals and their Jacobian, compressed to a small triangle.

The columns $[J_\phi, J_\theta, r]$ are the derivatives of the residuals with respect to the initial
state of the window and to the selected leaves, and the residuals. Their $QR$ leaves a triangle of
1 + m + p rows with the same least-squares problem. A window can be made of blocks of time, each of
which is compressed first: what is left of each tells how far the noise of different times is
independent.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array

from ...modules.integrator import MoserVeselovIntegrator
from ...modules.loss import AbstractLoss
from ...modules.sensors.base import loss_of
from ..compilation import compiled
from ..model.free import put_leaves
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from ..windows.devices import on_devices, triangularise
from ..windows.grid import Windows
from ..windows.residuals import Predictions, Residuals, compute_residuals

LEAST_CURVATURE = 0.05  # of a robust loss along a residual, over the curvature across it


class WindowFactors(NamedTuple):
    """The least-squares problem of each window."""

    triangle: Numbers  # (windows, 1+m+p, 1+m+p), of m own unknowns
    # (windows, blocks, rows, 1+m+p), what the triangle is made of; None for one block.
    blocks: Numbers | None
    cost: Numbers  # (windows,), sum of the losses; infinite if a step did not converge
    residuals: Residuals  # (windows, readings, m), whitened, by channel
    predicted: Predictions  # (windows, readings, ...), by channel
    spread: Numbers  # (windows, 3), sums from which `variance_factor` follows
    gap: Numbers | None  # (windows, m, 1+2m+p), as in `BlockArrow`, but not whitened

    def without_readings(self) -> "WindowFactors":
        """Without residuals and predictions, of which there may be many."""
        return self._replace(residuals={}, predicted={})


@compiled("residuals and their derivative")
def factorise(
    model: Model,
    selected: Any,
    leaves: Numbers,
    own: Any,
    states: InitialStates,
    windows: Windows,
    following: InitialStates,
    joined: Numbers | None,
    integrator: MoserVeselovIntegrator,
    least_curvature: Numbers,
    blocks: int,
    mesh: Mesh | None = None,
) -> WindowFactors:
    """Linearise windows; where `joined`, the next window begins with the `following` state.

    The selected leaves of the model are (p,), or (windows, p) if each window has its own. Each
    window is made of so many blocks of time, with as many readings of each channel. Leaves of the
    model that are the window's `own` are in the states.

    The curvature of a robust loss along a residual is at least `least_curvature` times the
    curvature across the residual. Each device of a mesh has as many of the windows.
    """

    m = states.unknowns

    def of_window(leaves, state, following, joined, window):
        def weighted(z):
            moved = state.moved(z[:m])
            at = put_leaves(model, selected, z[m:])
            found, motion = compute_residuals(at, own, moved, window, integrator)
            cost, spread, rows, sides = jnp.zeros((), z.dtype), jnp.zeros(3, z.dtype), [], []
            for channel, sensor in at.sensors.items():
                r, loss = found[channel], loss_of(sensor)
                spread += _spread(loss, r, window.readings[channel].mask)
                of_sensor, row, side = _weighted(loss, r, least_curvature)
                cost += of_sensor
                rows.append(row.ravel())
                sides.append(side.ravel())
            cost = jnp.where(motion.usable, cost, jnp.inf)
            gap = None if joined is None else motion.end.gap(following)
            aux = jnp.concatenate(sides), (found, motion.predicted), spread, cost, motion.end
            return (jnp.concatenate(rows), gap), aux

        still = jnp.zeros(m, leaves.dtype)
        z = jnp.concatenate([still, leaves])
        (jacobian, of_gap), aux = jax.jacfwd(weighted, has_aux=True)(z)
        side, (found, predicted), spread, cost, end = aux
        table = jnp.column_stack([jacobian, side])
        if blocks > 1:
            residuals = [(channel, found[channel]) for channel in model.sensors]
            table = _in_blocks(table, residuals, window, blocks)
        gap = None
        if joined is not None:
            of_following = jax.jacfwd(lambda phi: end.gap(following.moved(phi)))(still)
            gap = jnp.column_stack([of_following, of_gap, end.gap(following)])
            gap = jnp.where(joined, gap, 0)
        return WindowFactors(table, None, cost, found, predicted, spread, gap)

    axes = None if leaves.ndim == 1 else 0, 0, 0, None if joined is None else 0, 0

    def of_windows(*given):
        found = jax.vmap(of_window, axes)(*given)
        table, of_blocks = found.triangle, None
        if blocks > 1:
            count, *shape = table.shape[0], *table.shape[2:]
            of_blocks = triangularise(table.reshape(-1, *shape), mesh)
            of_blocks = of_blocks.reshape(count, blocks, *of_blocks.shape[1:])
            table = of_blocks.reshape(count, -1, of_blocks.shape[-1])
        short = max(0, table.shape[2] - table.shape[1])
        triangle = triangularise(jnp.pad(table, ((0, 0), (0, short), (0, 0))), mesh)
        return found._replace(triangle=triangle, blocks=of_blocks)

    return on_devices(of_windows, axes, mesh)(leaves, states, following, joined, windows)


def _in_blocks(
    table: Array, residuals: Sequence[tuple[str, Array]], window: Windows, blocks: int
) -> Array:
    """The rows of a table (rows, columns) as blocks of time (blocks, rows, columns).

    `residuals` (readings, m) are those of each channel, in the order of the rows.
    """
    parts, first = [], 0
    for channel, r in residuals:
        if not len(r):
            continue
        rows = table[first : first + r.size].reshape(*r.shape, -1)
        first += r.size
        ends = jnp.arange(blocks + 1) * jnp.sum(window.readings[channel].mask) // blocks
        index = ends[:-1, None] + jnp.arange(-(-len(r) // blocks))[None]
        rows = jnp.where((index < ends[1:, None])[..., None, None], rows[index], 0)
        parts.append(rows.reshape(blocks, -1, rows.shape[-1]))
    return jnp.concatenate(parts, axis=1)


def _spread(loss: AbstractLoss | None, r: Array, mask: Numbers) -> Array:
    """Sums of the squares of psi = rho' r, of its slopes, and of the slopes in the problem."""
    s = jnp.sum(r * r, axis=1)
    if loss is None:
        w, change = jnp.ones_like(s), jnp.zeros_like(s)
    else:
        w, change = jax.jvp(loss.weight, (s,), (jnp.ones_like(s),))
    across = (r.shape[1] - 1) * w
    along = w + 2 * change * s
    in_problem = across + jnp.maximum(along, LEAST_CURVATURE * w)
    each = jnp.stack([w * w * s, across + along, in_problem])
    return jax.lax.stop_gradient(jnp.sum(jnp.where(mask[None], each, 0), axis=1))


def _weighted(
    loss: AbstractLoss | None, r: Array, least_curvature: Numbers
) -> tuple[Array, Array, Array]:
    r"""The loss of residuals (readings, m), the rows with the derivative $A$, and the side $b$.

    $A^Tb$ is half the gradient of the loss, and $A^TA$ half its second derivative:
    $\rho'$ across a residual, and $\rho' + 2\rho''s$, or the least curvature, along the residual.
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
