"""Bags of ROS 1 and ROS 2, written by the package rosbags: names, units, axes, times, damage."""

import re
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lgvi.logs import LogError
from lgvi.logs import read as read_log
from lgvi.logs.bags import read

from .damages import check_damages, limited

SECOND = 10**9
BEGIN = 1_715_000_000 * SECOND + 250_000_000
DELAY = 3_000_000  # ns from the measurement to the writing
COUNT = 20
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.LATEST)}


class Bag:
    """A bag of one of the versions, and the messages in it."""

    def __init__(self, version=2, extra=""):
        self.version, self.store = (
            version,
            get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST),
        )
        if extra:
            self.store.register(get_types_from_msg(extra, "my_msgs/msg/Extra"))
        self.messages = []

    def make(self, kind, **fields):
        package, name = kind.split("/")
        kind = self.store.types[f"{package}/msg/{name}"]
        if name == "Header" and self.version == 1:
            fields["seq"] = 0
        return kind(**fields)

    def header(self, stamp, frame):
        sec, nanosec = divmod(stamp, SECOND)
        time = self.make("builtin_interfaces/Time", sec=sec, nanosec=nanosec)
        return self.make("std_msgs/Header", stamp=time, frame_id=frame)

    def vector(self, x, y, z, kind="Vector3"):
        return self.make(f"geometry_msgs/{kind}", x=x, y=y, z=z)

    def quaternion(self, x, y, z, w):
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def add(self, topic, written, kind, **fields):
        self.messages.append((topic, written, self.make(kind, **fields)))

    def imu(self, i, topic="/imu", frame="imu_link", stamp=None, measured=True):
        """The message number i of an inertial sensor, 100 in a second."""
        moment = BEGIN + i * 10_000_000
        covariance = np.zeros(9)
        covariance[0] = 0 if measured else -1
        self.add(
            *(topic, moment + DELAY, "sensor_msgs/Imu"),
            header=self.header(moment if stamp is None else stamp, frame),
            orientation=self.quaternion(0.0, 0.0, 0.6, 0.8),
            orientation_covariance=covariance,
            angular_velocity=self.vector(float(i), 2.0 * i, 3.0),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(0.0, 0.0, 9.81),
            linear_acceleration_covariance=np.zeros(9),
        )

    def save(self, path, plugin=StoragePlugin.MCAP, compression=None):
        """The bag as a file or folder, and the file with the messages."""
        if self.version == 1:
            writer, path = Writer1(path.with_suffix(".bag")), path.with_suffix(".bag")
            if compression:
                writer.set_compression(compression)
        else:
            writer = Writer2(path, version=9, storage_plugin=plugin)
            if compression:
                writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            connections = {}
            for topic, written, message in self.messages:
                kind = message.__msgtype__
                if (topic, kind) not in connections:
                    connection = writer.add_connection(topic, kind, typestore=self.store)
                    connections[topic, kind] = connection
                serialize = (
                    self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
                )
                writer.write(connections[topic, kind], written, serialize(message, kind))
        return path


def of_imu(version=2, count=COUNT, **options):
    bag = Bag(version)
    for i in range(count):
        bag.imu(i, **options)
    return bag


def only_file(folder, ending):
    (file,) = folder.glob(f"*{ending}")
    return file


WAYS = {
    "bag": lambda path: of_imu(1).save(path),
    "bag-bz2": lambda path: of_imu(1).save(path, compression=Writer1.CompressionFormat.BZ2),
    "bag-lz4": lambda path: of_imu(1).save(path, compression=Writer1.CompressionFormat.LZ4),
    "mcap": lambda path: only_file(of_imu().save(path), ".mcap"),
    "mcap-zstd": lambda path: only_file(
        of_imu().save(path, compression=CompressionMode.STORAGE), ".mcap"
    ),
    "db3": lambda path: only_file(of_imu().save(path, StoragePlugin.SQLITE3), ".db3"),
    "folder-mcap": lambda path: of_imu().save(path),
    "folder-db3": lambda path: of_imu().save(path, StoragePlugin.SQLITE3),
    "folder-file": lambda path: of_imu().save(path, StoragePlugin.SQLITE3, CompressionMode.FILE),
    "folder-message": lambda path: of_imu().save(
        path, StoragePlugin.SQLITE3, CompressionMode.MESSAGE
    ),
}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ride"


