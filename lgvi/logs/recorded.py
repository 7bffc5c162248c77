"""Recordings as logs, and logs that were written before."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..modules.units import standard_spelling
from .log import Log
from .quantities import UNITS_OF_QUANTITIES
from .signal import Signal

if TYPE_CHECKING:
    from ..identification import Recordings

AXES = "x", "y", "z"
COLUMN = re.compile(r"(?P<signal>.+)\.(?P<component>\w+)(?: \((?P<unit>[^()]*)\))?")


def join_components(log: Log) -> Log:
    """A log as it was before it was written: columns `gyro.x`, `gyro.y`, `gyro.z` are one signal.

    If the name is that of a quantity, such as `angular_velocity.x (rad/s)`, it is the quantity.
    """
    signals, columns = dict(log.signals), {}
    for name, signal in log.signals.items():
        match = COLUMN.fullmatch(name)
        if match and signal.values.ndim == 1:
            columns.setdefault(match["signal"], {})[match["component"]] = signal, match["unit"]
    for name, parts in columns.items():
        components = sorted(parts, key=lambda name: (name != "w", name))
        scalars = [parts[component][0] for component in components]
        units = {standard_spelling(scalar.unit or unit or "") for scalar, unit in parts.values()}
        first = scalars[0]
        alike = all(np.array_equal(scalar.times, first.times) for scalar in scalars)
        is_quantity = name in UNITS_OF_QUANTITIES
        is_vector = components in ([*AXES], ["w", *AXES])
        if len(units) > 1 or not alike or name in signals or not (is_quantity or is_vector):
            continue
        values = np.column_stack([scalar.values for scalar in scalars])
        present = np.isfinite(values).any(1)
        for scalar in scalars:
            del signals[scalar.name]
        signals[name] = replace(
            first,
            name=name,
            times=first.times[present],
            values=values[present],
            unit=units.pop(),
            quantity=name if is_quantity else "",
            components=tuple(components),
            order="wxyz" if components == ["w", *AXES] and name == "attitude" else "",
        )
    return replace(log, signals=signals) if columns else log


def from_recordings(recordings: "Recordings") -> tuple[Log, ...]:
    """A log of each trajectory, with attitudes as quaternions; signals have the names of channels.

    Parameters
    ----------
    recordings
        The recordings.

    Returns
    -------
    tuple of Log
        The logs, whose signals have units and quantities.
    """
    from scipy.spatial.transform import Rotation

    logs = []
    for name, trajectory in zip(recordings.names, recordings, strict=True):
        signals = {}
        for quantity, (t, values) in trajectory.items():
            unit = UNITS_OF_QUANTITIES.get(quantity, "")
            if quantity == "rotor_momentum" and values.shape[1] == 3:
                unit = ""  # a momentum, or a speed: only the model tells
            described: dict[str, Any] = {"quantity": quantity, "unit": unit}
            if quantity == "attitude":
                values = Rotation.from_matrix(values).as_quat(scalar_first=True)
                described |= {"unit": "1", "order": "wxyz", "direction": "body to space"}
            count = values.shape[1]
            components = {3: AXES, 4: ("w", *AXES)}.get(count, tuple(map(str, range(count))))
            signals[quantity] = Signal(quantity, t, values, components=components, **described)
        logs.append(Log(name, "recordings", signals))
    return tuple(logs)
