"""Logs of PX4: ULog."""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from io import BytesIO, StringIO
from pathlib import Path
from statistics import median_low
from string import ascii_uppercase
from struct import Struct
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .log import Log
from .signal import LogError, Signal, foreign_reader

KIND = "PX4 ULog"

MAGIC = b"ULog\x01\x12\x35"
HEADER = Struct("<7sBQ")  # magic, version, time when logging began
MESSAGE = Struct("<HB")  # size, kind
SUBSCRIPTION = Struct("<BH")  # instance of the topic, number that stands for it
FLAGS = Struct("<8s8s3Q")  # compatible, incompatible, where appended data begin
APPENDED = b"\x01" + bytes(7)  # the only incompatible flag that is known
SYNC = bytes.fromhex("2f731320250cbb12")
KINDS = ascii_uppercase.encode()  # readers pass over those that are not known
FORMAT, INFORMATION, PARAMETER, SUBSCRIBE, DATA, FLAG, DROPOUT = b"FIPADBO"
LEAST_DATA = 2 + 8  # bytes: number of the topic, time
LARGEST = 65535  # bytes of a message, by its header
TIME = "uint64_t", 0, "timestamp"

EARLIEST, LATEST = 9.4e14, 4.1e15  # microseconds since 1970: the years 2000 and 2100
DAY = 86_400_000_000  # microseconds
NO_READING = 2**31 - 1  # instead of a time of the accelerometer
ARMED = 2  # vehicle_status.arming_state
MOTORS = range(101, 113)  # esc_report.actuator_function of the first and following motors
SPACES = {1: "NED", 2: "FRD with unknown heading"}  # vehicle_odometry.pose_frame
# Parameters that turn the board in the vehicle.
TURNS = "SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF", "SENS_BOARD_Z_OFF"
ON_BOARD = "sensor_gyro", "sensor_accel", "sensor_mag"
ODOMETRY = "vehicle_odometry", "vehicle_visual_odometry", "vehicle_mocap_odometry"
# Of commands, the time of the sample is that of the measurement to which they answer.
COMMANDS = "actuator_", "vehicle_torque_setpoint", "vehicle_thrust_setpoint"
ESTIMATES = "vehicle_attitude", "vehicle_local_position", "vehicle_odometry"

RATE = {"unit": "rad/s", "quantity": "angular_velocity"}
FORCE = {"unit": "m/s²", "quantity": "specific_force"}
FIELD = {"unit": "G", "quantity": "magnetic_field"}
POSITION = {"unit": "m", "quantity": "position"}
ROTATION = {"unit": "1", "quantity": "attitude"}
BODY, SPACE = {"frame": "FRD"}, {"space": "NED"}
ATTITUDE = ROTATION | BODY | {"order": "wxyz", "direction": "body to space"}
# What the definitions of the messages say of a field.
DOCUMENTED: dict[str, dict[str, Any]] = {
    "vehicle_angular_velocity.xyz": RATE | BODY,
    "vehicle_angular_velocity.xyz_derivative": {"unit": "rad/s²"} | BODY,
    "vehicle_angular_velocity_groundtruth.xyz": RATE | BODY,
    "vehicle_acceleration.xyz": FORCE | BODY,
    "vehicle_magnetometer.magnetometer_ga": FIELD | BODY,
    "sensor_combined.gyro_rad": RATE | BODY,
    "sensor_combined.accelerometer_m_s2": FORCE | BODY,
    "sensor_gyro.xyz": RATE,
    "sensor_accel.xyz": FORCE,
    "sensor_mag.xyz": FIELD,
    "vehicle_attitude.q": ATTITUDE | SPACE,
    "vehicle_attitude_groundtruth.q": ATTITUDE | SPACE,
    "vehicle_local_position.xyz": POSITION | SPACE,
    "vehicle_local_position_groundtruth.xyz": POSITION | SPACE,
    **{f"{topic}.position": POSITION for topic in ODOMETRY},
    **{f"{topic}.q": ATTITUDE for topic in ODOMETRY},
    **{f"{topic}.angular_velocity": RATE | BODY for topic in ODOMETRY},
    "esc_status.esc_rpm": {"unit": "rpm", "quantity": "rotor_speed"},
    "actuator_motors.control": {"unit": "1"},
}


