"""Logs of Betaflight and its relatives: blackbox."""

import re
import struct
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from .log import Log
from .signal import LogError, Signal

KIND = "Betaflight blackbox"

MARK = re.compile(rb"H Product:Blackbox flight data recorder[^\n]*\n")  # a log begins with it
LINE = re.compile(rb"H ([ -9;-~]{1,80}):([^\n]{0,4000})\n")
HEADER_SIZE = 65536  # bytes in which a header ends
GAP_IN_HEADER = 400  # bytes: a damaged line is not longer
ELEMENT = re.compile(r"(.+)\[(\d+)\]")  # of an array, such as gyroADC[0]

INTRA, INTER, GPS, HOME, SLOW, EVENT = "IPGHSE"
MOST_FIELDS, LONGEST = 128, 256  # fields and bytes of a frame
WINDOW, MARGIN = 1 << 17, 1024  # bytes that are decoded at once, and beyond: more than a frame

SIGNED, UNSIGNED, NEGATIVE, EIGHT, THREE, FOUR, NOTHING, THREE_UNEVEN = 0, 1, 3, 6, 7, 8, 9, 10
AT_ONCE = {EIGHT: 8, THREE: 3, FOUR: 4, THREE_UNEVEN: 3}  # fields that an encoding packs
# Of three values by the first two bits: where they are in the first three bytes (bits to the right,
# bits), and how many bytes they take.
PACKED = ((20, 2), (18, 2), (16, 2)), 1
PACKINGS = {
    THREE: (PACKED, (((16, 4), (12, 4), (8, 4)), 2), (((16, 6), (8, 6), (0, 6)), 3)),
    THREE_UNEVEN: (PACKED, (((17, 5), (12, 5), (8, 4)), 2), (((14, 8), (7, 7), (0, 7)), 3)),
}
NIBBLES = np.array([0, 1, 2, 4])  # of one of four values, by two bits of the tag

FIRST_MOTOR, HOME_POSITION, MAIN_TIME = 5, 7, 10
# Weights of the last frame and of the one before, for predictors that need them.
WEIGHTS = {1: (1, 0), 2: (2, -1), 3: (0.5, 0.5), 6: (1, 0)}
# Lines of the header whose first number predictors take; others are constant.
REFERENCES = {4: "minthrottle", 9: "vbatref", 11: "motorOutput"}
CONSTANTS = {6: 1.0, 8: 1500.0}
PREDICTORS = {
    INTRA: {0, FIRST_MOTOR, 8, *REFERENCES},
    INTER: {0, FIRST_MOTOR, *WEIGHTS, *CONSTANTS, *REFERENCES},
    GPS: {0, HOME_POSITION, MAIN_TIME},
    HOME: {0},
    SLOW: {0},
}

# The data of events: a byte (b) or a number of variable length (v).
EVENTS = {0: "v", 14: "vv", 15: "v", 20: "bvbb", 30: "vv"}
ADJUSTMENT, LOG_END = 13, b"\xffEnd of log\0"

WRAP = 2**32  # the clock of the flight computer has 32 bits
LONGEST_INTERVAL = 1_000_000  # us from one frame to the next in a group
LONGEST_GROUP = 2048  # frames: an intraframe is written every 32 ms
SLACK, DRIFT = 100_000, 0.2  # us, and part of the time, by which a group may be early or late
USEFUL = 1.0  # s: shorter logs are of attempts to take off
FIRMWARES = "Betaflight", "Cleanflight"  # types that log deg/s
GYROSCOPES = "gyroADC", "gyroUnfilt"
# Gyroscopes read up to 2000 deg/s, from which the firmware takes the offset at rest.
RANGE, LARGEST_OFFSET = 2000.0, 20.0  # deg/s

# Numbers of the header that can be.
MOTOR_POLES, GYRO_SCALE, ONE_G = (2, 200), (1e-3, 1.0), (16, 65536)

RATE: dict[str, Any] = {"unit": "deg/s", "quantity": "angular_velocity"}
FORCE = {"unit": "g", "quantity": "specific_force"}
ROTATION = {"unit": "1", "quantity": "attitude", "order": "wxyz", "direction": "body to space"}
VECTORS: dict[str, dict[str, Any]] = {
    "gyroADC": RATE,
    "gyroUnfilt": RATE,
    "accSmooth": FORCE,
    "magADC": {"quantity": "magnetic_field"},
    "imuQuaternion": ROTATION,
}


