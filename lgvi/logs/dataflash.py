"""Logs of ArduPilot: dataflash."""

import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from .log import Log
from .signal import LogError, Signal

KIND = "ArduPilot dataflash"

HEAD = b"\xa3\x95"  # a message begins with it, and with the number of its format
FORMAT = 128  # the number of the format of formats, which is the same in all logs
# Of each letter of a format the kind of number, and what a number is multiplied by where no
# message gives the multiplier.
LETTERS: dict[str, tuple[str, float]] = {
    "a": ("(32,)<i2", 1),
    "b": ("i1", 1),
    "B": ("u1", 1),
    "h": ("<i2", 1),
    "H": ("<u2", 1),
    "i": ("<i4", 1),
    "I": ("<u4", 1),
    "g": ("<f2", 1),
    "f": ("<f4", 1),
    "d": ("<f8", 1),
    "n": ("S4", 1),
    "N": ("S16", 1),
    "Z": ("S64", 1),
    "c": ("<i2", 1e-2),
    "C": ("<u2", 1e-2),
    "e": ("<i4", 1e-2),
    "E": ("<u4", 1e-2),
    "L": ("<i4", 1e-7),
    "M": ("u1", 1),
    "q": ("<i8", 1),
    "Q": ("<u8", 1),
}
WHOLE, NUMBER, TEXT = "iu", "iuf", "S"  # kinds of NumPy
NAME = re.compile(r"[A-Za-z0-9_]{1,4}")
LABELS = re.compile(r"[ -~]{1,64}")
TIMES = {"SampleUS": 1e6, "TimeUS": 1e6, "TimeMS": 1e3}  # in a second; a message's first one counts
INSTANCES = "I", "Instance", "Inst"  # fields that number sensors, where no message tells which do
# Messages about the file, and of settings and texts.
ABOUT = "FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG", "VER", "FILE"
BATCHES = "ISBH", "ISBD"
TRIPLES = "XYZ", "NED"
QUATERNION = "Q1", "Q2", "Q3", "Q4"

# Units as messages spell them, and here.
UNITS = {
    **dict.fromkeys(("UNKNOWN", "instance"), ""),
    **dict.fromkeys(("deglatitude", "deglongitude", "degheading"), "deg"),
    "m/s/s": "m/s²",
    "rad/s/s": "rad/s²",
    "deg/s/s": "deg/s²",
    "Gauss": "G",
}
RATE = {"unit": "rad/s", "quantity": "angular_velocity", "frame": "FRD"}
FORCE = {"unit": "m/s²", "quantity": "specific_force", "frame": "FRD"}
FIELD = {"unit": "mG", "quantity": "magnetic_field", "frame": "FRD"}
ROTATION = {"unit": "1", "quantity": "attitude", "frame": "FRD", "space": "NED", "order": "wxyz"}
ROTATION |= {"direction": "body to space"}
POSITION = {"unit": "m", "quantity": "position", "space": "NED"}
ANGLE = {"unit": "deg"}
# What the documentation of messages says of signals, but for the number at the end of a message's
# name. The units are those of messages without units of their own.
DOCUMENTED: dict[str, dict[str, Any]] = {
    "IMU.Gyr": RATE,
    "GYR.Gyr": RATE,
    "IMU.Acc": FORCE,
    "ACC.Acc": FORCE,
    "MAG.Mag": FIELD,
    "XKQ.Q": ROTATION,
    "NKQ.Q": ROTATION,
    "AHR.Q": ROTATION,
    "XKF.P": POSITION,
    "NKF.P": POSITION,
    "ESC.RPM": {"unit": "rpm", "quantity": "rotor_speed"},
    **{f"{name}.{angle}": ANGLE for name in ("ATT", "AHR") for angle in ("Roll", "Pitch", "Yaw")},
}
ESTIMATES = "XKQ", "NKQ", "AHR", "XKF", "NKF", "ATT", "POS"

ARMED, DISARMED = 10, 11  # events
FIX = 3  # GPS.Status, from three dimensions on
GPS_EPOCH, LEAP_SECONDS = datetime(1980, 1, 6, tzinfo=UTC), 18  # seconds since 2017
WEEK, LAST_WEEK = 7 * 86400, 6200  # s; the week of the year 2098
FIRMWARE, MOST_TEXTS = re.compile(r"^\w+ V\d+\."), 20