@pytest.mark.parametrize("way", WAYS)
def test_inertial_sensors(path, way):
    log = read_log(WAYS[way](path))
    assert log.kind == "ROS bag"
    gyroscope = log.signals["/imu.angular_velocity"]
    expected = [[i, 2 * i, 3] for i in range(COUNT)]
    np.testing.assert_array_equal(gyroscope.values, expected)
    np.testing.assert_allclose(gyroscope.times, 0.25 + 0.01 * np.arange(COUNT), atol=1e-12)
    described = gyroscope.unit, gyroscope.frame, gyroscope.quantity, gyroscope.clock
    assert described == ("rad/s", "FLU", "angular_velocity", "log")
    assert gyroscope.components == ("x", "y", "z")
    accelerometer = log.signals["/imu.linear_acceleration"]
    assert (accelerometer.unit, accelerometer.quantity) == ("m/s²", "specific_force")
    attitude = log.signals["/imu.orientation"]
    np.testing.assert_array_equal(attitude.values[0], [0, 0, 0.6, 0.8])
    described = attitude.order, attitude.direction, attitude.frame, attitude.space
    assert described == ("xyzw", "body to space", "FLU", "ENU")
    assert log.start == datetime.fromtimestamp(1_715_000_000, UTC)
    assert set(log.signals) == {
        f"/imu.{field}" for field in ("orientation", "angular_velocity", "linear_acceleration")
    }
    assert any("`imu_link` as FLU" in words for words in log.assumed)
    assert not any("those of the newest ROS 2" in words for words in log.assumed)


@pytest.mark.parametrize(
    ("frame", "axes"),
    [("base_link", "FLU"), ("imu_FRD", "FRD"), ("imu_ned", "FRD"), ("cam_optical_frame", "RDF")],
)
def test_axes_by_the_name_of_the_frame(path, frame, axes):
    log = read(of_imu(frame=frame).save(path))
    assert log.signals["/imu.angular_velocity"].frame == axes
    space = "NED" if frame == "imu_ned" else "ENU"
    assert log.signals["/imu.orientation"].space == space


def test_an_attitude_that_is_not_measured_is_no_signal(path):
    log = read(of_imu(measured=False).save(path))
    assert "/imu.orientation" not in log.signals
    assert any("/imu.orientation` is not measured" in words for words in log.assumed)
    bag = of_imu()
    bag.imu(COUNT, measured=False)
    values = read(bag.save(path.with_name("second"))).signals["/imu.orientation"].values
    assert np.isnan(values[-1]).all()
    assert np.isfinite(values[:-1]).all()


@pytest.mark.parametrize(
    ("parent", "space"),
    [
        ("odom", "ENU"),
        ("map_ned", "NED"),
        ("odom_frd", "FRD with unknown heading"),
        ("camera_color_optical_frame", "RDF"),
    ],
)
def test_axes_of_space_by_the_name_of_the_frame(path, parent, space):
    bag = Bag()
    pose = bag.make(
        "geometry_msgs/Pose",
        position=bag.vector(1.0, 2.0, 3.0, "Point"),
        orientation=bag.quaternion(0.0, 0.0, 0.0, 1.0),
    )
    header = bag.header(BEGIN, parent)
    bag.add("/tag", BEGIN, "geometry_msgs/PoseStamped", header=header, pose=pose)
    signals = read(bag.save(path)).signals
    assert signals["/tag.pose.position"].space == signals["/tag.pose.orientation"].space == space
    assert signals["/tag.pose.orientation"].frame == "FLU"


