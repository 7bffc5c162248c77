"""Bags of ROS 1 and ROS 2."""

import bz2
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from importlib import import_module
from itertools import islice
from keyword import iskeyword
from operator import attrgetter
from pathlib import Path
from string import ascii_lowercase
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .log import Log
from .signal import LogError, Signal, foreign_reader

KIND = "ROS bag"

ENDINGS = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
MCAP_HEAD, MCAP_RECORD = 8, Struct("<BQ")  # bytes; kind and size
MCAP_CHUNK, CHUNK_HEAD = 6, Struct("<QQQII")  # kind; times, sizes, check, length of a name

LARGEST_CHUNK = 2**28  # bytes of compressed data, when they are not
MOST_EXPANSION = 100  # times that a bag may grow
MOST_MESSAGES = 10_000_000
MOST_COMPONENTS = 100
MOST_ELEMENTS = 1000  # of an array of messages or texts
LARGEST_MESSAGE = 1_000_000  # bytes of fields of fixed size
SECOND = 10**9  # ns
DAY = 86_400 * SECOND
EARLIEST = 946_684_800 * SECOND  # the year 2000: earlier times are no dates
WRITTEN = "time of writing"

HEADER = "std_msgs/msg/Header"
NO_SIGNALS = HEADER, "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
IMU, FIELD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField"
JOINTS, ODOMETRY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"
TEXTS = "string", "wstring", "wchar"
BYTES = "uint8", "byte", "char", "octet"
EMPTY = "structure_needs_at_least_one_member"  # the field of a message without fields
VECTORS = ("x", "y"), ("x", "y", "z"), ("x", "y", "z", "w")
# Which axes matter for a quantity.
AXES = {
    "attitude": ("frame", "space"),
    "position": ("space",),
    "angular_velocity": ("frame",),
    "specific_force": ("frame",),
    "magnetic_field": ("frame",),
}
# Axes by what is in the name of a frame.
OPTICAL = {"optical": "RDF"}  # right, down, forward
BODY_AXES = {**OPTICAL, "_frd": "FRD", "_ned": "FRD", "": "FLU"}
SPACE_AXES = {"_ned": "NED", "": "ENU"}  # to which an IMU refers, whose own frame is that of a body
PARENT_AXES = {**OPTICAL, "_frd": "FRD with unknown heading", **SPACE_AXES}

RATE = {"unit": "rad/s", "quantity": "angular_velocity"}
POSITION = {"unit": "m", "quantity": "position"}
ATTITUDE = {"unit": "1", "quantity": "attitude", "order": "xyzw", "direction": "body to space"}
# What the definitions of the messages say of fields.
DOCUMENTED: dict[str, dict[str, dict[str, Any]]] = {
    IMU: {
        "angular_velocity": RATE,
        "linear_acceleration": {"unit": "m/s²", "quantity": "specific_force"},
        "orientation": ATTITUDE,
    },
    FIELD: {"magnetic_field": {"unit": "T", "quantity": "magnetic_field"}},
    TRANSFORM: {"transform.translation": POSITION, "transform.rotation": ATTITUDE},
    "geometry_msgs/msg/PoseStamped": {"pose.position": POSITION, "pose.orientation": ATTITUDE},
    "geometry_msgs/msg/PoseWithCovarianceStamped": {
        "pose.pose.position": POSITION,
        "pose.pose.orientation": ATTITUDE,
    },
    "geometry_msgs/msg/QuaternionStamped": {"quaternion": ATTITUDE},
    "geometry_msgs/msg/TwistStamped": {
        "twist.angular": {"unit": "rad/s"},
        "twist.linear": {"unit": "m/s"},
    },
    ODOMETRY: {
        "pose.pose.position": POSITION,
        "pose.pose.orientation": ATTITUDE,
        "twist.twist.angular": RATE,
        "twist.twist.linear": {"unit": "m/s"},
    },
    JOINTS: {
        "position": {"unit": "rad"},
        "velocity": {"unit": "rad/s"},
        "effort": {"unit": "N m"},
    },
}
# Fields that tell how others are to be taken.
NEEDED = {
    TRANSFORM: ("child_frame_id",),
    ODOMETRY: ("child_frame_id",),
    JOINTS: ("name",),
    IMU: tuple(f"{name}_covariance" for name in DOCUMENTED[IMU]),
}