def read(path: Path, log: int | None = None, motor_poles: int | None = None) -> Log:
    r"""Read a blackbox log of Betaflight, or of a firmware that logs in the same way.

    The angular velocity is the number of the file times `gyro_scale` of the header, and a tenth of
    it with `blackbox_high_resolution`; the specific force is a multiple of `acc_1G`. The speed of a
    motor is $200\,n/p$ rev/min, with the number $n$ in the field `eRPM`, which is in 100 electrical
    revolutions in a minute, and $p$ poles. Of a quaternion the file has $x$, $y$ and $z$ in parts
    of 32767, and $w = \sqrt{1 - x^2 - y^2 - z^2}$.

    Parameters
    ----------
    path
        The file: from an SD card, a flash memory or a serial logger.
    log
        The number of the log, from 1, if there are several in the file, as one is written each
        time that the vehicle is armed. By default the only one that lasts a second or more.
    motor_poles
        The number of poles (magnets) of a motor; by default that of the header.

    Returns
    -------
    Log
        Signals have the names of the fields, such as `gyroADC`, or `motor_speed` for the speeds of
        the motors, rpm. For Betaflight the axes of the body are forward, left, up, and those of
        space north, west, up. The zero of the times is the first frame.

    Raises
    ------
    LogError
        If the file has several logs or lacks the number of poles, and the argument does not say; if
        it has an encoding that is not known here; if most of the log cannot be read.
    ValueError
        For a number of poles that cannot be.

    References
    ----------
    The format: <https://betaflight.com/docs/development/blackbox-internals>. What the fields mean,
    and the axes: blackbox.c and imu.c of <https://github.com/betaflight/betaflight>.
    """
    if motor_poles is not None and (motor_poles < 2 or motor_poles % 2):
        raise ValueError(f"Argument `motor_poles` must be an even number, but is {motor_poles}.")
    content = path.read_bytes()
    begins = [mark.start() for mark in MARK.finditer(content)]
    if not begins:
        words = "must have a line `H Product:Blackbox flight data recorder`, but has none"
        raise LogError(path, words)
    parts = list(zip(begins, [*begins[1:], len(content)], strict=True))
    number, words = _choose(path, content, parts, log)
    header = _read_header(path, content, *parts[number - 1])
    frames = _read_frames(content, header)
    samples = _make_samples(path, header, frames)
    return _make_log(path, header, samples, motor_poles, words)


def _choose(
    path: Path, content: bytes, parts: list[tuple[int, int]], log: int | None
) -> tuple[int, list[str]]:
    """The number of the log to be read, from 1, and what to say of the choice."""
    count = len(parts)
    if log is not None:
        if not 1 <= log <= count:
            raise LogError(path, f"has {count} logs: `log` must be from 1 to {count}, but is {log}")
        return log, [f"Log {log} of {count} was read."]
    if count == 1:
        return 1, []
    durations = [_duration(path, content, part) for part in parts]
    useful = [i for i, duration in enumerate(durations, 1) if duration >= USEFUL]
    if len(useful) == 1:
        words = f"Log {useful[0]} of {count} was read, as the others are shorter than {USEFUL} s."
        return useful[0], [words]
    shown = ", ".join(f"{i} ({duration:.3g} s)" for i, duration in enumerate(durations, 1))
    raise LogError(path, f"has several logs: {shown}; say which by `log=` or `--read log=`")


def _duration(path: Path, content: bytes, part: tuple[int, int]) -> float:
    """About how long a log lasts, s, by its first and last frames; 0 if it cannot be read."""
    try:
        header = _read_header(path, content, *part)
    except LogError:
        return 0.0
    begin, end = header.end, max(header.end, header.stop - WINDOW)
    first = _read_frames(content, header._replace(stop=min(begin + WINDOW, header.stop)))
    last = _read_frames(content, header._replace(end=end))
    times = [frames.main[frames.is_intra, header.time] for frames in (first, last)]
    return (times[1][-1] - times[0][0]) % WRAP / 1e6 if all(map(len, times)) else 0.0


class Fields(NamedTuple):
    """The fields of one kind of frames."""

    names: list[str]
    predictors: list[int]
    groups: list[tuple[int, int]]  # encoding, number of fields that are packed together
    is_signed: list[bool]


class Header(NamedTuple):
    """What a log says of itself before the frames."""

    lines: dict[str, str]
    kinds: dict[str, Fields]
    end: int  # byte where the frames begin
    stop: int  # byte where the log ends
    time: int  # numbers of two fields
    iteration: int
    references: dict[int, float]  # constants that predictors take
    damage: list[str]  # in words