def read(path: Path) -> Log:
    """Read a log of PX4: the numbers of all topics.

    A signal has the name of its topic and field, such as `vehicle_angular_velocity.xyz`. The
    number of the instance follows the topic where a topic has several, or one that is not the
    first, as in `sensor_gyro[1].xyz`. An array is one signal; so are three fields `x`, `y` and `z`,
    as `xyz`, and the speeds of all motors, as `esc_status.esc_rpm`. These are in the order of the
    motors, with components such as `motor1`, if all speed controllers tell theirs, else in that of
    the speed controllers, such as `esc0`.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Log
        Units, quantities and axes of sensors, attitude, position and motors are those of the
        definitions of the messages: the axes of the body are forward, right, down, those of space
        north, east, down. Times are `timestamp_sample` where a topic has it, else `timestamp`, as
        for commands; the zero is when logging began.

    Raises
    ------
    LogError
        If the file is no ULog, or most of it cannot be read.
    ImportError
        Without the package pyulog.

    References
    ----------
    The format: <https://docs.px4.io/main/en/dev_log/ulog_file_format>; the messages:
    <https://docs.px4.io/main/en/msg_docs/>.
    """
    try:
        from pyulog import ULog
    except ImportError as error:
        raise ImportError('Logs of PX4 need pyulog: pip install "lgvi[logs]"') from error

    messages = _sort_messages(path, path.read_bytes())
    with foreign_reader(path, KIND), redirect_stdout(StringIO()):
        head = BytesIO(b"".join([messages.header, *messages.formats.values()]))
        formats = ULog(head, parse_header_only=True).message_formats
        sizes = _sizes(formats, ULog.get_field_size)
        fitting = [messages.formats[name] for name in formats if sizes[name] <= LARGEST]
        timed = [name for name in formats if TIME in formats[name].fields]
        body = b"".join([messages.header, *fitting, *messages.definitions, *messages.data])
        ulog = ULog(BytesIO(body), message_name_filter_list=timed)
        topics = {_topic_name(data, ulog.data_list): data for data in ulog.data_list}
        count = sum(len(data.data["timestamp"]) for data in topics.values())
        if count <= messages.count // 2:
            raise LogError(path, f"of {messages.count} messages with data only {count} can be read")
        assumed = messages.damage
        if count < messages.count:
            assumed.append(
                f"{messages.count - count} of {messages.count} messages were left out: their topic "
                "is not known or has no time, or they have a wrong size."
            )
        zero = _zero(ulog.start_timestamp, topics)
        parameters = ulog.initial_parameters
        facts = {
            **ulog.msg_info_dict,
            **{f"parameter {key}": parameters[key] for key in parameters},
        }
        signals = {
            signal.name: signal
            for name, data in topics.items()
            for signal in _signals(name, data, zero, parameters)
        }
    return Log(
        path=str(path),
        kind=KIND,
        signals=signals,
        start=_start(topics, zero),
        facts={key: str(value) for key, value in facts.items() if not isinstance(value, bytes)},
        armed=_armed(topics, zero, ulog.last_timestamp),
        assumed=(*assumed, *_remarks(signals, topics)),
    )


@dataclass
class Messages:
    """The messages of a file that are whole."""

    header: bytes
    formats: dict[str, bytes] = field(default_factory=dict)
    definitions: list[bytes] = field(default_factory=list)  # information, first parameters
    data: list[bytes] = field(default_factory=list)  # topics and their data
    count: int = 0  # of messages with data
    damage: list[str] = field(default_factory=list)  # in words


