"""From settings to the lines of a script: read logs, cut them, and make a model."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import lgvi

from ..logs import Log, LogError
from ..logs.conversion import INPUTS
from ..logs.signal import list_names
from .script import Script, call, require_name, say
from .settings import ONLY, WAYS, Settings, SettingsError

# By quantity: the class, and arguments from which a fit may start.
SENSORS = {
    "attitude": ("AttitudeSensor", {}),
    "angular_velocity": ("Gyroscope", {}),
    "specific_force": ("Accelerometer", {"position": [0.0, 0.0, 0.0]}),
    "magnetic_field": ("Magnetometer", {}),
    "direction": ("DirectionSensor", {}),
    "position": ("PositionSensor", {"offset": [0.0, 0.0, 0.0]}),
}
NEEDED = {"magnetic_field": "field", "direction": "direction", "position": "gravity"}
# Where neither a user nor readings tell the noise, the first fit has these.
FIRST_SIGMA = {
    "attitude": 1e-3,
    "angular_velocity": 1e-2,
    "specific_force": 0.1,
    "magnetic_field": 1e-6,
    "direction": 1e-2,
    "position": 1e-3,
}
OF_SENSORS = "bias", "scale", "alignment", "time_offset", "position", "offset"
OF_NOTHING = "time_offset", "drag"  # leaves that a sensor does not have unless they are given
TO_SECOND = "alignment", "time_offset"  # known only against another sensor
LAWS = {
    "damping": "lgvi.LinearDamping(np.zeros((3, 3)))",
    "drag": "lgvi.QuadraticDamping(np.zeros(3))",
}
OF_MODEL = "rotor_inertia", "time_scale", "rotor_delay", "mass"
AXES = {"x": [1.0, 0.0, 0.0], "y": [0.0, 1.0, 0.0], "z": [0.0, 0.0, 1.0]}


def read_logs(script: Script, settings: Settings) -> list[tuple[Log, Any]]:
    """Lines that read the logs and make `recordings` of them; logs with the intervals taken."""
    parts, taken = [], []
    for path in settings.logs:
        name = "recordings" if len(settings.logs) == 1 else f"part_{len(parts)}"
        with say(f"reading {path}"):
            if settings.trajectory is None:
                taken += _add_log(script, settings, path, name)
            else:
                _add_trajectories(script, settings, path, name)
        parts.append(name)
    if len(parts) > 1:
        script.add(f"recordings = identification.Recordings.concatenate([{', '.join(parts)}])")
    for channel, samples in script["recordings"].channels.items():
        if len(samples.values) and not np.ptp(samples.values, axis=0).any():
            raise LogError(
                settings.logs[0],
                "must change in the log, but is constant: the sensor may be off",
                f"signal of {channel.replace('_', ' ')}",
            )
    return taken


def _add_log(script: Script, settings: Settings, path: str, name: str) -> list[tuple[Log, Any]]:
    """Lines that read a log, with the name of its recordings; the log if intervals are taken."""
    script.add(call("log = lgvi.logs.read", repr(path), reader=settings.reader, **settings.read))
    signals = choose_signals(script["log"], settings)
    units = _units(settings, list(signals))
    has_intervals = _add_intervals(script, settings, signals, units)
    intervals = ["intervals=intervals"] if has_intervals else []
    arguments = {
        "units": units or None,
        "frame": settings.frame,
        "space": settings.space,
        "attitude_order": settings.attitude_order,
        "attitude_direction": settings.attitude_direction,
        "duplicates": settings.duplicates,
        **signals,
    }
    script.add(call(f"{name} = log.recordings", *intervals, **arguments))
    return [(script["log"], script["intervals"])] if has_intervals else []


def _add_trajectories(script: Script, settings: Settings, path: str, name: str) -> None:
    """The line that reads a CSV file in which a column names the trajectories."""
    options = {
        "reader": settings.reader,
        "frame": settings.frame,
        "space": settings.space,
        "flights": settings.flights,
        "from": settings.begin,
        "to": settings.end,
    }
    for option, value in options.items():
        if value is not None:
            raise SettingsError(f"--trajectory and --{option} must not be there together")
    if not settings.map:
        raise SettingsError(
            "--trajectory needs --map, such as --map angular_velocity=gx,gy,gz, which names the "
            "columns of the file"
        )
    columns: dict[str, Any] = dict(settings.map)
    if settings.rotor is not None:
        columns["rotor_momentum"] = settings.rotor
    arguments = {
        "trajectory": settings.trajectory,
        "units": _units(settings, list(columns)) or None,
        "attitude_order": settings.attitude_order,
        "attitude_direction": settings.attitude_direction,
        "duplicates": settings.duplicates,
    }
    read = f"{name} = identification.Recordings.from_csv"
    script.add(call(read, repr(path), **{**arguments, **settings.read, **columns}))


def choose_signals(log: Log, settings: Settings) -> dict[str, str | list[str]]:
    """The signals of each quantity: those of the settings, or what the format tells."""
    signals: dict[str, str | list[str]] = {
        quantity: names[0] if len(names) == 1 else list(names)
        for quantity, names in settings.map.items()
    }
    if settings.rotor is not None:
        signals["rotor_momentum"] = settings.rotor
    declared = _declared(log)
    if settings.rotors and "rotor_speed" not in signals:
        if "rotor_speed" not in declared:
            raise LogError(
                log.path,
                "must have the speeds of the rotors, but the file does not tell which they are: "
                "say so by --map, such as --map rotor_speed=m0,m1,m2,m3, or leave out `rotors`; "
                f"there are {list_names(log.names())}",
            )
        signals["rotor_speed"] = declared["rotor_speed"]
    if not {"angular_velocity", "attitude"} & set(signals):
        chosen = next((q for q in ("angular_velocity", "attitude") if q in declared), None)
        if chosen is not None:
            signals = {chosen: declared[chosen], **signals}
        elif not set(SENSORS) & set(signals):
            raise LogError(
                log.path,
                "must have a signal of rates or attitudes, but the file does not tell which it is: "
                "say so by --map, such as --map angular_velocity=gx,gy,gz; there are "
                f"{list_names(log.names())}",
            )
    return signals


def _declared(log: Log) -> dict[str, str]:
    """The first signal of each quantity that the format tells."""
    declared: dict[str, str] = {}
    for name, signal in log.signals.items():
        if signal.quantity and len(signal):
            declared.setdefault(signal.quantity, name)
    return declared


def _units(settings: Settings, quantities: Sequence[str]) -> dict[str, str]:
    """Units by quantity; one without a quantity is that of the only one."""
    units = dict(settings.unit)
    if ONLY in units:
        unit = units.pop(ONLY)
        if len(quantities) > 1:
            raise SettingsError(
                f"--unit must name its quantity, such as {quantities[0]}={unit}, as there are "
                f"{', '.join(quantities)}"
            )
        units = {quantities[0]: unit}
    if settings.rotor is not None and "rotor_speed" in units:
        units["rotor_momentum"] = units.pop("rotor_speed")  # the momentum follows from the speed
    for option, given in (("--unit", units), ("--sigma", settings.sigma)):
        if unread := set(given) - set(quantities):
            raise SettingsError(
                f"{option} must be of a quantity that is read, {', '.join(quantities)}, but is of "
                f"{', '.join(sorted(unread))}"
            )
    return units


def _add_intervals(
    script: Script, settings: Settings, signals: Mapping[str, Any], units: Mapping[str, str]
) -> bool:
    """Lines that find the `intervals` that become trajectories; False for the whole log."""
    log, flights = script["log"], settings.flights
    times = settings.begin, settings.end
    if times != (None, None):
        if flights is not None:
            raise SettingsError("--flights and --from or --to must not be there together")
        begin, end = (
            f"{'-' if i == 0 else ''}np.inf" if limit is None else repr(limit)
            for i, limit in enumerate(times)
        )
        script.add(f"intervals = [({Path(log.path).stem!r}, {begin}, {end})]")
        return True
    if flights not in WAYS:
        script.add(f"intervals = lgvi.logs.read_intervals({flights!r})")
        return True
    declared = {**_declared(log), **signals}
    driven = [name for name in signals if name in INPUTS]
    if flights == "whole" or (flights is None and (driven or "specific_force" not in declared)):
        return False
    names = {name: declared.get(name) for name in ("specific_force", "angular_velocity")}
    known = {name: unit for name, unit in units.items() if name in names} or None
    script.add(call("intervals = lgvi.logs.find_free_flights", "log", **names, units=known))
    if not script["intervals"]:
        raise LogError(
            log.path,
            "must have a free flight, but none is seen by the accelerometer: give times by --from "
            "and --to, a table of times by --flights FILE, or take all by --flights whole",
        )
    return True


def add_model(
    script: Script, channels: Sequence[str], settings: Settings, sigma: Mapping[str, float]
) -> None:
    """The line that makes the `model`, with a sensor for each channel and its noise."""
    leaves = free_leaves(channels, settings)
    sensors = []
    for channel in channels:
        kind, arguments = SENSORS[channel]
        arguments = {**arguments, **settings.sensors.get(channel, {})}
        needed = NEEDED.get(channel)
        if needed and needed not in {**settings.model, **arguments}:
            raise SettingsError(
                f"a sensor of {channel.replace('_', ' ')} needs `{needed}`, in a file for --config "
                f"under [sensors.{channel}]"
            )
        for leaf in OF_NOTHING:
            if f"{channel}.{leaf}" in leaves:
                arguments.setdefault(leaf, 0.0)
        arguments.setdefault("sigma", sigma[channel])
        sensors.append(call(f"lgvi.{kind}", **arguments))
    options = dict(settings.model)
    laws = " + ".join(LAWS[name] for name in leaves if name in LAWS)
    code = [f"torque={laws}"] if laws else []
    if settings.rotor is not None:
        options["rotor_inertia"] = _rotor_inertia(settings)
    if "rotor_delay" in leaves:
        options.setdefault("rotor_delay", 0.0)
    if settings.rotors:
        code.append(f"rotors=lgvi.Multirotor(**{ {'lag': None, **settings.rotors}!r})")
        if settings.mass is not None:
            options.setdefault("mass", settings.mass)
        on_pivot = "gravity" in settings.sensors.get("specific_force", {})
        if "specific_force" in channels and not on_pivot and "mass" not in options:
            raise SettingsError(
                "an accelerometer feels the thrust of the rotors over the mass: give the mass in "
                "kg by --mass, and --free mass to estimate it"
            )
    moments = settings.moments or [1.0, 1.0, 1.0]
    body = f"lgvi.PhysicalRigidBody.from_principal_moments({moments!r})"
    script.add(
        call("model = identification.Model", body, f"[{', '.join(sensors)}]", *code, **options)
    )


def _rotor_inertia(settings: Settings) -> list[float]:
    inertia, axis = settings.rotor_inertia, settings.axis
    if inertia is None:
        raise SettingsError(
            "a rotor needs its spin inertia in kg m², by --rotor-inertia: it sets the scale of all"
        )
    direction = AXES.get(str(axis).lower()) if isinstance(axis, str) else axis
    if direction is None or len(direction) != 3:
        raise SettingsError(f"a rotor needs its axis, by --axis x, y, z or 3 numbers, not {axis!r}")
    size = math.hypot(*direction)
    if not size:
        raise SettingsError("a rotor needs its axis, by --axis, but it is zero")
    return [inertia * float(part) / size for part in direction]


def free_leaves(channels: Sequence[str], settings: Settings) -> list[str]:
    """The leaves to estimate beside the inertia, in full: a sensor and its field, a law, a rotor.

    Raises
    ------
    SettingsError
        For a name that is none of these.
    """
    leaves = []
    for name in settings.free:
        channel, _, field = name.partition(".")
        if name in ("body", "inertia"):
            continue
        if name == "mass" and not (settings.rotors and (settings.mass or "mass" in settings.model)):
            raise SettingsError(
                "--free mass: the mass can be told where there are rotors, in a file for --config, "
                "and --mass has the mass at the start"
            )
        if name in LAWS or name in OF_MODEL:
            leaves.append(name)
        elif channel == "rotors" and field:
            require_name(field)
            leaves.append(name)
        elif channel in channels and field in _leaves_of(channel):
            leaves.append(name)
        elif name in OF_SENSORS:
            of = [channel for channel in channels if name in _leaves_of(channel)]
            of = of[1:] if name in TO_SECOND and len(of) == len(channels) else of
            if not of:
                raise SettingsError(
                    f"--free {name}: no sensor of {', '.join(channels)} has a {name} that can be "
                    "told from the others; a further sensor is named by --map"
                )
            leaves += [f"{c}.{name}" for c in of]
        else:
            of = [f"{channel}.{leaf}" for channel in channels for leaf in _leaves_of(channel)]
            known = *LAWS, *OF_MODEL, *of, "rotors.FIELD"
            raise SettingsError(
                f"--free {name}: there is no such name; there are {', '.join(known)}"
            )
    return list(dict.fromkeys(leaves))


def _leaves_of(channel: str) -> list[str]:
    """Names of what can be free of the sensor of a channel."""
    sensor = getattr(lgvi, SENSORS[channel][0])
    names = [entry.name for entry in fields(sensor)]
    return [name for name in names if name not in (*sensor.state_fields, "sigma", "frame", "loss")]


def free_function(channels: Sequence[str], settings: Settings) -> str:
    """The argument `free` of `identify`, in code; empty for the inertia alone."""
    leaves = free_leaves(channels, settings)
    nodes = ["model.body"]
    laws = [name for name in leaves if name in LAWS]
    if laws:
        nodes.append("model.torque")
    for name in leaves:
        channel, _, field = name.partition(".")
        if channel == "rotors":
            nodes.append(f"model.rotors.{field}")
        elif field:
            nodes.append(f"model.sensors[{channel!r}].{field}")
        elif name in OF_MODEL:
            nodes.append(f"model.{name}")
    return f"free=lambda model: ({', '.join(nodes)},)" if len(nodes) > 1 else ""