def test_two_topics_and_two_frames(path):
    bag = of_imu()
    for i in range(COUNT):
        bag.imu(i, topic="/imu2", frame=f"frame{i % 2}")
    log = read(bag.save(path))
    assert len(log.signals["/imu2.angular_velocity"]) == COUNT
    assert log.signals["/imu2.angular_velocity"].frame == "FLU"
    assert "`/imu2` has several frames: frame0, frame1." in log.assumed


def test_frames_of_different_axes_leave_the_axes_open(path):
    bag = of_imu()
    bag.imu(COUNT, frame="imu_frd")
    log = read(bag.save(path))
    attitude = log.signals["/imu.orientation"]
    assert (attitude.frame, attitude.space) == ("", "ENU")
    assert "`/imu`: by REP 103, axes are taken so: those of space `imu_link` as ENU." in log.assumed


def test_poses_transforms_and_fields(path):
    bag = Bag()
    header = bag.header(BEGIN, "map")
    pose = bag.make(
        "geometry_msgs/Pose",
        position=bag.vector(1.0, 2.0, 3.0, "Point"),
        orientation=bag.quaternion(0.0, 0.0, 0.0, 1.0),
    )
    twist = bag.make(
        "geometry_msgs/Twist",
        linear=bag.vector(1.0, 0.0, 0.0),
        angular=bag.vector(0.0, 0.0, 0.5),
    )
    transform = bag.make(
        "geometry_msgs/TransformStamped",
        header=header,
        child_frame_id="base_link",
        transform=bag.make(
            "geometry_msgs/Transform",
            translation=bag.vector(4.0, 5.0, 6.0),
            rotation=bag.quaternion(0.0, 0.0, 1.0, 0.0),
        ),
    )
    with_covariance = bag.make(
        "geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.zeros(36)
    )
    moving = bag.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36))
    bag.add("/pose", BEGIN, "geometry_msgs/PoseStamped", header=header, pose=pose)
    bag.add(
        *("/odom", BEGIN, "nav_msgs/Odometry"),
        header=header,
        child_frame_id="base_frd",
        pose=with_covariance,
        twist=moving,
    )
    bag.add(
        *("/amcl", BEGIN, "geometry_msgs/PoseWithCovarianceStamped"),
        header=header,
        pose=with_covariance,
    )
    bag.add("/tf", BEGIN, "tf2_msgs/TFMessage", transforms=[transform, transform])
    bag.add("/twist", BEGIN, "geometry_msgs/TwistStamped", header=header, twist=twist)
    bag.add(
        *("/mag", BEGIN, "sensor_msgs/MagneticField"),
        header=bag.header(BEGIN, "imu_link"),
        magnetic_field=bag.vector(2e-5, 0.0, -4e-5),
        magnetic_field_covariance=np.zeros(9),
    )
    log = read(bag.save(path))
    signals = log.signals
    for name in ("/pose.pose.position", "/odom.pose.pose.position", "/amcl.pose.pose.position"):
        np.testing.assert_array_equal(signals[name].values, [[1, 2, 3]])
        assert (signals[name].unit, signals[name].space) == ("m", "ENU")
        attitude = signals[name.replace("position", "orientation")]
        assert (attitude.quantity, attitude.space) == ("attitude", "ENU")
    assert signals["/odom.pose.pose.orientation"].frame == "FRD"
    turning = signals["/odom.twist.twist.angular"]
    assert (turning.unit, turning.frame, turning.quantity) == ("rad/s", "FRD", "angular_velocity")
    np.testing.assert_array_equal(
        signals["/tf[base_link].transform.translation"].values, [[4, 5, 6]] * 2
    )
    assert signals["/tf[base_link].transform.rotation"].quantity == "attitude"
    turning = signals["/twist.twist.angular"]
    assert (turning.unit, turning.frame, turning.quantity) == ("rad/s", "", "")
    field = signals["/mag.magnetic_field"]
    assert (field.unit, field.frame, field.quantity) == ("T", "FLU", "magnetic_field")