def _sort_messages(path: Path, content: bytes) -> Messages:
    """The messages that matter, without those that would mislead the package that reads them.

    It trusts sizes, takes long over damaged parts, and stops at the first message that is too short
    for its kind.
    """
    if len(content) < HEADER.size or not content.startswith(MAGIC):
        raise LogError(path, "must begin with the header of a ULog, but does not", "byte 0")
    messages = Messages(content[: HEADER.size])
    topics: dict[int, bytes] = {}
    lost = dropouts = dropped = 0
    for begin, end, kind in _messages(content, _parts(path, content)):
        payload = content[begin + MESSAGE.size : end]
        if kind is None:
            lost += end - begin
            what = "ends in the middle of a message" if end == len(content) else "is damaged"
            words = f"The file {what} at byte {begin}: {end - begin} bytes were lost."
            messages.damage.append(words)
        elif kind == FORMAT:
            name = payload.decode(errors="ignore").partition(":")[0]
            messages.formats[name] = content[begin:end]
        elif kind == INFORMATION or (kind == PARAMETER and not topics):
            messages.definitions.append(content[begin:end])
        elif kind == DROPOUT and len(payload) == 2:
            dropouts, dropped = dropouts + 1, dropped + int.from_bytes(payload, "little")
        elif kind == DATA and len(payload) > LEAST_DATA:
            messages.count += 1
            messages.data.append(content[begin:end])
        elif kind == SUBSCRIBE and len(payload) > SUBSCRIPTION.size:
            _, number = SUBSCRIPTION.unpack_from(payload)
            if topics.setdefault(number, payload) == payload:
                messages.data.append(content[begin:end])
            else:
                words = f"The number {number} stands for two topics: the first was taken."
                messages.damage.append(words)
    if lost > len(content) // 2:
        raise LogError(path, f"is damaged: of {len(content)} bytes {lost} are no messages")
    if dropouts:
        words = f"The logger was too slow {dropouts} times, for {dropped / 1000:.3g} s in all: "
        messages.damage.append(words + "messages of these times are missing.")
    return messages


def _parts(path: Path, content: bytes) -> list[tuple[int, int]]:
    """Begin and end of what was written at once: data may be appended to a cut file."""
    begin, size = HEADER.size, len(content)
    bounds = [begin]
    if size >= begin + MESSAGE.size + FLAGS.size:
        length, kind = MESSAGE.unpack_from(content, begin)
        if kind == FLAG and length >= FLAGS.size:
            _, flags, *offsets = FLAGS.unpack_from(content, begin + MESSAGE.size)
            if any(flag & ~known for flag, known in zip(flags, APPENDED, strict=True)):
                words = "must be a ULog of version 1, but has features that are not known here"
                raise LogError(path, words, f"byte {begin + MESSAGE.size + 8}")
            if flags == APPENDED:
                bounds += [offset for offset in offsets if bounds[-1] < offset < size]
    return list(zip(bounds, [*bounds[1:], size], strict=True))


def _messages(
    content: bytes, parts: list[tuple[int, int]]
) -> Iterator[tuple[int, int, int | None]]:
    """Begin, end and kind of each message; the kind None is for bytes that are no message.

    Bytes that are no message end at the next mark for synchronisation.
    """
    for begin, stop in parts:
        while begin < stop:
            if begin + MESSAGE.size <= stop:
                size, kind = MESSAGE.unpack_from(content, begin)
                end = begin + MESSAGE.size + size
                if kind in KINDS and size and end <= stop:
                    yield begin, end, kind
                    begin = end
                    continue
            mark = content.find(SYNC, begin, stop)
            end = stop if mark < 0 else mark + len(SYNC)
            yield begin, end, None
            begin = end


def _sizes(formats: Mapping[str, Any], size_of: Callable[[str], int]) -> dict[str, float]:
    """The size of each format, bytes; infinite where it cannot be."""
    sizes: dict[str, float] = {}

    def size(kind: str) -> float:
        if kind not in formats:
            try:
                return size_of(kind)
            except KeyError:
                return np.inf
        if kind not in sizes:
            sizes[kind] = np.inf  # of a format that contains itself
            fields = formats[kind].fields
            sizes[kind] = sum(size(inner) * max(count, 1) for inner, count, _ in fields)
        return sizes[kind]

    return {name: size(name) for name in formats}


