"""What the fields of a blackbox log mean, by the firmware that wrote it."""

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..signal import LogError, Signal
from .samples import Table

ELEMENT = re.compile(r"(.+)\[(\d+)\]")  # of an array, such as gyroADC[0]

DEGREES_FIRMWARES = "Betaflight", "Cleanflight"  # types whose scale is in deg/s
# Revisions whose first flag is the switch to arm, which is another one in Cleanflight.
ARM_FIRMWARES = "Betaflight", "EmuFlight", "INAV", "Rotorflight"
GYROSCOPES = "gyroADC", "gyroUnfilt"
# Gyroscopes read up to 2000 deg/s, from which the firmware takes the offset at rest.
RANGE, LARGEST_OFFSET = 2000.0, 20.0  # deg/s

# Numbers of the header that can be.
MOTOR_POLES, GYRO_SCALE, ONE_G = (2, 200), (1e-3, 1.0), (16, 65536)

RATE = {"unit": "deg/s", "quantity": "angular_velocity"}
FORCE = {"unit": "g", "quantity": "specific_force"}
ROTATION = {"unit": "1", "quantity": "attitude", "order": "wxyz", "direction": "body to space"}
VECTORS: dict[str, dict[str, Any]] = {
    "gyroADC": RATE,
    "gyroUnfilt": RATE,
    "accSmooth": FORCE,
    "magADC": {"quantity": "magnetic_field"},
    "imuQuaternion": ROTATION,
}
DELAYED = "is filtered by the flight computer, which delays it."
REMARKS = {
    "gyroADC": DELAYED,
    "gyroUnfilt": "is not filtered, but for the filter of the sensor.",
    "accSmooth": DELAYED,
    "imuQuaternion": (
        "is what the flight computer estimates; without compass and GPS its north is the heading "
        "at power-on. Its `w` is computed of the others, and not exact near half a turn."
    ),
}


def make_signals(
    path: Path, lines: Mapping[str, str], tables: Sequence[Table], motor_poles: int | None
) -> tuple[dict[str, Signal], list[str]]:
    """The signals by name, and what was recognised or assumed, in words."""
    is_betaflight = _firmware(lines) == "Betaflight"
    factors = _factors(path, lines, tables, motor_poles)
    signals = {
        signal.name: signal
        for table in tables
        for signal in _signals(table, factors, is_betaflight)
    }
    return signals, list(_remarks(signals, lines, factors, is_betaflight))


def find_armed(
    lines: Mapping[str, str], signals: Mapping[str, Signal], end: float
) -> tuple[tuple[float, float], ...] | None:
    """When the switch to arm was on; None if it never was, as sticks can arm too."""
    modes = signals.get("flightModeFlags")
    if _firmware(lines) not in ARM_FIRMWARES or modes is None or modes.values.ndim > 1:
        return None
    is_on = np.concatenate([[0], modes.values.astype(int) & 1, [0]])
    # The first flags come after the first frame.
    bounds = np.concatenate([[0.0], modes.times[1:], [end]])[np.diff(is_on) != 0].tolist()
    return tuple(zip(bounds[::2], bounds[1::2], strict=True)) or None


def _firmware(lines: Mapping[str, str]) -> str:
    """The name of the firmware, without its version; INAV and others have the type of another."""
    return lines.get("Firmware revision", "").partition(" ")[0]


def _number(lines: Mapping[str, str], name: str, allowed: tuple[float, float]) -> float | None:
    """A number of the header in a range; None if there is none."""
    text = lines.get(name, "")
    try:
        # Hexadecimal digits are the bits of a number of single precision.
        number = struct.unpack(">f", bytes.fromhex(text[2:]))[0] if "0x" in text else float(text)
    except (ValueError, struct.error):
        return None
    return number if allowed[0] <= number <= allowed[1] else None


def _factors(
    path: Path, lines: Mapping[str, str], tables: Sequence[Table], motor_poles: int | None
) -> dict[str, float]:
    """What the numbers of fields are multiplied by; none for those whose scale is not known."""
    factors = {"imuQuaternion": 1 / 32767, "GPS_coord": 1e-7}
    name = "gyro_scale" if "gyro_scale" in lines else "gyro.scale"
    scale = _number(lines, name, GYRO_SCALE)
    if scale and lines.get("Firmware type") in DEGREES_FIRMWARES:
        finer = 10 if lines.get("blackbox_high_resolution") == "1" else 1
        factors |= dict.fromkeys(GYROSCOPES, scale / finer)
    if one_g := _number(lines, "acc_1G", ONE_G):
        factors["accSmooth"] = 1 / one_g
    if any(name.startswith("eRPM[") for name in tables[0].names):
        poles = motor_poles or _number(lines, "motor_poles", MOTOR_POLES)
        if not poles:
            words = "must have the number of poles of a motor, but the file does not tell: say it"
            words += " by `motor_poles=`"
            raise LogError(path, words, "signal `motor_speed`")
        factors["eRPM"] = 200 / poles
    return factors