def read(path: Path) -> Log:
    """Read a bag of ROS 1 (`.bag`) or ROS 2 (a folder, `.mcap` or `.db3`).

    A signal has the name of its topic and field, such as `/imu.angular_velocity`; vectors and
    quaternions are one signal. Of a topic of transforms, each child is a topic, as in
    `/tf[base_link].transform.rotation`. Topics of bytes, such as images, are not read.

    Parameters
    ----------
    path
        The file or folder.

    Returns
    -------
    Log
        Units and quantities are those of the definitions of `sensor_msgs`, `geometry_msgs` and
        `nav_msgs`. By REP 103, axes of bodies are forward, left, up, and those of space east,
        north, up, except where the name of a frame tells otherwise. Quaternions are x, y, z, w.
        Times are those in the header of a message; of a message without one, the time of writing,
        which is a clock of its own.

    Raises
    ------
    LogError
        If the bag cannot be read, or most of it is damaged.
    ImportError
        Without the package rosbags.

    References
    ----------
    REP 103: <https://www.ros.org/reps/rep-0103.html>, REP 145:
    <https://www.ros.org/reps/rep-0145.html>. Formats: <http://wiki.ros.org/Bags/Format/2.0>,
    <https://mcap.dev/spec>.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError('Bags need rosbags: pip install "lgvi[logs]"') from error

    assumed: list[str] = []
    with foreign_reader(path, KIND):
        _check_files(path)
        default = get_typestore(Stores.LATEST)
        with AnyReader([path], default_typestore=default) as bag:
            _limit_memory(path, bag)
            topics, left_out = _topics(bag)
            if not any(connection.msgdef.data for connection in bag.connections):
                assumed.append(
                    "The bag does not define its messages: the definitions of the newest ROS 2 "
                    "that the package rosbags knows were taken."
                )
            assumed += _read_messages(path, bag, topics)
        recorded = [topic for topic in topics.values() if topic.rows]
        if not recorded:
            others = ", ".join(f"{name} ({why})" for name, why in left_out.items())
            others = others or "no messages"
            raise LogError(path, f"must have messages with numbers, but has {others}")
        zero = min(min(topic.written) for topic in recorded) // SECOND * SECOND
        offsets = [0]  # from the clock of the computer to those of the headers
        signals = {
            signal.name: signal
            for topic in recorded
            for signal in _signals(topic, zero, offsets, assumed)
        }
    if not signals:
        raise LogError(path, f"must have signals of numbers, but has none: {' '.join(assumed)}")
    is_date = zero > EARLIEST
    start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=zero // SECOND)
    facts = {f"not read: {name}": why for name, why in left_out.items()}
    return Log(str(path), KIND, signals, start if is_date else None, facts, None, tuple(assumed))


def _check_files(path: Path) -> None:
    """Refuse a file that the package would take for another kind, and files that would explode."""
    if path.is_dir():
        for file in sorted(path.glob("*.zstd")):
            with _zstd().open(file, "rb") as content:
                _require_expansion(file, iter(lambda: len(content.read(2**20)), 0))
        return
    with open(path, "rb") as file:
        head = file.read(16)
    for magic, ending in ENDINGS.items():
        if head.startswith(magic) != (path.suffix == ending):
            words = f"must have a name that ends with {ending} if it begins with {magic!r}"
            raise LogError(path, f"{words}, and only then")


def _limit_memory(path: Path, bag: Any) -> None:
    """Refuse compressed parts that would fill the memory: the package expands them at once."""
    bag.typestore.max_sequence_length = LARGEST_MESSAGE
    for reader in bag.readers:
        if path.suffix == ".bag":
            for position, chunk in reader.chunks.items():
                reader.chunks[position] = chunk._replace(decompressor=_expanded)
            return
        if reader.compression_mode == "message":
            for storage in reader.storage.storages:
                messages = storage.messages(storage.connections)
                sizes = (len(_expanded(data)) for _, _, data in messages)
                _require_expansion(storage.path, sizes)
        for file in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
            if file.suffix == ".mcap":
                sizes = (len(_expanded(data)) for data in _chunks_of_mcap(file))
                _require_expansion(file, sizes)


def _chunks_of_mcap(path: Path) -> Iterator[bytes]:
    """The content of each chunk, as it is in the file."""
    position, size = MCAP_HEAD, path.stat().st_size
    with open(path, "rb") as file:
        while position + MCAP_RECORD.size <= size:
            file.seek(position)
            kind, length = MCAP_RECORD.unpack(file.read(MCAP_RECORD.size))
            position += MCAP_RECORD.size + length
            if kind == MCAP_CHUNK and position <= size:
                chunk = file.read(length)
                name = CHUNK_HEAD.unpack_from(chunk)[-1]
                yield chunk[CHUNK_HEAD.size + name + 8 :]


def _zstd() -> Any:
    """The module for Zstandard: it is part of Python from 3.14."""
    try:
        return import_module("compression.zstd")
    except ImportError:
        return import_module("backports.zstd")


def _expanded(data: bytes) -> bytes:
    """Data that may be compressed, by what they begin with, as they were before.

    Raises
    ------
    ValueError
        If they are cut off or more than 256 MiB.
    """
    from lz4.frame import LZ4FrameDecompressor

    kinds: dict[bytes, Callable[[], Any]] = {
        b"BZh": bz2.BZ2Decompressor,
        b"\x04\x22\x4d\x18": LZ4FrameDecompressor,
        b"\x28\xb5\x2f\xfd": lambda: _zstd().ZstdDecompressor(),
    }
    parts: list[bytes] = []
    room = LARGEST_CHUNK
    while data:
        kind = next((kind for magic, kind in kinds.items() if data.startswith(magic)), None)
        if kind is None:  # not compressed
            parts.append(data)
            break
        expander = kind()
        parts.append(expander.decompress(data, max_length=room + 1))
        room -= len(parts[-1])
        if room < 0:
            raise ValueError(f"compressed data grow to more than {LARGEST_CHUNK} bytes")
        if not expander.eof:
            raise ValueError("compressed data are cut off")
        data = expander.unused_data or b""
    return b"".join(parts)


def _require_expansion(file: Path, sizes: Iterable[int]) -> None:
    """Refuse a file that grows too much."""
    most = MOST_EXPANSION * file.stat().st_size + LARGEST_CHUNK
    total = 0
    for size in sizes:
        total += size
        if total > most:
            raise ValueError(f"{file.name} grows to more than {MOST_EXPANSION} times its size")


class Part(NamedTuple):
    """A field, or a vector of fields, that becomes a signal."""

    name: str
    paths: tuple[str, ...]  # from the message; none to messages in an array, which are not read
    components: tuple[str, ...] = ()
    is_array: bool = False


@dataclass
class Topic:
    """A topic, and what was read of its messages."""

    name: str
    kind: str  # of its messages
    parts: list[Part]  # what becomes signals
    others: list[str]  # paths of what else is needed: times, names of frames, covariances
    rows: list[tuple[Any, ...]] = field(default_factory=list)  # values of each message
    written: list[int] = field(default_factory=list)  # times of writing, ns

    def __post_init__(self):
        self.paths = [*self.others, *(path for part in self.parts for path in part.paths)]
        self.values = attrgetter(*self.paths, "__class__")  # a tuple, of one path too

    def add(self, message: Any, written: int) -> None:
        """Take the values of a message."""
        self.rows.append(self.values(message))
        self.written.append(written)


def _topics(bag: Any) -> tuple[dict[str, Topic], dict[str, str]]:
    """The topics that become signals, and why others do not."""
    definitions = bag.typestore.fielddefs
    topics: dict[str, Topic] = {}
    left_out: dict[str, str] = {}
    for connection in bag.connections:
        name, kind = connection.topic, connection.msgtype
        if name in topics and topics[name].kind == kind:
            continue
        element = TRANSFORM if kind in TRANSFORMS else kind
        try:
            if name in topics:
                raise UnreadError("a second kind of messages in the topic")
            _least_size(kind, definitions, {})
            parts = list(_parts(element, definitions))
            if not any(part.paths for part in parts):
                raise UnreadError("without numbers")
        except UnreadError as reason:
            left_out[name] = f"{kind}, {reason}"
            continue
        fields = dict(definitions[element][1])
        others = [path for path in NEEDED.get(element, ()) if path in fields]
        if fields.get("header", ("", ""))[1] == HEADER:
            others += ["header.stamp.sec", "header.stamp.nanosec", "header.frame_id"]
        topics[name] = Topic(name, kind, [part for part in parts if part.paths], others)
        left_out |= {
            f"{name}.{part.name}": "messages in an array" for part in parts if not part.paths
        }
    return topics, left_out


class UnreadError(Exception):
    """Why messages of a kind are not read."""


def _least_size(kind: str, definitions: Mapping[str, Any], sizes: dict[str, float]) -> float:
    """The least size of a message of a kind, bytes.

    Raises
    ------
    UnreadError
        If it holds bytes, such as an image, or may be larger in memory than in the file.
    """
    from rosbags.interfaces import Nodetype

    if kind not in definitions:
        raise UnreadError("which is not defined")
    if kind not in sizes:
        sizes[kind] = np.inf  # if it holds itself
        total = 0.0
        for name, (node, detail) in definitions[kind][1]:
            is_list = node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            (inner, value), count = detail if is_list else ((node, detail), 1)
            number = "" if inner == Nodetype.NAME else value[0]
            if not number:
                size = _least_size(value, definitions, sizes)
                if not size:
                    raise UnreadError(f"with empty messages in `{name}`")
            else:
                size = 0 if name == EMPTY else 4 if number in TEXTS else _size(number)
            if node == Nodetype.SEQUENCE:
                if number in BYTES:
                    raise UnreadError(f"with bytes in `{name}`")
                size, count = 4, 1
            elif count > MOST_ELEMENTS and (not number or number in TEXTS):
                raise UnreadError(f"with {count} elements in `{name}`")
            total += size * count
        sizes[kind] = total
    if sizes[kind] > LARGEST_MESSAGE:
        raise UnreadError(f"of more than {LARGEST_MESSAGE} bytes")
    return sizes[kind]


def _size(number: str) -> int:
    """The size of a number such as `float64`, bytes."""
    return int(number.strip(ascii_lowercase) or 8) // 8


def _parts(kind: str, definitions: Mapping[str, Any], before: str = "") -> Iterator[Part]:
    """What becomes signals of messages of a kind."""
    from rosbags.interfaces import Nodetype

    for name, (node, detail) in definitions[kind][1]:
        path = f"{before}{name}_" if iskeyword(name) else f"{before}{name}"
        if name == EMPTY or name.endswith("covariance"):
            continue
        if node == Nodetype.BASE and detail[0] not in TEXTS:
            yield Part(path, (path,))
        elif node == Nodetype.NAME and detail not in NO_SIGNALS:
            fields = definitions[detail][1]
            components = tuple(component for component, _ in fields)
            are_numbers = all(
                inner == Nodetype.BASE and number[0] not in TEXTS for _, (inner, number) in fields
            )
            if components in VECTORS and are_numbers:
                yield Part(path, tuple(f"{path}.{axis}" for axis in components), components)
            else:
                yield from _parts(detail, definitions, f"{path}.")
        elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            inner, number = detail[0]
            if inner == Nodetype.NAME:
                yield Part(path, ())
            elif number[0] not in TEXTS:
                yield Part(path, (path,), is_array=True)


def _read_messages(path: Path, bag: Any, topics: dict[str, Topic]) -> list[str]:
    """Read the messages of the topics; what is damaged, in words."""
    chosen = [
        connection
        for connection in bag.connections
        if connection.topic in topics and topics[connection.topic].kind == connection.msgtype
    ]
    expected = sum(connection.msgcount for connection in chosen)
    count, damaged, stopped = 0, 0, ""
    try:
        most = MOST_MESSAGES + 1 if chosen else 0  # without a choice the package reads all
        for connection, written, content in islice(bag.messages(chosen), most):
            try:
                message = bag.deserialize(content, connection.msgtype)
                _add_message(topics, connection.topic, message, written)
                count += 1
            except Exception:  # whatever the package raises for a damaged message
                damaged += 1
    except Exception as error:  # likewise
        stopped = " ".join(str(error).split())[:100] or type(error).__name__
    if count + damaged > MOST_MESSAGES:
        raise LogError(path, f"must have at most {MOST_MESSAGES} messages with numbers")
    if max(expected - count, damaged) > count:
        words = f"is damaged: of {expected} messages only {count} can be read"
        raise LogError(path, f"{words}{': ' * bool(stopped)}{stopped}")
    told = [f"{damaged} messages that are damaged were left out."] if damaged else []
    if stopped:
        told.append(f"The bag is damaged after {count} of {expected} messages: {stopped}.")
    return told


def _add_message(topics: dict[str, Topic], name: str, message: Any, written: int) -> None:
    """Take a message of a topic; of transforms, each as one of a topic of its child."""
    topic = topics[name]
    if topic.kind not in TRANSFORMS:
        topic.add(message, written)
        return
    for transform in message.transforms:
        child = f"{name}[{transform.child_frame_id}]"
        if child not in topics:
            topics[child] = Topic(child, TRANSFORM, topic.parts, topic.others)
        topics[child].add(transform, written)


def _signals(topic: Topic, zero: int, offsets: list[int], assumed: list[str]) -> Iterator[Signal]:
    """The signals of a topic."""
    columns = dict(zip(topic.paths, zip(*topic.rows, strict=True), strict=False))
    needed = {path: columns[path] for path in topic.others}
    if len(set(map(tuple, needed.get("name", ())))) > 1:
        assumed.append(f"`{topic.name}` was left out: its messages are of different joints.")
        return
    times, clock = _times(topic, needed, zero, offsets, assumed)
    parent, child = (needed.get(name, [""]) for name in ("header.frame_id", "child_frame_id"))
    body = parent if topic.kind in (IMU, FIELD) else child
    endings = SPACE_AXES if topic.kind == IMU else PARENT_AXES
    axes = {"frame": _axes(body, BODY_AXES), "space": _axes(parent, endings)}
    used: set[str] = set()
    for part in topic.parts:
        values = _values(topic, part, columns, assumed)
        if values is None:
            continue
        described: dict[str, Any] = dict(DOCUMENTED.get(topic.kind, {}).get(part.name, {}))
        concerned = AXES.get(described.get("quantity", ""), ())
        used.update(concerned)
        described |= {key: axes[key] for key in concerned}
        count = 0 if values.ndim == 1 else values.shape[1]
        joints = needed["name"][0] if "name" in needed else ()
        numbers = joints if len(joints) == count else map(str, range(count))
        yield Signal(
            f"{topic.name}.{part.name}",
            times,
            values,
            clock=clock,
            components=part.components or tuple(numbers),
            **described,
        )
    names = {"frame": f"the body{f' `{body[0]}`' * bool(body[0])}", "space": f"space `{parent[0]}`"}
    taken = [f"those of {names[key]} as {axes[key]}" for key in sorted(used) if axes[key]]
    if taken:
        assumed.append(f"`{topic.name}`: by REP 103, axes are taken so: {', '.join(taken)}.")
    for frames in (parent, child):
        if len(several := sorted(set(frames))) > 1:
            assumed.append(f"`{topic.name}` has several frames: {', '.join(several[:5])}.")
    if topic.kind == JOINTS:
        assumed.append(f"`{topic.name}`: joints are taken to turn, not to slide: rad, rad/s, N m.")


def _times(
    topic: Topic, columns: Mapping[str, Any], zero: int, offsets: list[int], assumed: list[str]
) -> tuple[Float[np.ndarray, " samples"], str]:
    """Times, s, and the name of their clock, whose offset is added to those known."""
    written = np.array(topic.written, np.int64)
    moments, begin, clock = written, zero, WRITTEN
    if "header.stamp.sec" in columns:
        stamps = np.array(columns["header.stamp.sec"], np.int64) * SECOND
        stamps += np.array(columns["header.stamp.nanosec"], np.int64)
        if np.all(stamps):
            moments, clock = stamps, "log"
            # In a simulation, all headers are of one other clock: their times stay comparable.
            known = int(np.median(stamps - written)) // SECOND * SECOND
            offset = min(offsets, key=lambda clock: abs(clock - known))
            if abs(offset - known) > (DAY if offset == 0 else np.ptp(written) + SECOND):
                offsets.append(offset := known)
            if offset:
                begin, clock = zero + offset, f"clock {offsets.index(offset)} of headers"
                assumed.append(
                    f"`{topic.name}`: times in the headers are not of the clock of the computer "
                    f"that wrote the bag: their zero is {begin // SECOND} s of their own clock."
                )
    if clock == WRITTEN:
        words = "times are those of writing, as not every message has one in a header"
        assumed.append(f"`{topic.name}`: {words}.")
    if np.any(np.diff(moments) < 0):
        assumed.append(f"`{topic.name}`: times go back; the order is that of writing.")
    return (moments - begin) / SECOND, clock


def _values(
    topic: Topic, part: Part, columns: Mapping[str, Any], assumed: list[str]
) -> Float[np.ndarray, "samples *components"] | None:
    """The values of a signal; None if it has none, or arrays that differ in length."""
    if part.is_array:
        lengths = {len(array) for array in columns[part.name]}
        if lengths == {0}:
            return None
        if len(lengths) > 1 or max(lengths) > MOST_COMPONENTS:
            span = f"{min(lengths)} to {max(lengths)}" if len(lengths) > 1 else f"{max(lengths)}"
            words = f"arrays of {span} numbers are no signal"
            assumed.append(f"`{topic.name}.{part.name}` was left out: {words}.")
            return None
        values = np.array(columns[part.name], float)
    else:
        values = np.array([columns[path] for path in part.paths], float).T
    if covariances := columns.get(f"{part.name}_covariance"):
        missing = np.array([covariance[0] for covariance in covariances]) == -1
        if np.all(missing):
            words = "is not measured, as its covariance begins with -1"
            assumed.append(f"`{topic.name}.{part.name}` {words}.")
            return None
        values[missing] = np.nan
    return values[:, 0] if values.shape[1] == 1 else values


def _axes(frames: Iterable[str], parts: Mapping[str, str]) -> str:
    """Axes by the names of frames; empty if these differ in them."""
    several = {
        next(axes for part, axes in parts.items() if part in frame.lower()) for frame in set(frames)
    }
    return several.pop() if len(several) == 1 else ""