def _topic_name(data: Any, topics: list[Any]) -> str:
    """The topic, with the number of the instance if it is not the only and first one."""
    several = sum(other.name == data.name for other in topics) > 1
    return f"{data.name}[{data.multi_id}]" if several or data.multi_id else data.name


def _zero(began: int, topics: Mapping[str, Any]) -> int:
    """When logging began, us; or the first time, if the header is damaged."""
    first = median_low(int(data.data["timestamp"][0]) for data in topics.values())
    return began if abs(began - first) < DAY else first


def _seconds(times: Int[np.ndarray, " samples"], zero: int) -> Float[np.ndarray, " samples"]:
    """Times since the zero, s, from times since the start of the computer, us."""
    return (times.astype(np.uint64) - np.uint64(zero)).astype(np.int64) / 1e6


def _signals(topic: str, data: Any, zero: int, parameters: Mapping[str, Any]) -> Iterator[Signal]:
    """The signals of a topic."""
    columns = {
        column.field_name: data.data[column.field_name]
        for column in data.field_data
        if column.type_str != "char"
        and "_padding" not in column.field_name
        and column.field_name not in ("timestamp", "timestamp_sample")
    }
    times = _seconds(data.data[_times_of(data)], zero)
    for name, names in _fields(list(columns)).items():
        described = dict(DOCUMENTED.get(f"{data.name}.{name}", {}))
        values = np.column_stack([columns[key] for key in names]).astype(float)
        moments, components = times, _components(described, len(names))
        if data.name in ON_BOARD and name == "xyz":
            turned = any(parameters.get(key) != 0 for key in TURNS)
            turned |= bool(np.any(columns.get("is_external", 0)))
            described["frame"] = "FRD of the board" if turned else "FRD"
        elif data.name in ODOMETRY and name in ("q", "position"):
            spaces = np.unique(columns.get("pose_frame", 0))
            described["space"] = SPACES.get(int(spaces[0]), "") if len(spaces) == 1 else ""
        elif name == "accelerometer_m_s2" and "accelerometer_timestamp_relative" in columns:
            relative = columns["accelerometer_timestamp_relative"]
            values[relative == NO_READING] = np.nan
            moments = times + np.where(relative == NO_READING, 0, relative) / 1e6
        elif name == "esc_rpm":
            order, components = _motors(columns, values)
            values = values[:, order]
        yield Signal(
            name=f"{topic}.{name}",
            times=moments,
            values=values[:, 0] if names == [name] else values,
            components=() if names == [name] else components,
            **described,
        )


def _times_of(data: Any) -> str:
    """The field with the times: of what is measured those of the samples, if they are set."""
    is_sampled = np.all(data.data.get("timestamp_sample", 0))
    is_command = data.name.startswith(COMMANDS)
    return "timestamp_sample" if is_sampled and not is_command else "timestamp"


def _motors(
    columns: Mapping[str, np.ndarray], speeds: Float[np.ndarray, "samples motors"]
) -> tuple[list[int], tuple[str, ...]]:
    """Numbers and names of the speed controllers there are, in the order of their motors."""
    count = max(1, int(np.max(columns.get("esc_count", speeds.shape[1]))))
    order = [i for i, speed in enumerate(speeds.T) if i < count or speed.any()]
    functions = {i: int(np.max(columns.get(f"esc[{i}].actuator_function", 0))) for i in order}
    if len(set(functions.values()).intersection(MOTORS)) < len(order):
        return order, tuple(f"esc{i}" for i in order)
    order.sort(key=functions.__getitem__)
    return order, tuple(f"motor{MOTORS.index(functions[i]) + 1}" for i in order)