def test_numbers_without_header_have_the_time_of_writing(path):
    bag = of_imu()
    for i in range(3):
        bag.add("/speed", BEGIN + i * SECOND, "std_msgs/Float64", data=1.5 * i)
    log = read(bag.save(path))
    speed = log.signals["/speed.data"]
    np.testing.assert_array_equal(speed.values, [0, 1.5, 3])
    np.testing.assert_array_equal(speed.times, [0.25, 1.25, 2.25])
    assert (speed.clock, speed.unit) == ("time of writing", "")
    assert any(words.startswith("`/speed`: times are those of writing") for words in log.assumed)


def test_headers_without_time_are_not_taken(path):
    signal = read(of_imu(stamp=0).save(path)).signals["/imu.angular_velocity"]
    assert signal.clock == "time of writing"
    np.testing.assert_allclose(signal.times[0], 0.253)


def test_headers_of_another_clock_have_one_zero_of_their_own(path):
    """As in the bag of a simulation whose clock begins when it starts."""
    bag = of_imu()
    for i in range(COUNT):
        bag.imu(i, topic="/driver", stamp=7 * SECOND + i * 10_000_000)
        if i > COUNT // 2:
            bag.imu(i, topic="/late", stamp=8 * SECOND + i * 10_000_000)
    log = read(bag.save(path))
    early, late = (log.signals[f"/{name}.angular_velocity"] for name in ("driver", "late"))
    np.testing.assert_allclose(early.times - early.times[0], 0.01 * np.arange(COUNT), atol=1e-12)
    np.testing.assert_allclose(late.times[-1] - early.times[-1], 1, rtol=1e-12)
    assert early.clock == late.clock != "log"
    assert log.signals["/imu.angular_velocity"].clock == "log"
    words = next(words for words in log.assumed if words.startswith("`/driver`: times in the head"))
    zero = int(words.split("zero is ")[1].split()[0])
    np.testing.assert_allclose(zero + early.times[0], 7, rtol=1e-12)


def test_devices_that_count_from_their_own_start_have_zeros_of_their_own(path):
    bag = of_imu()
    for i in range(COUNT):
        bag.imu(i, topic="/one", stamp=100 * SECOND + i * 10_000_000)
        bag.imu(i, topic="/two", stamp=5000 * SECOND + i * 10_000_000)
    log = read(bag.save(path))
    one, two = (log.signals[f"/{name}.angular_velocity"] for name in ("one", "two"))
    assert abs(one.times[0] - two.times[0]) <= 1
    assert one.clock != two.clock


def test_times_that_go_back_stay_and_are_told(path):
    bag = of_imu()
    bag.imu(COUNT, stamp=BEGIN)
    log = read(bag.save(path))
    assert log.signals["/imu.angular_velocity"].times[-1] == 0.25
    assert "`/imu`: times go back; the order is that of writing." in log.assumed