def _read_header(path: Path, content: bytes, begin: int, stop: int) -> Header:
    lines, damage, end = {}, [], begin
    for line in LINE.finditer(content, begin, min(begin + HEADER_SIZE, stop)):
        if line.start() - end > GAP_IN_HEADER:
            break
        if line.start() > end:
            damage.append(f"A line of the header is damaged at byte {end}.")
        name, value = (text.decode(errors="replace") for text in line.groups())
        lines[name], end = value.strip(), line.end()
    stop -= len(content[end:stop]) - len(content[end:stop].rstrip(b"\xff"))  # erased flash memory

    def refuse(words: str, name: str) -> NoReturn:
        raise LogError(path, words, f"byte {begin}, line `{name}` of the header")

    def numbers(name: str) -> list[int]:
        texts = (
            lines[name].split(",") if name in lines else refuse("must be there, but is not", name)
        )
        if not all(re.fullmatch(r"-?\d{1,9}", text) for text in texts):
            refuse(f"must have whole numbers, but has {lines[name][:80]!r}", name)
        return [int(text) for text in texts]

    if lines.get("Data version") != "2":
        refuse(f"must be 2, but is {lines.get('Data version', 'not there')}", "Data version")
    names = {kind: lines.get(f"Field {kind} name", "") for kind in (INTRA, GPS, HOME, SLOW)}
    names[INTER] = names[INTRA]
    kinds = {}
    for kind in (INTRA, INTER, *(kind for kind in (GPS, HOME, SLOW) if names[kind])):
        listed = names[kind].split(",")
        table = {}
        for key in ("predictor", "encoding"):
            name = f"Field {kind} {key}"
            table[key] = numbers(name)
            if not len(table[key]) == len(listed) <= MOST_FIELDS:
                words = f"must have a number for each of {len(listed)} fields (at most "
                refuse(f"{words}{MOST_FIELDS}), but has {len(table[key])}", name)
        signed = lines.get(f"Field {INTRA if kind == INTER else kind} signed", "").split(",")
        if strange := set(table["predictor"]) - PREDICTORS[kind]:
            refuse(f"has the predictor {min(strange)}, not known here", f"Field {kind} predictor")
        groups = _group(table["encoding"])
        if not groups:
            refuse("has encodings that are not known here", f"Field {kind} encoding")
        is_signed = [number != "0" for number in signed]
        is_signed += [True] * (len(listed) - len(is_signed))
        kinds[kind] = Fields(listed, table["predictor"], groups, is_signed[: len(listed)])
    for name in ("loopIteration", "time"):
        if name not in kinds[INTRA].names:
            refuse(f"must have `{name}`, but has not", f"Field {INTRA} name")
    used = set(kinds[INTRA].predictors + kinds[INTER].predictors)
    references = {key: numbers(REFERENCES[key])[0] for key in REFERENCES if key in used}
    if FIRST_MOTOR in used and "motor[0]" not in kinds[INTRA].names:
        refuse("must have `motor[0]`, but has not", f"Field {INTRA} name")
    time, iteration = (kinds[INTRA].names.index(name) for name in ("time", "loopIteration"))
    return Header(lines, kinds, end, stop, time, iteration, CONSTANTS | references, damage)


def _group(encodings: list[int]) -> list[tuple[int, int]]:
    """Fields that are packed together: encoding and number; none if an encoding is not known."""
    groups, i = [], 0
    while i < len(encodings):
        encoding, most = encodings[i], AT_ONCE.get(encodings[i], 1)
        count = 1
        while count < most and encodings[i : i + count + 1] == [encoding] * (count + 1):
            count += 1
        if encoding not in DECODERS or (encoding != EIGHT and count != most):
            return []
        groups.append((encoding, count))
        i += count
    return groups


# Decoders: from bytes and where numbers begin to the numbers and where they end.
Bytes = Int[np.ndarray, " bytes"]
Places = Int[np.ndarray, " frames"]
Numbers = Int[np.ndarray, "fields frames"]