def _fields(columns: list[str]) -> dict[str, list[str]]:
    """The columns of each field: one, or those of an array."""
    fields: dict[str, list[str]] = {}
    for column in columns:
        array = re.fullmatch(r"(.*)\[\d+\]", column)
        speed = re.fullmatch(r"esc\[\d+\]\.esc_rpm", column)
        fields.setdefault(array[1] if array else column, []).append(column)
        if speed:
            fields.setdefault("esc_rpm", []).append(column)
    if set("xyz") <= set(columns) and "xyz" not in fields:
        fields["xyz"] = [fields.pop(axis)[0] for axis in "xyz"]
    return fields


def _components(described: Mapping[str, str], count: int) -> tuple[str, ...]:
    """Names of the components of an array: of a documented vector its axes, else numbers."""
    axes = "wxyz" if "order" in described else "xyz"
    is_vector = "quantity" in described and count == len(axes)
    return tuple(axes) if is_vector else tuple(map(str, range(count)))


def _start(topics: Mapping[str, Any], zero: int) -> datetime | None:
    """Date and time of the zero, by satellites."""
    for data in topics.values():
        if data.name in ("vehicle_gps_position", "sensor_gps") and "time_utc_usec" in data.data:
            dated = data.data["time_utc_usec"] > 0
            offsets = data.data["time_utc_usec"][dated].astype(float)
            offsets -= data.data["timestamp"][dated]
            if len(offsets) and EARLIEST < (start := float(np.median(offsets)) + zero) < LATEST:
                return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(start))
    return None


def _armed(
    topics: Mapping[str, Any], zero: int, end: int
) -> tuple[tuple[float, float], ...] | None:
    """The intervals in which the vehicle was armed."""
    for topic, name, state in (
        ("vehicle_status", "arming_state", ARMED),
        ("actuator_armed", "armed", 1),
    ):
        if topic in topics and name in topics[topic].data:
            data = topics[topic].data
            times = _seconds(np.append(data["timestamp"], np.uint64(end)), zero)
            armed = np.concatenate([[False], data[name] == state, [False]])
            edges = np.flatnonzero(armed[1:] != armed[:-1])
            bounds = times[edges].tolist()
            return tuple(zip(bounds[::2], bounds[1::2], strict=True))
    return None


def _remarks(signals: Mapping[str, Signal], topics: Mapping[str, Any]) -> Iterator[str]:
    """What was recognised or assumed, in words."""
    names = {data.name for data in topics.values()}
    sampled = [name for name, data in topics.items() if _times_of(data) != "timestamp"]
    if sampled:
        shown = ", ".join(sampled)
        yield f"Times are those of the samples (`timestamp_sample`) for the topics {shown}."
    back = {
        name.partition(".")[0]
        for name, signal in signals.items()
        if np.any(np.diff(signal.times) < 0)
    }
    if back:
        shown = ", ".join(sorted(back))
        yield f"Times go back in the topics {shown}; the order is that of the file."
    for name in sorted(names.intersection(ESTIMATES)):
        yield f"`{name}` is what the filter of the flight computer estimates, not a measurement."
    if "vehicle_angular_velocity" in names:
        yield (
            "`vehicle_angular_velocity` is filtered by the flight computer (parameters "
            "IMU_GYRO_CUTOFF and others), which delays it; the bias that is estimated is taken off."
        )
    for name, signal in signals.items():
        if signal.frame == "FRD of the board":
            yield (
                f"`{name}` is in the axes of the board or of an external sensor, as the parameters "
                "SENS_BOARD_* do not say that these are the axes of the vehicle."
            )
    if "actuator_motors" in names:
        yield (
            "`actuator_motors.control` is a thrust of which 1 is the largest, and NaN is a stopped "
            "motor. Its square root is about proportional to the speed of the rotor as far as the "
            "parameter THR_MDL_FAC fits the rotors."
        )
    if "esc_status.esc_rpm" in signals:
        yield "`esc_status.esc_rpm` has the times of the message, as its readings may be older."