def _signals(table: Table, factors: Mapping[str, float], is_betaflight: bool) -> Iterator[Signal]:
    """A signal for each field that is a number or an array."""
    arrays: dict[str, dict[str, int]] = {}
    for column, name in enumerate(table.names):
        element = ELEMENT.fullmatch(name)
        name, index = element.groups() if element else (name, "")
        if name not in ("loopIteration", "time"):
            arrays.setdefault(name, {})[index] = column
    for name, columns in arrays.items() if len(table.times) else ():
        values, components = table.rows[:, list(columns.values())].astype(float), tuple(columns)
        if components == ("",):
            components, values = (), values[:, 0]
        signal = Signal(name, table.times, values, components=components)
        yield replace(signal, **_describe(signal, factors.get(name), is_betaflight))


def _describe(signal: Signal, factor: float | None, is_betaflight: bool) -> dict[str, Any]:
    """What the documentation says of a field, and its values; nothing of most fields."""
    name, values = signal.name, signal.values if factor is None else signal.values * factor
    if name in VECTORS and signal.components == ("0", "1", "2"):
        described = VECTORS[name] | {"values": values, "components": tuple("xyz")}
        if is_betaflight:
            described["frame"] = "FLU"
        if name in ("accSmooth", *GYROSCOPES) and factor is None:
            described["unit"] = ""
        elif name in GYROSCOPES and np.max(np.abs(values)) <= RANGE + LARGEST_OFFSET:
            described["limit"] = RANGE - LARGEST_OFFSET
        elif name == "imuQuaternion":
            w = np.sqrt(np.maximum(0, 1 - np.sum(values**2, axis=1)))
            described |= {"values": np.column_stack([w, values]), "components": tuple("wxyz")}
            described |= {"space": "NWU"} if is_betaflight else {"direction": ""}
        return described
    if name == "GPS_coord":
        return {"values": values, "unit": "deg"}
    if name in ("motor", "eRPM") and signal.components:
        described = {"values": values, "components": tuple(f"m{i}" for i in signal.components)}
        speed = {"name": "motor_speed", "unit": "rpm", "quantity": "rotor_speed"}
        return described | (speed if name == "eRPM" and factor is not None else {})
    return {}


def _remarks(
    signals: Mapping[str, Signal],
    lines: Mapping[str, str],
    factors: Mapping[str, float],
    is_betaflight: bool,
) -> Iterator[str]:
    """What was recognised or assumed, in words."""
    if is_betaflight:
        yield (
            "The axes of the body are those of Betaflight, forward, left, up, to which it turns "
            "the sensors by the alignment of the board."
        )
    else:
        yield (
            "The axes of the body are those of the firmware, of which it is not known here whether "
            "they are forward, left, up."
        )
    gyroscopes = [name for name in GYROSCOPES if name in signals]
    for name in gyroscopes:
        if signals[name].unit:
            finer = ", a tenth of it" if lines.get("blackbox_high_resolution") == "1" else ""
            yield f"`{name}` is the number of the file times the scale in the header{finer}."
        else:
            yield f"`{name}` has no unit, as the scale of this firmware is not known."
    if any(np.isfinite(signals[name].limit) for name in gyroscopes):
        yield (
            f"Gyroscopes are taken to read up to {RANGE:g} deg/s, less an offset of up to "
            f"{LARGEST_OFFSET:g} deg/s that the firmware takes off."
        )
    for name in REMARKS:
        if name in signals:
            yield f"`{name}` {REMARKS[name]}"
    if "motor" in signals:
        output = f" from {lines['motorOutput']}" if "motorOutput" in lines else ""
        yield f"`motor` are commands{output}, not speeds."
    if "motor_speed" in signals:
        yield (
            f"`motor_speed` is for motors with {200 / factors['eRPM']:g} poles; it has no sign, "
            "and the last value that the speed controller sent."
        )