def read(path: Path) -> Log:
    """Read a log of ArduPilot: the numbers of all messages that have a time.

    A signal has the name of its message and field, such as `ATT.Roll`. Where a message is of one of
    several sensors, the number of the sensor follows, as in `IMU[0].Gyr`. Three fields that end in
    X, Y and Z, or in N, E and D, are one signal, and so are the four of a quaternion, as in
    `XKQ[0].Q`.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Log
        Units are those that the file gives, else those of the documentation. The axes of the body
        are forward, right, down, and those of space north, east, down. Times are `SampleUS` where a
        message has it, else `TimeUS`; the zero is the start of the computer.

    Raises
    ------
    LogError
        If the file is no dataflash log, or most of it cannot be read.

    References
    ----------
    The format: <https://github.com/ArduPilot/ardupilot/tree/master/libraries/AP_Logger>; the
    messages: <https://ardupilot.org/copter/docs/logmessages.html>.
    """
    content = path.read_bytes()
    places, formats = _find_messages(content)
    kept, damage = _chain(path, content, places, formats)
    numbers = np.frombuffer(content, np.uint8)[kept + 2]
    tables, kinds, unread = {}, {}, []
    for number in np.unique(numbers).tolist():
        kind = formats[number]
        if kind.fields and kind.name not in kinds:
            kinds[kind.name] = kind
            tables[kind.name] = _table(content, kept[numbers == number], kind)
        else:
            unread.append(kind.name)
    scales = _scales(tables, formats)
    signals = {
        signal.name: signal
        for name, table in tables.items()
        if name not in (*ABOUT, *BATCHES)
        for signal in _signals(kinds[name], table, scales.get(name, {}))
    }
    if not signals:
        raise LogError(path, "must have messages with a time, but has none")
    start = _start(tables)
    begin = min(signal.times[0] for signal in signals.values())
    end = max(signal.times[-1] for signal in signals.values())
    words = [*damage, *_remarks(signals, tables, scales)]
    if unread:
        words.append(
            "Messages were left out whose fields are not known here, or which are a second kind of "
            f"their name: {', '.join(unread)}."
        )
    if start:
        words.append(
            "The date is by satellites, with the 18 leap seconds since 2017, and late by the delay "
            "of the receiver."
        )
    return Log(
        path=str(path),
        kind=KIND,
        signals=signals,
        start=start,
        facts=dict(_facts(tables)),
        armed=_armed(tables, float(begin), float(end)),
        assumed=tuple(words),
    )


class Kind(NamedTuple):
    """The format of one kind of messages."""

    name: str
    length: int  # bytes, with the header
    letters: str
    fields: dict[str, tuple[str, int]]  # kind of number, and byte from the header on


Places = Int[np.ndarray, " messages"]
Table = Shaped[np.ndarray, " messages"]  # of structures


def _kind(name: str, letters: str, labels: str, length: int) -> Kind:
    """The format; without fields if they are not known here."""
    fields, at = {}, len(HEAD) + 1
    names = labels.split(",")
    for label, letter in zip(names, letters, strict=False):
        code = LETTERS.get(letter, ("V", 1))[0]
        fields.setdefault(label, (code, at))
        at += np.dtype(code).itemsize
    is_known = len(fields) == len(names) == len(letters) and set(letters) <= set(LETTERS)
    is_known &= at == length
    return Kind(name, length, letters, fields if is_known else {})


