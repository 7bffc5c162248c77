"""What the documentation of products says of headers of delimited text."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from ..ulog import COMMANDS
from ..ulog import DOCUMENTED as PX4_DOCUMENTED
from .dialect import split_line
from .header import MOTIVE
from .text_table import Case, Table
from .times import is_time


def recognise_product(table: Table) -> Table:
    """The table with what the documentation of its product says, if it is recognised."""
    for case in CASES:
        if case.recognises(table):
            table.words.append(f"Recognised as {case.kind}.{case.remark}")
            return table._replace(case=case)
    return table


ATTITUDE = {"quantity": "attitude", "unit": "1", "direction": "body to space"}
POSITION = {"quantity": "position"}
GYROSCOPE = {"quantity": "angular_velocity"}
ACCELEROMETER = {"quantity": "specific_force"}
MAGNETOMETER = {"quantity": "magnetic_field"}
PHONE = {"frame": "phone"}  # x to the right, y up, z out of the screen
PHYPHOX = {  # sensors in headers, or in names of files
    "gyroscope": {"name": "Gyroscope"} | GYROSCOPE | PHONE,
    "acceleration": {"name": "Accelerometer"} | ACCELEROMETER | PHONE,
    "accelerometer": {"name": "Accelerometer"} | ACCELEROMETER | PHONE,
    "linear acceleration": {"name": "Linear Acceleration"} | PHONE,
    "linear accelerometer": {"name": "Linear Acceleration"} | PHONE,
    "magnetic field": {"name": "Magnetometer"} | MAGNETOMETER | PHONE,
    "magnetometer": {"name": "Magnetometer"} | MAGNETOMETER | PHONE,
}
PHYPHOX_METADATA = "meta/device.csv", "meta/time.csv"
PHYPHOX_COLUMN = r"(?i)(?:.*/)?(?P<name>[^/]+)[/ ](?P<component>[xyz])"


def _is_phyphox(table: Table) -> bool:
    names = [f"{table.body.text.title}/{name}" for name in table.names]
    matches = [re.fullmatch(PHYPHOX_COLUMN, name) for name in names]
    known = [match for match in matches if match and match["name"].lower() in PHYPHOX]
    time = table.columns[0]
    return len(known) > 2 and (time.name, time.unit) == ("Time", "s")


def add_phyphox_metadata(
    files: Mapping[str, bytes], facts: dict[str, str], words: list[str]
) -> datetime | None:
    """Facts of the device, and the start, from the files of phyphox beside the data."""
    start = None
    for name, content in files.items():
        header, *lines = content.decode("utf-8-sig", errors="replace").splitlines() or [""]
        first = re.match(r'"(property|event)"([,;\t])', header)
        rows = [split_line(line, first[2]) for line in lines if first]
        if first and first[1] == "property":
            facts.update({row[0]: row[1] for row in rows if len(row) == 2 and row[1]})
            continue
        try:
            events = [
                (row[0], *(float(cell.replace(",", ".")) for cell in row[1:3])) for row in rows
            ]
            _, experiment, system = next(event for event in events if event[0] == "START")
            start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=system - experiment)
            if pauses := sum(event[0] == "START" for event in events) - 1:
                words.append(f"phyphox was paused: its times leave out {pauses} pauses.")
        except (ValueError, IndexError, OverflowError, StopIteration):
            words.append(f"{name} does not tell the start.")
    return start


BLACKBOX = {
    "gyroADC": GYROSCOPE | {"unit": "raw", "components": "xyz"},
    "accSmooth": ACCELEROMETER | {"unit": "raw", "components": "xyz"},
    "magADC": {"unit": "raw", "components": "xyz"},
}
PX4_TOPICS = sorted({name.partition(".")[0] for name in PX4_DOCUMENTED}, key=len, reverse=True)
PX4_FILE = rf"(?P<prefix>|.*?_)(?P<topic>{'|'.join(PX4_TOPICS)})_(?P<instance>\d+)"


def _describe_px4(table: Table, name: str, components: tuple[str, ...]) -> dict[str, Any]:
    topic = table.name.partition("[")[0]
    name = name or "xyz"
    labels = "wxyz" if name == "q" else "xyz" if len(components) == 3 else components
    described = PX4_DOCUMENTED.get(f"{topic}.{name}", {})
    return described | {"name": f"{table.name}.{name}", "components": labels}


def name_px4_topics(tables: list[Table]) -> list[Table]:
    """Tables of ulog2csv with the names of their topics; others of the same log are so too."""
    titles = [table.body.text.title for table in tables]
    of_px4 = [title for title, table in zip(titles, tables, strict=True) if table.case is PX4]
    prefixes = {match["prefix"] for title in of_px4 if (match := re.fullmatch(PX4_FILE, title))}
    topics = {}
    for i, title in enumerate(titles):
        prefix = next((prefix for prefix in prefixes if title.startswith(prefix)), None)
        if prefix is not None and "timestamp" in tables[i].names:
            topic = re.fullmatch(r"(.+)_(\d+)", title.removeprefix(prefix))
            topics |= {i: topic.groups()} if topic else {}
    several = {topic for topic, instance in topics.values() if instance != "0"}
    for i, (topic, instance) in topics.items():
        columns = [column._replace(name=column.header) for column in tables[i].columns]
        name = f"{topic}[{instance}]" if topic in several else topic
        case = PX4_COMMANDS if topic.startswith(COMMANDS) else PX4
        tables[i] = tables[i]._replace(name=name, columns=columns, case=case)
    return tables


EUROC_SIGNALS = {
    "p": POSITION | {"unit": "m"},
    "q": ATTITUDE,
    "w": GYROSCOPE | {"unit": "rad/s"},
    "a": ACCELEROMETER | {"unit": "m/s²"},
}
TUM_NAMES = "timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"


def _describe_euroc(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    described: dict[str, str] = EUROC_SIGNALS.get(name.split("_")[0], {})
    order = {"order": "".join(components)} if name.startswith("q_") else {}
    has_imu = any(other.startswith(("w_RS_S", "b_w_RS_S")) for other in table.names)
    return described | order | ({"frame": "IMU"} if has_imu else {})


def name_tum_columns(table: Table) -> Table:
    """A trajectory without a header with the names of its columns."""
    if table.line is not None or table.body.dialect.delimiter != " " or len(table.columns) != 8:
        return table
    numbers = [table.numbers(i) for i in range(4, 8)]
    lengths = np.sqrt(sum(np.nan if column is None else column**2 for column in numbers))
    if not np.nanmax(abs(lengths - 1), initial=0) < 1e-2 or np.isnan(lengths).all():
        return table
    table.words.append(
        f"Eight columns, the last four of which are unit quaternions, are {' '.join(TUM_NAMES)}."
    )
    pairs = zip(table.columns, TUM_NAMES, strict=True)
    return table._replace(columns=[column._replace(name=name) for column, name in pairs])


def _describe_tum(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    if name == "t":
        return POSITION | {"name": _prefixed(table, "position")}
    return ATTITUDE | {"name": _prefixed(table, "attitude"), "order": "".join(components)}


def _prefixed(table: Table, name: str) -> str:
    return f"{table.name}.{name}" if table.name else name


MOTIVE_UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}


def _describe_motive(table: Table, name: str, components: tuple[str, ...]) -> dict[str, Any]:
    if name.endswith(".position"):
        return POSITION | {"unit": MOTIVE_UNITS.get(table.facts.get("Length Units", ""), "")}
    if len(components) == 4:
        return ATTITUDE | {"order": "".join(components)}
    order = table.facts.get("Rotation Type", "").upper()
    if set(order) != set("XYZ") or len(order) != 3:
        return {"quantity": "attitude", "unit": "deg"}
    # The angles are about axes that turn with the body, in degrees.
    described = {"unit": "deg", "order": order, "components": tuple(order.lower())}
    return ATTITUDE | described


def _describe_vicon(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    body, _, part = name.rpartition(".")
    angle = re.fullmatch(r"Global Angle \((\w+).*?\) (.+)", body)
    body = angle[2] if angle else body
    if part == "T":
        return POSITION | {"name": _prefixed(table, f"{body}.position")}
    if part == "R":
        described = {"name": _prefixed(table, f"{body}.rotation"), "quantity": "attitude"}
        if len(components) == 4:
            return described | ATTITUDE | {"order": "".join(components)}
        if angle and angle[1].lower() == "helical":
            return described | {"order": "rotation_vector", "direction": "body to space"}
        return described
    is_marker = table.body.text.title == "Trajectories"
    return {"name": _prefixed(table, name), **(POSITION if is_marker else {})}


PX4 = Case(
    "CSV of ulog2csv, of PX4",
    lambda table: (
        re.fullmatch(PX4_FILE, table.body.text.title) is not None and table.names[0] == "timestamp"
    ),
    (
        r".*/(?P<name>\w+)\[(?P<component>\d+)\]",
        r".*/esc\[(?P<component>\d+)\]\.(?P<name>esc_rpm)",
        r".*/(?P<name>)(?P<component>[xyz])",
    ),
    _describe_px4,
    {"timestamp_sample": "us", "timestamp": "us"},
    one_clock=True,
    remark=" Speeds, `esc_rpm`, are in the order of the speed controllers.",
)
# Here `timestamp_sample` is the time of the reading that a command answers.
PX4_COMMANDS = PX4._replace(times={"timestamp": "us"})
CASES = (
    Case(
        "CSV of OptiTrack Motive",
        lambda table: MOTIVE in table.facts,
        (r"[^/]*/(?P<name>.+\.(?:rotation|position))\.(?P<component>[wxyz])",),
        _describe_motive,
    ),
    Case(
        "CSV of Vicon",
        lambda table: table.body.text.rate > 0,
        (
            r"[^/]*/(?P<name>.+\.[RT])(?P<component>[WXYZ])",
            r"[^/]*/(?P<name>.+)\.(?P<component>[XYZ])",
        ),
        _describe_vicon,
    ),
    Case(
        "CSV of phyphox",
        _is_phyphox,
        (PHYPHOX_COLUMN,),
        lambda table, name, components: PHYPHOX.get(name.lower(), {}),
        one_clock=True,
        remark=" Axes of the phone are to the right, up along the screen, and out of it.",
    ),
    Case(
        "CSV of blackbox_decode",
        lambda table: {"loopIteration", "time"} <= set(table.names),
        (r"[^/]*/(?P<name>\w+)\[(?P<component>\d+)\]",),
        lambda table, name, components: BLACKBOX.get(name, {}),
        {"time": "us"},
        remark=(
            " What has no unit in the header is raw; `--unit-rotation deg/s --unit-acceleration g` "
            "gives units. `eRPM` is the electrical speed in 100 rpm."
        ),
    ),
    PX4,
    Case(
        "a file of EuRoC",
        lambda table: is_time(table.names[0]) and any("_RS_" in name for name in table.names),
        (
            r"[^/]*/(?P<name>(?:b_)?[a-z]_RS_[A-Z])_(?P<component>[xyz])",
            r"[^/]*/(?P<name>q_RS)_(?P<component>[wxyz])",
        ),
        _describe_euroc,
        {"timestamp": "ns"},
        one_clock=True,
    ),
    Case(
        "a trajectory of TUM",
        lambda table: set(table.names) == set(TUM_NAMES),
        (r"[^/]*/(?P<name>t)(?P<component>[xyz])", r"[^/]*/(?P<name>q)(?P<component>[wxyz])"),
        _describe_tum,
        {"timestamp": "s"},
        since_1970=True,
    ),
)
