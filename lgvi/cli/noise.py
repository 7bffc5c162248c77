"""The noise of sensors, from how their readings scatter."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..logs.contents import white_noise

if TYPE_CHECKING:
    from ..identification import Recordings


def measure_noise(recordings: "Recordings") -> dict[str, float]:
    """The standard deviation of white noise of each sensor whose readings tell it, in its unit."""
    measured = {}
    for channel, samples in recordings.channels.items():
        noise = [
            white_noise(column)
            for _, values in samples
            if len(values) > 1
            for column in _columns(channel, values)
        ]
        typical = np.median(noise) if noise else np.nan
        if np.isfinite(typical) and typical > 0:
            measured[channel] = float(f"{typical:.3g}")
    return measured


def _columns(
    channel: str, values: Float[np.ndarray, "samples *shape"]
) -> Float[np.ndarray, "columns samples"]:
    """Numbers that have the noise of the readings: of attitudes sums of small turns."""
    if channel != "attitude":
        return values.reshape(len(values), -1).T
    from scipy.spatial.transform import Rotation

    attitudes = Rotation.from_matrix(values)
    return np.cumsum((attitudes[:-1].inv() * attitudes[1:]).as_rotvec(), axis=0).T
