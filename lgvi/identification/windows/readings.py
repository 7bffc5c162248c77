"""Residuals of all readings, and what the sensors read without noise, without any derivative."""

from typing import Any, Literal

import jax
from jax.sharding import Mesh

from ...modules.integrator import MoserVeselovIntegrator
from ..compilation import compiled
from ..model.configuration import ModelAt
from ..model.free import put_leaves
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from .batching import map_batches
from .devices import count_devices, on_devices
from .grid import Windows
from .layout import Layout, OfReadings
from .residuals import Predictions, Residuals, compute_residuals

Which = Literal["residuals", "predicted"]


def simulate_readings_of(
    at: ModelAt,
    states: InitialStates,
    layout: Layout,
    integrator: MoserVeselovIntegrator,
    which: Which,
    mesh: Mesh | None,
) -> OfReadings:
    """Something of all readings of the windows of a layout, some windows at a time."""
    point = at.model, at.selected, at.leaves.astype(states.omega.dtype), at.own
    found, devices = [], count_devices(mesh)
    for group in layout.groups:

        def of_batch(some, group=group):
            given = states.at(group.index[some]), group.windows(some), integrator, which, mesh
            return _read(*point, *given, few=layout.few)

        batch = -(-group.count_at_once() // devices)  # on each device
        found.append(map_batches(of_batch, len(group), batch * devices))
    return layout.in_order(found, tuple(at.model.sensors))


@compiled("readings")
def _read(
    model: Model,
    selected: Any,
    leaves: Numbers,
    own: Any,
    states: InitialStates,
    windows: Windows,
    integrator: MoserVeselovIntegrator,
    which: Which,
    mesh: Mesh | None,
) -> Residuals | Predictions:
    def of_window(state, window):
        at = put_leaves(model, selected, leaves)
        residuals, motion = compute_residuals(at, own, state, window, integrator)
        return residuals if which == "residuals" else motion.predicted

    return on_devices(jax.vmap(of_window), (0, 0), mesh)(states, windows)