FORMATS = {FORMAT: _kind("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)}


def _find_messages(content: bytes) -> tuple[Places, dict[int, Kind]]:
    """Where messages may begin, and the formats, which are messages too."""
    numbers = np.frombuffer(content, np.uint8)
    places = np.flatnonzero(numbers[:-2] == HEAD[0])
    places = places[numbers[places + 1] == HEAD[1]]
    formats = dict(FORMATS)
    described = places[numbers[places + 2] == FORMAT]
    described = described[described + FORMATS[FORMAT].length <= len(content)]
    for row in _table(content, described, FORMATS[FORMAT]):
        name, letters, labels = (_text(row[key]) for key in ("Name", "Format", "Columns"))
        if NAME.fullmatch(name) and LABELS.fullmatch(labels) and row["Length"] > 3:
            formats.setdefault(int(row["Type"]), _kind(name, letters, labels, int(row["Length"])))
    return places, formats


def _chain(
    path: Path, content: bytes, places: Places, formats: Mapping[int, Kind]
) -> tuple[Places, list[str]]:
    """Where the messages begin that follow one another, and what is lost, in words.

    A message is whole if another one follows it, or the end of the file. Bytes that only look like
    the header of a message are passed over in this way, as are damaged messages.
    """
    lengths = np.zeros(256, int)
    for number, kind in formats.items():
        lengths[number] = kind.length
    length = lengths[np.frombuffer(content, np.uint8)[places + 2]]
    places, length = places[length > 0], length[length > 0]
    size, ends = len(content), places + length
    after = np.searchsorted(places, ends)
    whole = np.append(np.flatnonzero(np.append(places, size)[after] == ends), len(places))
    steps = whole[np.searchsorted(whole, after)].tolist()
    kept, i = list[int](), int(whole[0])
    while i < len(steps):
        kept.append(i)
        i = steps[i]
    places, ends = places[kept], np.append(0, ends[kept])
    gaps, end = places - ends[:-1], int(ends[-1])
    breaks, lost, rest = ends[:-1][gaps > 0], int(gaps.sum()), size - end
    if 2 * (lost + len(content[end:].strip(b"\0\xff"))) > size:
        raise LogError(path, f"is damaged: of {size} bytes {lost + rest} are no messages")
    damage = []
    if len(breaks):
        damage.append(
            f"The file is damaged in {len(breaks)} places, the first at byte {breaks[0]}: {lost} "
            "bytes were left out."
        )
    if rest:
        damage.append(f"The file ends at byte {end} with {rest} bytes that are no whole message.")
    return places, damage


def _table(content: bytes, places: Places, kind: Kind) -> Table:
    """The messages of one kind."""
    codes, offsets = zip(*kind.fields.values(), strict=True)
    layout: Any = {"names": list(kind.fields), "formats": codes, "offsets": offsets}
    structure = np.dtype(layout | {"itemsize": kind.length})
    if not len(places):
        return np.zeros(0, structure)
    numbers = np.frombuffer(content, np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(numbers, kind.length)
    return windows[places].view(structure)[:, 0]


def _rows(tables: Mapping[str, Table], message: str, **kinds: str) -> Table:
    """The messages of a name, if they have such fields of such kinds of NumPy."""
    table = tables.get(message, np.zeros(0))
    kept = table.dtype.names or ()
    is_known = all(key in kept and table.dtype[key].kind in kinds[key] for key in kinds)
    return table if is_known else table[:0]


def _text(value: bytes) -> str:
    return value.partition(b"\0")[0].decode(errors="replace").strip()


class Scale(NamedTuple):
    """What a message of units says of a field."""

    unit: str
    multiplier: float  # 0 if there is none
    is_instance: bool


def _scales(
    tables: Mapping[str, Table], formats: Mapping[int, Kind]
) -> dict[str, dict[str, Scale]]:
    """Units and multipliers by message and field, as far as the file gives them."""
    units = {
        chr(int(row["Id"]) & 255): _text(row["Label"])
        for row in _rows(tables, "UNIT", Id=WHOLE, Label=TEXT)
    }
    factors = {
        chr(int(row["Id"]) & 255): float(row["Mult"])
        for row in _rows(tables, "MULT", Id=WHOLE, Mult=NUMBER)
    }
    scales = {}
    for row in _rows(tables, "FMTU", FmtType=WHOLE, UnitIds=TEXT, MultIds=TEXT):
        kind = formats.get(int(row["FmtType"]))
        ids = _text(row["UnitIds"]), _text(row["MultIds"])
        if kind and len(ids[0]) == len(ids[1]) == len(kind.letters):
            scales[kind.name] = {
                label: Scale(
                    unit=UNITS.get(units.get(unit, ""), units.get(unit, "")),
                    # Those of "-" and "?" are none; what a letter says is then all there is.
                    multiplier=0 if factor in "-?" else factors.get(factor, 0),
                    is_instance=unit == "#",
                )
                for label, unit, factor in zip(kind.fields, *ids, strict=False)
            }
    return scales


def _signals(kind: Kind, table: Table, scales: Mapping[str, Scale]) -> Iterator[Signal]:
    """The signals of a kind of messages: of each sensor, if they are of several."""
    letters = dict(zip(kind.fields, kind.letters, strict=True))
    numbers = [label for label, letter in letters.items() if letter not in "anNZ"]
    clock = next((label for label in TIMES if label in numbers), None)
    if clock is None:
        return
    instance = next(
        (
            label
            for label in numbers
            if (scales[label].is_instance if scales else label in INSTANCES)
        ),
        None,
    )
    columns = _columns([label for label in numbers if label not in (instance, *TIMES)])
    sensors = [""] if instance is None else np.unique(table[instance]).tolist()
    for sensor in sensors:
        part, name = table, kind.name
        if instance is not None:
            part, name = table[table[instance] == sensor], f"{kind.name}[{sensor}]"
        times = part[clock].astype(float) / TIMES[clock]
        for field, labels in columns.items():
            values = [_values(part[label], letters[label], scales.get(label)) for label in labels]
            described = _described(kind.name, field, labels)
            if scales and scales[labels[0]].unit:
                described["unit"] = scales[labels[0]].unit
            yield Signal(
                name=f"{name}.{field}",
                times=times,
                values=np.column_stack(values) if len(labels) > 1 else values[0],
                components=_components(labels),
                **described,
            )


def _values(
    numbers: Shaped[np.ndarray, " samples"], letter: str, scale: Scale | None
) -> Float[np.ndarray, " samples"]:
    factor = (scale.multiplier if scale else 0) or LETTERS[letter][1]
    with np.errstate(all="ignore"):  # damaged numbers of single precision may be no numbers
        return numbers.astype(float) * factor


def _columns(labels: list[str]) -> dict[str, list[str]]:
    """The labels of each signal."""
    vectors: dict[str, list[str]] = {"Q": list(QUATERNION)}
    for axes in TRIPLES:
        stems = [label[:-1] for label in labels if label[-1:] == axes[0]]
        vectors |= {stem: [stem + axis for axis in axes] for stem in stems}
    vectors = {
        name: parts
        for name, parts in vectors.items()
        if name and name not in labels and set(parts) <= set(labels)
    }
    names = {part: name for name, parts in vectors.items() for part in parts}
    return {names.get(label, label): vectors.get(names.get(label, ""), [label]) for label in labels}


def _components(labels: list[str]) -> tuple[str, ...]:
    if len(labels) == 1:
        return ()
    return tuple("wxyz") if labels == list(QUATERNION) else tuple(label[-1] for label in labels)


def _described(message: str, field: str, labels: list[str]) -> dict[str, Any]:
    described = DOCUMENTED.get(f"{_base(message)}.{field}", {})
    is_vector = "frame" in described or "space" in described
    return dict(described) if is_vector == (len(labels) > 1) else {}


def _base(message: str) -> str:
    """The name without the number that older firmwares gave each sensor."""
    return message.rstrip("0123456789")


def _start(tables: Mapping[str, Table]) -> datetime | None:
    """Date and time of the zero, by satellites."""
    rows = _rows(tables, "GPS", GWk=WHOLE, GMS=WHOLE, Status=WHOLE, TimeUS=WHOLE)
    if not len(rows):
        return None
    rows = rows[(rows["Status"] >= FIX) & (rows["GWk"] > 0) & (rows["GWk"] < LAST_WEEK)]
    seconds = rows["GWk"] * float(WEEK) + rows["GMS"] / 1e3 - rows["TimeUS"] / 1e6
    since = float(np.median(seconds)) - LEAP_SECONDS if len(rows) else 0
    return GPS_EPOCH + timedelta(seconds=since) if since > 0 else None


def _armed(
    tables: Mapping[str, Table], begin: float, end: float
) -> tuple[tuple[float, float], ...] | None:
    """The intervals in which the vehicle was armed, by its messages or its events."""
    rows = _rows(tables, "ARM", ArmState=WHOLE, TimeUS=WHOLE)
    if len(rows):
        states = rows["ArmState"] == 1
    else:
        rows = _rows(tables, "EV", Id=WHOLE, TimeUS=WHOLE)
        rows = rows[np.isin(rows["Id"], (ARMED, DISARMED))] if len(rows) else rows
        if not len(rows):
            return None
        states = rows["Id"] == ARMED
    # What is switched off at first was on when the log began.
    is_on = np.concatenate([[False], ~states[:1], states, [False]])
    times = np.concatenate([[begin], rows["TimeUS"] / 1e6, [end]])
    bounds = times[is_on[1:] != is_on[:-1]].tolist()
    return tuple(zip(bounds[::2], bounds[1::2], strict=True))


def _facts(tables: Mapping[str, Table]) -> Iterator[tuple[str, str]]:
    """Texts, the version, and parameters: of one that changes the first value."""
    texts = [_text(row["Message"]) for row in _rows(tables, "MSG", Message=TEXT)[:MOST_TEXTS]]
    yield from (("firmware", text) for text in texts if FIRMWARE.search(text))
    yield from ((f"message {i}", text) for i, text in enumerate(texts))
    for row in _rows(tables, "VER")[:1]:
        for label in row.dtype.names:
            value = row[label]
            yield f"version {label}", _text(value) if isinstance(value, bytes) else str(value)
    parameters = _rows(tables, "PARM", Name=TEXT, Value=NUMBER)
    values = {_text(row["Name"]): row["Value"] for row in parameters[::-1]}
    yield from ((f"parameter {name}", str(values[name])) for name in sorted(values))


def _remarks(
    signals: Mapping[str, Signal], tables: Mapping[str, Table], scales: Mapping[str, Any]
) -> Iterator[str]:
    """What was recognised or assumed, in words."""
    names = {_base(name) for name in tables}
    sampled = [name for name in tables if len(_rows(tables, name, SampleUS=WHOLE))]
    if sampled:
        yield f"Times are those of the samples (`SampleUS`) for the messages {', '.join(sampled)}."
    if not scales:
        yield "The file gives no units: those of the documentation were taken."
    back = {
        name.partition(".")[0]
        for name, signal in signals.items()
        if np.any(np.diff(signal.times) < 0)
    }
    if back:
        shown = ", ".join(sorted(back))
        yield f"Times go back in the messages {shown}; the order is that of the file."
    if "IMU" in names:
        yield (
            "`IMU` is filtered by the flight computer (parameters INS_GYRO_FILTER and "
            "INS_ACCEL_FILTER), which delays it."
        )
    if names & {"GYR", "ACC"}:
        yield (
            "`GYR` and `ACC` are at the rate of the sensor, before or after the filters by the "
            "parameter INS_RAW_LOG_OPT."
        )
    estimates = ", ".join(f"`{name}`" for name in tables if _base(name) in ESTIMATES)
    if estimates:
        yield f"What the flight computer estimates, and does not measure: {estimates}."
    if any(signal.order for signal in signals.values()):
        yield (
            "Quaternions turn from body to space, as in the firmware, though the documentation of "
            "the messages says: from NED to XYZ."
        )
    if "ESC" in names:
        yield (
            "`ESC` is what the speed controllers send; speeds are by the number of poles in a "
            "parameter, such as SERVO_BLH_POLES. Numbers are those of outputs, whose motors the "
            "parameters SERVO1_FUNCTION and others tell."
        )
    if any(name.endswith(".RawRPM") for name in signals):
        yield (
            "`RPM` of `ESC` goes in a straight line from a reading to the next one, and so comes "
            "late by the time between two; `RawRPM` is the last reading."
        )
    if "RCOU" in names:
        yield "`RCOU` are commands, us of pulses, not speeds."
    if names.intersection(BATCHES):
        yield f"Batches of samples ({', '.join(BATCHES)}) are not read."
    dropped = _rows(tables, "DSF", Dp=WHOLE)
    if len(dropped) and dropped["Dp"].max():
        yield f"The logger was too slow: {dropped['Dp'].max()} messages are missing."
