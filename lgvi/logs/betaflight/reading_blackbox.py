"""Blackbox logs of Betaflight and its relatives, one or several in a file."""

import re
from datetime import UTC, datetime
from pathlib import Path

from ..log import Log
from ..signal import LogError
from .blackbox_header import read_header
from .blackbox_signals import find_armed, make_signals
from .frames import WINDOW, read_frames
from .samples import WRAP, make_samples

KIND = "Betaflight blackbox"
MARK = re.compile(rb"H Product:Blackbox flight data recorder[^\n]*\n")  # a log begins with it
USEFUL = 1.0  # s: shorter logs are of attempts to take off


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
        space north, west, up; for INAV and others they are not told. The zero of the times is the
        first frame.

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
    and the axes: blackbox.c and imu.c of <https://github.com/betaflight/betaflight> and of
    <https://github.com/iNavFlight/inav>.
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
    header = read_header(path, content, *parts[number - 1])
    tables, damage = make_samples(path, header, read_frames(content, header))
    signals, remarks = make_signals(path, header.lines, tables, motor_poles)
    words += damage + remarks
    armed = find_armed(header.lines, signals, tables[0].times[-1])
    if armed:
        words.append("The vehicle is taken to be armed while the switch to arm was on.")
    start = _start(header.lines.get("Log start datetime", ""))
    if start:
        words.append("The date is that of the header, which is written shortly before frame one.")
    facts = {
        name: value
        for name, value in header.lines.items()
        if not name.startswith(("Field ", "Product"))
    }
    return Log(str(path), KIND, signals, start, facts, armed, tuple(words))


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
    raise LogError(path, f"has several logs: {shown}; say which by `log=`")


def _duration(path: Path, content: bytes, part: tuple[int, int]) -> float:
    """About how long a log lasts, s, by its first and last frames; 0 if it cannot be read."""
    try:
        header = read_header(path, content, *part)
    except LogError:
        return 0.0
    begin, end = header.end, max(header.end, header.stop - WINDOW)
    first = read_frames(content, header._replace(stop=min(begin + WINDOW, header.stop)))
    last = read_frames(content, header._replace(end=end))
    times = [frames.main[frames.is_intra, header.column("time")] for frames in (first, last)]
    return float((times[1][-1] - times[0][0]) % WRAP / 1e6) if all(map(len, times)) else 0.0


def _start(text: str) -> datetime | None:
    """Date and time in UTC; None if the clock was not set."""
    try:
        start = datetime.fromisoformat(text)
        return start.astimezone(UTC) if start.tzinfo else None
    except (ValueError, OverflowError):
        return None