def test_joints_and_arrays(path):
    bag = Bag()
    for i in range(3):
        bag.add(
            *("/joints", BEGIN + i, "sensor_msgs/JointState"),
            header=bag.header(BEGIN, ""),
            name=["left", "right"],
            position=np.zeros(0),
            velocity=np.array([1.0, 2.0]),
            effort=np.zeros(i),
        )
        layout = bag.make("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
        bag.add("/rpm", BEGIN + i, "std_msgs/Float64MultiArray", layout=layout, data=np.ones(4))
    log = read(bag.save(path))
    velocity = log.signals["/joints.velocity"]
    np.testing.assert_array_equal(velocity.values, [[1, 2]] * 3)
    assert (velocity.unit, velocity.components) == ("rad/s", ("left", "right"))
    assert log.signals["/rpm.data"].values.shape == (3, 4)
    assert not {"/joints.position", "/joints.effort"} & set(log.signals)
    words = "`/joints.effort` was left out: arrays of 0 to 2 numbers are no signal."
    assert words in log.assumed


def test_joints_of_several_publishers_are_not_one_signal(path):
    bag = of_imu()
    for name in ("left", "right", "left"):
        bag.add(
            *("/joints", BEGIN, "sensor_msgs/JointState"),
            header=bag.header(BEGIN, ""),
            name=[name],
            position=np.zeros(1),
            velocity=np.zeros(1),
            effort=np.zeros(1),
        )
    log = read(bag.save(path))
    assert not any(name.startswith("/joints") for name in log.signals)
    assert "`/joints` was left out: its messages are of different joints." in log.assumed


@pytest.mark.parametrize("version", [1, 2])
def test_numbers_in_other_messages(path, version):
    extra = (
        "float32 temperature\nbool[3] flags\nstring word\ngeometry_msgs/Vector3 force\nint8 lambda"
        "\nint32 child_frame_id\ngeometry_msgs/Vector3[] forces"
    )
    bag = Bag(version, extra)
    for i in range(3):
        bag.add(
            *("/extra", BEGIN + i, "my_msgs/Extra"),
            temperature=20.5,
            flags=np.array([True, False, True]),
            word="a",
            force=bag.vector(1.0, 2.0, 3.0),
            lambda_=-4,
            child_frame_id=i,
            forces=[],
        )
    log = read(bag.save(path))
    assert {name: signal.values[0].tolist() for name, signal in log.signals.items()} == {
        "/extra.temperature": 20.5,
        "/extra.flags": [1, 0, 1],
        "/extra.force": [1, 2, 3],
        "/extra.lambda_": -4,
        "/extra.child_frame_id": 0,
    }
    assert log.facts == {"not read: /extra.forces": "messages in an array"}


def test_images_and_texts_are_not_read(path):
    bag = of_imu()
    bag.add(
        *("/camera", BEGIN, "sensor_msgs/CompressedImage"),
        header=bag.header(BEGIN, "camera"),
        format="png",
        data=np.zeros(1000, np.uint8),
    )
    bag.add("/word", BEGIN, "std_msgs/String", data="a")
    bag.add("/imu", BEGIN, "std_msgs/Float64", data=1.0)
    log = read(bag.save(path))
    assert log.facts == {
        "not read: /camera": "sensor_msgs/msg/CompressedImage, with bytes in `data`",
        "not read: /word": "std_msgs/msg/String, without numbers",
        "not read: /imu": "std_msgs/msg/Float64, a second kind of messages in the topic",
    }
    bag.messages = bag.messages[-2:-1]
    with pytest.raises(LogError, match="must have messages with numbers, but has /word"):
        read(bag.save(path.with_name("second")))


def test_a_bag_without_definitions_has_those_of_the_newest_version(path):
    """As ROS 2 before Iron wrote: the table of definitions is missing."""
    import sqlite3

    folder = of_imu().save(path, StoragePlugin.SQLITE3)
    file = only_file(folder, ".db3")
    with sqlite3.connect(file) as tables:
        tables.execute("DELETE FROM message_definitions")
    tables.close()
    log = read(file)
    assert len(log.signals["/imu.angular_velocity"]) == COUNT
    assert any("does not define its messages" in words for words in log.assumed)


def test_a_chunk_that_grows_too_much_is_refused(path, monkeypatch):
    bags = {
        way: WAYS[way](path / way)
        for way in ("bag-bz2", "bag-lz4", "mcap-zstd", "folder-message")
        if (path / way).parent.mkdir(exist_ok=True) is None
    }
    monkeypatch.setattr("lgvi.logs.bags.LARGEST_CHUNK", 100)
    for bag in bags.values():
        with pytest.raises(LogError, match="compressed data grow to more than 100 bytes"):
            read(bag)


def test_a_file_that_grows_too_much_is_refused(path, monkeypatch):
    path.mkdir()
    bags = [WAYS[way](path / way) for way in ("folder-file", "folder-message")]
    monkeypatch.setattr("lgvi.logs.bags.MOST_EXPANSION", 0)
    monkeypatch.setattr("lgvi.logs.bags.LARGEST_CHUNK", 6000)
    for bag in bags:
        with pytest.raises(LogError, match="grows to more than 0 times its size"):
            read(bag)


@pytest.mark.parametrize(
    ("extra", "why"),
    [
        ("std_msgs/Empty[] many", "with empty messages in `many`"),
        ("geometry_msgs/Vector3[1000000000] many", "with 1000000000 elements in `many`"),
        ("string[1000000000] many", "with 1000000000 elements in `many`"),
        ("float64[1000000000] many", "of more than 1000000 bytes"),
        ("my_msgs/Extra self", "of more than 1000000 bytes"),
        ("my_msgs/Extra[] self", "of more than 1000000 bytes"),
    ],
)
def test_definitions_that_would_fill_the_memory_are_not_followed(path, extra, why):
    """The definition of a message is part of the file."""
    store = Bag().store
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        parts = ("Empty", "std_msgs"), ("Vector3", "geometry_msgs")
        described = "".join(
            f"\n{'=' * 80}\nMSG: {package}/{name}\n"
            f"{store.generate_msgdef(f'{package}/msg/{name}')[0] if name == 'Vector3' else ''}"
            for name, package in parts
            if name in extra
        )
        connection = writer.add_connection(
            "/extra", "my_msgs/msg/Extra", msgdef=extra + described, rihs01="RIHS01_"
        )
        writer.write(connection, BEGIN, b"\0\1\0\0" + bytes(64))
    with limited(), pytest.raises(LogError, match=f"Extra, {re.escape(why)}"):
        read(only_file(path, ".mcap"))


def test_a_name_that_does_not_fit_the_content_is_refused(path):
    file = of_imu(1).save(path)
    with pytest.raises(LogError, match=r"must have a name that ends with \.bag"):
        read_log(file.rename(path.with_suffix(".log")))
    path.with_suffix(".mcap").write_bytes(b"t,x\n1,2\n")
    with pytest.raises(LogError, match=r"must have a name that ends with \.mcap if it begins"):
        read(path.with_suffix(".mcap"))


def test_messages_before_damage_are_read(path):
    """A chunk in the middle of a compressed bag is damaged."""
    file = of_imu(1, 8000).save(path, compression=Writer1.CompressionFormat.LZ4)
    content = bytearray(file.read_bytes())
    place = content.rindex(b"op=\x05")
    content[place + 200 : place + 400] = bytes(200)
    file.write_bytes(bytes(content))
    log = read(file)
    assert 4000 < len(log.signals["/imu.angular_velocity"]) < 8000
    (words,) = (words for words in log.assumed if words.startswith("The bag is damaged after"))
    assert " of 8000 messages: " in words


def test_a_damaged_message_is_left_out(path):
    file = only_file(of_imu(frame="one_frame").save(path, StoragePlugin.SQLITE3), ".db3")
    content = bytearray(file.read_bytes())
    place = content.index(b"one_frame")
    content[place - 4 : place] = b"\xff\xff\xff\x7f"
    file.write_bytes(bytes(content))
    log = read(file)
    assert len(log.signals["/imu.angular_velocity"]) == COUNT - 1
    assert "1 messages that are damaged were left out." in log.assumed


def test_the_package_that_is_missing_is_named(path, monkeypatch):
    file = of_imu(1).save(path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(ImportError, match="need rosbags: pip install"):
        read(file)


@pytest.mark.parametrize(
    ("way", "ending", "least"),
    [
        ("bag", "", 20),
        ("bag-lz4", "", 5),
        ("mcap", "", 20),
        ("mcap-zstd", "", 5),
        ("db3", "", 20),
        ("folder-mcap", ".yaml", 5),
        ("folder-message", ".db3", 5),
    ],
)
def test_damaged_files(path, way, ending, least):
    log = WAYS[way](path)
    logs = check_damages(read, log, only_file(log, ending) if ending else None)
    assert len(logs) > least