def _decode_unsigned(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    """Seven bits in a byte, the lowest first; the eighth says that more follow."""
    value, at = content[at], at + 1
    more = np.flatnonzero(value > 127)
    for shift in (7, 14, 21, 28):
        byte = content[at[more]]
        value[more] += (byte - 1) << shift  # and without the eighth bit of the byte before
        at[more] += 1
        more = more[byte > 127]
        if not len(more):
            break
    return value[None], at


def _decode_signed(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    """Zigzag: 0, -1, 1, -2, ..."""
    value, at = _decode_unsigned(content, at)
    return (value >> 1) ^ -(value & 1), at


def _decode_negative(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    value, at = _decode_unsigned(content, at)
    return -_sign(value, 14), at


def _decode_nothing(content: Bytes, at: Places, count: int = 1) -> tuple[Numbers, Places]:
    return np.zeros((1, len(at)), int), at


def _decode_eight(content: Bytes, at: Places, count: int) -> tuple[Numbers, Places]:
    """A byte whose bits say which fields are not zero, and these; a single field is bare."""
    if count == 1:
        return _decode_signed(content, at)
    tag, at = content[at], at + 1
    values = np.zeros((count, len(at)), int)
    some = np.flatnonzero(tag)
    for i in range(count):
        present = some[tag[some] >> i & 1 > 0]
        if len(present):
            values[i, present], at[present] = _decode_signed(content, at[present])
    return values, at


def _decode_three(packing: tuple) -> Callable[..., tuple[Numbers, Places]]:
    """Two bits, and three values of few bits; or a size for each, and so many bytes."""

    def decode(content: Bytes, at: Places, count: int = 3) -> tuple[Numbers, Places]:
        tag, at = content[at], at.copy()
        bits = tag << 16 | content[at + 1] << 8 | content[at + 2]
        values = np.empty((3, len(at)), int)
        for selector, (places, size) in enumerate(packing):
            chosen = np.flatnonzero(tag >> 6 == selector)
            for value, (shift, width) in zip(values, places, strict=True):
                value[chosen] = _sign(bits[chosen] >> shift, width)
            at[chosen] += size
        chosen = np.flatnonzero(tag >> 6 == 3)
        at[chosen] += 1
        for i, value in enumerate(values):
            size, begin = (tag[chosen] >> 2 * i & 3) + 1, at[chosen]
            number = sum(content[begin + k] << 8 * k for k in range(4))
            value[chosen] = _sign(number, 8 * size)
            at[chosen] += size
        return values, at

    return decode


def _decode_four(content: Bytes, at: Places, count: int = 4) -> tuple[Numbers, Places]:
    """A byte that says how many bits each value has, and the values, half bytes in a row."""
    tag, nibble = content[at], 2 * (at + 1)
    values = np.zeros((4, len(at)), int)
    some = np.flatnonzero(tag)
    for i in range(4):
        size, begin = NIBBLES[tag[some] >> 2 * i & 3], nibble[some]
        byte = begin >> 1
        bits = content[byte] << 16 | content[byte + 1] << 8 | content[byte + 2]
        values[i, some] = _sign(bits >> (24 - 4 * (begin & 1) - 4 * size), 4 * size)
        nibble[some] += size
    return values, (nibble + 1) >> 1


def _sign(number: Any, bits: Any) -> Any:
    """The lowest bits of a number, as a signed one."""
    half = (1 << bits) >> 1
    return ((number & ((1 << bits) - 1)) ^ half) - half


DECODERS: dict[int, Callable[..., tuple[Numbers, Places]]] = {
    SIGNED: _decode_signed,
    UNSIGNED: _decode_unsigned,
    NEGATIVE: _decode_negative,
    EIGHT: _decode_eight,
    THREE: _decode_three(PACKINGS[THREE]),
    FOUR: _decode_four,
    NOTHING: _decode_nothing,
    THREE_UNEVEN: _decode_three(PACKINGS[THREE_UNEVEN]),
}


def _decode(content: Bytes, at: Places, fields: Fields) -> tuple[Numbers, Places]:
    """The fields of frames, less what is predicted, and where the frames end."""
    values, first = np.empty((len(fields.names), len(at)), int), 0
    for encoding, count in fields.groups:
        values[first : first + count], at = DECODERS[encoding](content, at, count)
        first += count
    return values, at


Rows = Float[np.ndarray, "frames fields"]


class Frames(NamedTuple):
    """Frames of a log, less what is predicted."""

    main: Rows  # intraframes and interframes
    is_intra: Bool[np.ndarray, " frames"]
    places: Places  # bytes where the main frames begin
    others: dict[str, tuple[Rows, Places]]
    end: int  # byte where the last frame ends
    breaks: list[int]  # bytes where no frame begins that should
    lost: int  # bytes that are no frames, before the last frame
    is_ended: bool  # by the event that ends a log


def _read_frames(content: bytes, header: Header) -> Frames:
    """The frames that follow one another.

    Nothing but the frame after it tells that a frame is whole. So all bytes that may begin a frame
    are decoded at once, as if each did, which takes a few array operations for each field; the
    frames are the chain from the end of one to the next. Where it breaks it goes on at the next
    intraframe, without which interframes cannot be decoded.
    """
    parts = {
        kind: [(np.zeros((0, len(fields.names))), np.zeros(0, int))]
        for kind, fields in header.kinds.items()
    }
    begin = end = header.end
    breaks, lost, is_ended, is_broken = [], 0, False, False
    while begin < header.stop and not is_ended:
        window, size = _window(content, begin, header.stop)
        ends, decoded = _decode_window(window, size, header.stop - begin, header.kinds)
        anchors = decoded[INTRA][0]
        anchors = anchors[ends[anchors] > 0]
        steps, chain, at = ends.tolist(), [], 0
        while at < size:
            if is_broken:
                anchor = int(np.searchsorted(anchors, at))
                if anchor == len(anchors):
                    at = size
                    break
                at, is_broken = int(anchors[anchor]), False
                lost += begin + at - end
            step = steps[at]
            if step:
                chain.append(at)
            elif window[at] == ord(EVENT):
                step = _event_end(content, begin + at, header) - begin
                is_ended = content.startswith(LOG_END, begin + at + 1)
            if step <= 0:
                breaks.append(begin + at)
                is_broken = True
                continue
            at, end = step, begin + step
            if is_ended:
                break
        kept = np.array(chain, int)
        for kind, (starts, values) in decoded.items():
            rows = np.searchsorted(starts, kept[window[kept] == ord(kind)])
            parts[kind].append((values[:, rows].T.astype(float), begin + starts[rows]))
        begin += at
    rows = {kind: np.concatenate([values for values, _ in parts[kind]]) for kind in parts}
    places = {kind: np.concatenate([starts for _, starts in parts[kind]]) for kind in parts}
    main = np.concatenate([places[INTRA], places[INTER]])
    order = np.argsort(main)
    return Frames(
        main=np.concatenate([rows.pop(INTRA), rows.pop(INTER)])[order],
        is_intra=order < len(places[INTRA]),
        places=main[order],
        others={kind: (rows[kind], places[kind]) for kind in rows},
        end=end,
        breaks=breaks,
        lost=lost,
        is_ended=is_ended,
    )


def _window(content: bytes, begin: int, stop: int) -> tuple[Bytes, int]:
    """Bytes with zeros after them, and how many of them may begin a frame."""
    part = np.frombuffer(content, np.uint8, min(WINDOW + MARGIN, stop - begin), begin)
    window = np.zeros(WINDOW + MARGIN, int)
    window[: len(part)] = part
    return window, min(WINDOW, stop - begin)


def _decode_window(
    window: Bytes, size: int, limit: int, kinds: Mapping[str, Fields]
) -> tuple[Places, dict[str, tuple[Places, Numbers]]]:
    """Where the frame ends that begins at each byte, or 0; and what may be frames of each kind."""
    is_kind = np.zeros(256, bool)
    is_kind[[ord(kind) for kind in (*kinds, EVENT)]] = True
    ends, decoded = np.zeros(size, int), {}
    for kind, fields in kinds.items():
        starts = np.flatnonzero(window[:size] == ord(kind))
        values, end = _decode(window, starts + 1, fields)
        whole = (end - starts <= LONGEST) & (end <= limit)
        whole &= is_kind[window[end]] | (end == limit)
        ends[starts[whole]] = end[whole]
        decoded[kind] = starts, values
    # A frame is followed by a whole one, or by an event, as far as can be seen in the window. The
    # last frame before damaged bytes is left out as well, in case that they are its own.
    starts = np.flatnonzero(ends)
    follow = ends[starts]
    seen = follow < size
    is_followed = (ends[follow[seen]] > 0) | (window[follow[seen]] == ord(EVENT))
    ends[starts[seen][~is_followed]] = 0
    return ends, decoded


def _event_end(content: bytes, at: int, header: Header) -> int:
    """Where an event ends; 0 if it is none that is known here."""
    if content.startswith(LOG_END, at + 1):
        return at + 1 + len(LOG_END)
    data = content[at + 1 : min(at + 40, header.stop)]
    layout = EVENTS.get(data[0] if data else -1, "")
    if data[:1] == bytes([ADJUSTMENT]):  # by a number with four bytes, or of variable length
        layout = "bbbbb" if data[1:2] > b"\x7f" else "bv"
    length = 1
    for letter in layout:
        while letter == "v" and data[length : length + 1] > b"\x7f":
            length += 1
        length += 1
    end = at + 1 + length
    is_followed = end == header.stop or content[end : end + 1].decode("latin-1") in {
        *header.kinds,
        EVENT,
    }
    return end if layout and length <= len(data) and is_followed else 0


class Samples(NamedTuple):
    """The values of the frames of a log."""

    times: Float[np.ndarray, " frames"]  # s
    main: Rows
    others: dict[str, tuple[Float[np.ndarray, " frames"], Rows]]  # with their times
    damage: list[str]  # in words


def _make_samples(path: Path, header: Header, frames: Frames) -> Samples:
    """Add what is predicted, and leave out frames whose times cannot be.

    An intraframe and the interframes up to the next one are a group.
    """
    begins = np.flatnonzero(frames.is_intra)
    if not len(begins):
        raise LogError(path, "must have frames, but has none", f"byte {header.end}")
    # Interframes before the first intraframe cannot be decoded.
    main, places = frames.main[begins[0] :], frames.places[begins[0] :]
    begins = begins - begins[0]
    lengths = np.diff(np.append(begins, len(main)))
    group = np.repeat(np.arange(len(begins)), lengths)
    first = begins[group]
    _add_predictions(header, main, begins, lengths)

    clock = main[:, header.time].astype(int)
    interval = np.diff(clock, prepend=clock[:1]) % WRAP
    interval[begins] = 0
    is_late = np.cumsum(interval > LONGEST_INTERVAL)
    elapsed = np.cumsum(np.minimum(interval, LONGEST_INTERVAL))
    starts, is_kept = _order_groups(clock[begins], main[begins, header.iteration])
    ends = np.full(len(starts), np.iinfo(int).max)
    ends[np.flatnonzero(is_kept)[:-1]] = starts[is_kept][1:]
    times = starts[group] + elapsed - elapsed[first]
    kept = is_kept[group] & (is_late == is_late[first]) & (times <= ends[group])

    left, size = len(main) - int(np.sum(kept)), frames.end - header.end
    if 2 * left > len(main) or 2 * frames.lost > size:
        words = f"is damaged: of {size} bytes {frames.lost} are no frames, and of {len(main)} "
        raise LogError(path, f"{words}frames {left} have times that cannot be")
    times, main, places = times[kept], main[kept], places[kept]
    seconds = (times - times[0]) / 1e6
    others = {
        kind: _make_others(header, frames, kind, seconds, places)
        for kind in (SLOW, GPS)
        if kind in frames.others
    }
    return Samples(seconds, main, others, [*header.damage, *_losses(header, frames, left)])


def _add_predictions(header: Header, main: Rows, begins: Places, lengths: Places) -> None:
    intra, inter = header.kinds[INTRA], header.kinds[INTER]
    names = intra.names
    lowest = np.where(intra.is_signed, -WRAP / 2, 0.0)

    def complete(rows: Rows, predictors: list[int]) -> Rows:
        rows = rows + [header.references.get(predictor, 0.0) for predictor in predictors]
        rows = _wrap(rows, lowest)
        others = np.equal(predictors, FIRST_MOTOR)
        if np.any(others):
            rows[:, others] += rows[:, [names.index("motor[0]")]]
        return _wrap(rows, lowest)

    main[begins] = complete(main[begins], intra.predictors)
    weights = np.array([WEIGHTS.get(predictor, (0, 0)) for predictor in inter.predictors]).T
    # Frames beyond the longest group keep times that cannot be.
    for k in range(1, min(max(lengths), LONGEST_GROUP)):
        first = begins[lengths > k]
        row = first + k
        before = main[np.maximum(row - 2, first)]
        predicted = np.trunc(weights[0] * main[row - 1] + weights[1] * before)
        main[row] = complete(main[row] + predicted, inter.predictors)


def _wrap(rows: Rows, lowest: Float[np.ndarray, " fields"]) -> Rows:
    """The numbers in 32 bits, of which the lowest is that of a signed or an unsigned one."""
    is_outside = (rows < lowest) | (rows >= lowest + WRAP)
    return np.where(is_outside, (rows - lowest) % WRAP + lowest, rows) if is_outside.any() else rows


def _order_groups(
    clock: Int[np.ndarray, " groups"], loop: Float[np.ndarray, " groups"]
) -> tuple[Int[np.ndarray, " groups"], Bool[np.ndarray, " groups"]]:
    """When groups begin, us, without the wraps of the clock; and which belong to the log.

    The clock and the number of the main loop advance together, also while logging is paused; in
    bytes that only look like an intraframe they do not.
    """
    starts, kept = clock.copy(), np.ones(len(clock), bool)
    passed, loops = np.diff(clock), np.diff(loop)
    if not np.any(loops > 0):
        kept[1:] = False
        return starts, kept
    period = float(np.median((passed % WRAP / np.where(loops > 0, loops, np.nan))[loops > 0]))

    def follows(passed: Any, loops: Any) -> Any:
        expected = period * loops
        error = (passed - expected + WRAP / 2) % WRAP - WRAP / 2
        tolerance = SLACK + DRIFT * expected
        return (loops > 0) & (abs(error) <= tolerance) & (error >= -expected)

    is_next = follows(passed, loops)
    if not np.all(is_next):  # take the longest run, and what fits to it before and after
        bounds = np.concatenate([[-1], np.flatnonzero(~is_next), [len(is_next)]])
        start = int(bounds[np.argmax(np.diff(bounds))]) + 1
        kept[:] = np.arange(len(kept)) == start
        for later in (range(start + 1, len(kept)), range(start - 1, -1, -1)):
            last = start
            for i in later:
                one, two = sorted((last, i))
                if follows(clock[two] - clock[one], loop[two] - loop[one]):
                    kept[i], last = True, i
    passed, loops = np.diff(clock[kept]), np.diff(loop[kept])
    passed += np.round((period * loops - passed) / WRAP).astype(int) * WRAP
    starts[kept] = clock[kept][0] + np.append(0, np.cumsum(passed))
    return starts, kept


def _make_others(
    header: Header, frames: Frames, kind: str, seconds: Float[np.ndarray, " main"], places: Places
) -> tuple[Float[np.ndarray, " frames"], Rows]:
    """Times and values of frames that are not main frames; they follow a main frame."""
    rows, at = frames.others[kind]
    times = seconds[np.maximum(np.searchsorted(places, at) - 1, 0)]
    homes, home_at = frames.others.get(HOME, (np.zeros((0, 0)), np.zeros(0, int)))
    home = np.searchsorted(home_at, at) - 1  # the last one before
    coordinate = 0
    for column, predictor in enumerate(header.kinds[kind].predictors):
        if predictor == MAIN_TIME:
            delay = rows[:, column]
            times = times + np.where(delay < LONGEST_INTERVAL, delay, 0) / 1e6
        elif predictor == HOME_POSITION:
            origin = np.full(len(rows), np.nan)
            if coordinate < homes.shape[1]:
                origin[home >= 0] = homes[home[home >= 0], coordinate]
            rows[:, column] += origin
            coordinate += 1
    return times, rows


def _losses(header: Header, frames: Frames, left: int) -> Iterator[str]:
    breaks = [place for place in frames.breaks if place < frames.end]
    if breaks:
        yield (
            f"The log is damaged in {len(breaks)} places, the first at byte {breaks[0]}: "
            f"{frames.lost} bytes up to the next intraframes were left out."
        )
    if left:
        yield f"{left} frames were left out, as their times cannot be."
    if not frames.is_ended:
        rest = header.stop - frames.end
        after = f", and {rest} bytes that are no frames follow" if rest else ""
        yield f"The log stops at byte {frames.end} without the event that ends it{after}."


def _make_log(
    path: Path, header: Header, samples: Samples, motor_poles: int | None, words: list[str]
) -> Log:
    lines = header.lines
    factors = _factors(lines)
    if any(name.startswith("eRPM[") for name in header.kinds[INTRA].names):
        motor_poles = motor_poles or int(_number(lines, "motor_poles", MOTOR_POLES) or 0)
        if not motor_poles:
            problem = "must have the number of poles of a motor, but the file does not tell: say it"
            problem += " by `motor_poles=` or `--read motor_poles=`"
            raise LogError(path, problem, "signal `motor_speed`")
        factors["eRPM"] = 200 / motor_poles
    is_betaflight = lines.get("Firmware type") == "Betaflight"
    is_betaflight |= lines.get("Firmware revision", "").startswith("Betaflight")
    axes = {"frame": "FLU"} if is_betaflight else {}
    tables = [(header.kinds[INTRA].names, samples.times, samples.main)]
    tables += [(header.kinds[kind].names, *table) for kind, table in samples.others.items()]
    signals = {
        signal.name: signal
        for names, times, rows in tables
        for signal in _signals(names, times, rows, factors, axes)
    }
    start = _start(lines.get("Log start datetime", ""))
    words = [*words, *samples.damage, *_remarks(signals, lines, motor_poles, is_betaflight)]
    armed = _armed(signals, samples.times)
    if armed:
        words.append("The vehicle is taken to be armed while the switch to arm was on.")
    if start:
        words.append("The date is that of the header, which is written shortly before frame one.")
    return Log(
        path=str(path),
        kind=KIND,
        signals=signals,
        start=start,
        facts={name: lines[name] for name in lines if not name.startswith(("Field ", "Product"))},
        armed=armed,
        assumed=tuple(words),
    )


def _number(lines: Mapping[str, str], name: str, allowed: tuple[float, float]) -> float | None:
    """A number of the header in a range; None if there is none."""
    text = lines.get(name, "")
    try:
        # Hexadecimal digits are the bits of a number of single precision.
        number = struct.unpack(">f", bytes.fromhex(text[2:]))[0] if "0x" in text else float(text)
    except (ValueError, struct.error):
        return None
    return number if allowed[0] <= number <= allowed[1] else None


def _factors(lines: Mapping[str, str]) -> dict[str, float]:
    """What the numbers of fields are multiplied by."""
    factors = {"imuQuaternion": 1 / 32767, "GPS_coord": 1e-7}
    name = "gyro_scale" if "gyro_scale" in lines else "gyro.scale"
    scale = _number(lines, name, GYRO_SCALE)
    if scale and lines.get("Firmware type") in FIRMWARES:
        finer = 10 if lines.get("blackbox_high_resolution") == "1" else 1
        factors |= dict.fromkeys(GYROSCOPES, scale / finer)
    if one_g := _number(lines, "acc_1G", ONE_G):
        factors["accSmooth"] = 1 / one_g
    return factors


def _signals(
    names: list[str],
    times: Float[np.ndarray, " samples"],
    rows: Rows,
    factors: Mapping[str, float],
    axes: dict[str, Any],
) -> Iterator[Signal]:
    """A signal for each field that is a number or an array."""
    columns: dict[str, dict[str, int]] = {}
    for column, name in enumerate(names):
        element = ELEMENT.fullmatch(name)
        name, index = element.groups() if element else (name, "")
        if name not in ("loopIteration", "time"):
            columns.setdefault(name, {})[index] = column
    for name, column in columns.items() if len(rows) else ():
        described: dict[str, Any] = {}
        components, chosen = tuple(column), list(column.values())
        is_run = chosen == list(range(chosen[0], chosen[0] + len(chosen)))
        values = rows[:, slice(chosen[0], chosen[-1] + 1) if is_run else chosen]
        if name in factors:
            values = values * factors[name]
        if name in VECTORS and components == ("0", "1", "2"):
            components, described = tuple("xyz"), VECTORS[name] | axes
            if name in ("accSmooth", *GYROSCOPES) and name not in factors:
                described = described | {"unit": ""}
            elif name in GYROSCOPES and np.max(np.abs(values)) <= RANGE + LARGEST_OFFSET:
                described = described | {"limit": RANGE - LARGEST_OFFSET}
            elif name == "imuQuaternion":
                w = np.sqrt(np.maximum(0, 1 - np.sum(values**2, axis=1)))
                values, components = np.column_stack([w, values]), tuple("wxyz")
                described = described | ({"space": "NWU"} if axes else {"direction": ""})
        elif name == "GPS_coord":
            described = {"unit": "deg"}
        elif name in ("motor", "eRPM"):
            components = tuple(f"m{index}" for index in components)
            if name == "eRPM":
                name, described = "motor_speed", {"unit": "rpm", "quantity": "rotor_speed"}
        if components == ("",):
            components, values = (), values[:, 0]
        yield Signal(name, times, values, components=components, **described)


def _armed(
    signals: Mapping[str, Signal], times: Float[np.ndarray, " samples"]
) -> tuple[tuple[float, float], ...] | None:
    """When the switch to arm was on; None if it never was, as sticks can arm too."""
    modes = signals.get("flightModeFlags")
    if modes is None or modes.values.ndim > 1:
        return None
    is_on = np.concatenate([[0], modes.values.astype(int) & 1, [0]])
    if not is_on.any():
        return None
    # The first flags come after the first frame.
    bounds = np.concatenate([times[:1], modes.times[1:], times[-1:]])[np.diff(is_on) != 0].tolist()
    return tuple(zip(bounds[::2], bounds[1::2], strict=True))


def _start(text: str) -> datetime | None:
    """Date and time in UTC; None if the clock was not set."""
    try:
        start = datetime.fromisoformat(text)
        return start.astimezone(UTC) if start.tzinfo else None
    except (ValueError, OverflowError):
        return None


def _remarks(
    signals: Mapping[str, Signal],
    lines: Mapping[str, str],
    motor_poles: int | None,
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
    for name in GYROSCOPES:
        if name in signals and signals[name].unit:
            finer = ", a tenth of it" if lines.get("blackbox_high_resolution") == "1" else ""
            yield f"`{name}` is the number of the file times the scale in the header{finer}."
        elif name in signals:
            yield f"`{name}` has no unit, as the scale of this firmware is not known."
    if "gyroADC" in signals:
        yield "`gyroADC` is filtered by the flight computer, which delays it."
    if "gyroUnfilt" in signals:
        yield "`gyroUnfilt` is not filtered, but for the filter of the sensor."
    if any(np.isfinite(signals[name].limit) for name in GYROSCOPES if name in signals):
        yield (
            f"Gyroscopes are taken to read up to {RANGE:g} deg/s, less an offset of up to "
            f"{LARGEST_OFFSET:g} deg/s that the firmware takes off."
        )
    if "accSmooth" in signals:
        yield "`accSmooth` is filtered by the flight computer, which delays it."
    if "motor" in signals:
        output = f" from {lines['motorOutput']}" if "motorOutput" in lines else ""
        yield f"`motor` are commands{output}, not speeds."
    if "motor_speed" in signals:
        yield (
            f"`motor_speed` is for motors with {motor_poles} poles; it has no sign, and the last "
            "value that the speed controller sent."
        )
    if "imuQuaternion" in signals:
        yield (
            "`imuQuaternion` is what the flight computer estimates; without compass and GPS its "
            "north is the heading at power-on. Its `w` is computed of the others, and not exact "
            "near half a turn."
        )
