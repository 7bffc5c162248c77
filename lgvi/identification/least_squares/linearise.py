"""The least-squares problem about a point, and the integrator that it is made with."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ...modules.integrator import MoserVeselovIntegrator
from ..data.recordings import Recordings
from ..model.free import Free
from ..model.model import Model
from ..model.states import InitialStates
from ..windows.batching import batch_size, map_batches
from ..windows.grid import Windows
from ..windows.layout import Layout
from .block_arrow import OWN, BlockArrow
from .window_qr import LEAST_CURVATURE, WindowFactors, factorise


class Linearised(NamedTuple):
    """The problem about a point."""

    system: BlockArrow
    cost: float  # infinite where the residuals or their derivatives are not finite
    gap_cost: float  # the part of the cost from the gaps between segments
    factors: WindowFactors  # of all windows in their order, without residuals and predictions
    layout: Layout
    parts: list[WindowFactors]  # of each part of the layout

    def residuals(self) -> dict[str, np.ndarray]:
        """Whitened residuals of each channel (readings, m), in the order of the windows."""
        return self._of_readings([part.residuals for part in self.parts])

    def predicted(self) -> dict[str, np.ndarray]:
        """What each sensor reads without noise (readings, ...), in the order of the windows."""
        return self._of_readings([part.predicted for part in self.parts])

    def _of_readings(self, padded: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
        """Remove the padding."""
        found = {}
        for channel in padded[0]:
            masks = [windows.readings[channel].mask for _, windows in self.layout.parts]
            count = np.zeros(self.layout.number, int)
            for (index, _), mask in zip(self.layout.parts, masks, strict=True):
                count[index] = mask.sum(1)
            first = np.cumsum(count) - count
            values = [np.asarray(part[channel]) for part in padded]
            found[channel] = np.zeros((count.sum(), *values[0].shape[2:]))
            for (index, _), mask, value in zip(self.layout.parts, masks, values, strict=True):
                place = first[index, None] + np.arange(mask.shape[1])
                found[channel][place[mask]] = value[mask]
        return found


def linearise(
    model: Model,
    free: Free,
    theta: np.ndarray,
    states: InitialStates,
    layout: Layout,
    integrator: MoserVeselovIntegrator,
    width: np.ndarray | None = None,
    caution: float = 0.0,
    blocks: int = 1,
) -> Linearised:
    """Residuals and derivatives of all windows, as many at a time as the cache is for.

    Gaps between segments are whitened by a `width` (6,). With a `caution` of 1 a robust loss is
    replaced by a parabola that lies above it; with less by a parabola that is nearer to the loss
    and may cross it. Each window is made of so many `blocks` of time.
    """
    dtype = states.omega.dtype
    curvature, at = np.asarray(max(caution, LEAST_CURVATURE), dtype), theta.astype(dtype)

    def of_batch(given):
        states, windows, following, joined = given
        given = model, free, at, states, windows, following, joined, integrator, curvature, blocks
        return factorise(*given, few=layout.few)

    following, joined = states.at(np.roll(np.arange(layout.number), -1)), layout.joined
    parts = []
    for index, windows in layout.parts:
        some = None if joined is None else joined[index]
        given = states.at(index), windows, following.at(index), some
        count, steps = windows.dt.shape
        batch = batch_size(count, steps, OWN + len(theta))
        parts.append(map_batches(of_batch, given, len(index), batch))
    found = _together(layout, parts)
    cost, gap_cost = float(np.sum(found.cost)), 0.0
    system = BlockArrow(np.asarray(found.triangle), sizes=np.maximum(1, abs(theta)))
    if found.gap is not None and width is not None:
        gaps = np.asarray(found.gap, float) / width[:, None]
        gap_cost = float(np.sum(gaps[:, :, -1] ** 2))
        system = system._replace(gaps=gaps, position=layout.position)
    if system.finite:
        system = system.without(unobservable_scale_direction(model, free, layout.parts[0][1]))
    else:
        cost = np.inf
    return Linearised(system, cost + gap_cost, gap_cost, found, layout, parts)


def _together(layout: Layout, parts: list[WindowFactors]) -> WindowFactors:
    """The factors of all windows in their order, without residuals and predictions."""
    order = np.argsort(np.concatenate([index for index, _ in layout.parts]))

    def in_order(*arrays: np.ndarray) -> np.ndarray:
        return np.concatenate(arrays)[order]

    return jax.tree.map(in_order, *(part._replace(residuals={}, predicted={}) for part in parts))


def unobservable_scale_direction(
    model: Model, free: Free, given: Recordings | Windows
) -> np.ndarray:
    """The direction (p,) that scales the inertia, if no torque and no rotor acts; or zero.

    Without them no motion depends on the scale. Zero also where the inertia is not free, or the
    body is of a class whose coordinates are not known.
    """
    acting = model.torque, given.body_torque, given.rotor_momentum
    return free.scale_direction * all(each is None for each in acting)
