"""Logs of PX4: names, units, axes and times of topics, and what damaged files give."""

import struct
import sys
from datetime import UTC, datetime

import numpy as np
import pytest

from lgvi.logs import LogError
from lgvi.logs.ulog import read

from .damages import check_damages, limited

SYNC = bytes.fromhex("2f731320250cbb12")
BEGAN = 5_000_000  # us


def message(kind, payload):
    return struct.pack("<HB", len(payload), ord(kind)) + payload


def keyed(kind, key, value):
    """Information or a parameter."""
    code = {"i": "<i", "f": "<f"}.get(key[0])
    payload = value.encode() if code is None else struct.pack(code, value)
    return message(kind, bytes([len(key)]) + key.encode() + payload)


class Written:
    """A ULog by the layout of its documentation."""

    def __init__(self, flags=bytes(40)):
        self.content = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BEGAN) + message("B", flags)
        self.numbers = {}

    def __add__(self, part):
        self.content += part
        return self

    def topic(self, fields, name):
        return self + message("F", f"{name}:{fields};".encode())

    def subscribe(self, name, instance=0):
        number = self.numbers[name, instance] = len(self.numbers)
        return self + message("A", struct.pack("<BH", instance, number) + name.encode())

    def data(self, code, *values, name, instance=0):
        number = struct.pack("<H", self.numbers[name, instance])
        return self + message("D", number + struct.pack("<" + code, *values))

    def save(self, path):
        path.write_bytes(self.content)
        return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "flight.ulg"


def rates(count=3, written=None, name="vehicle_angular_velocity"):
    """A log of angular velocities."""
    written = written or Written()
    written.topic("uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz", name)
    written.subscribe(name)
    for i in range(count):
        if i % 10 == 9:
            written += message("S", SYNC)
        at = BEGAN + 1000 * i
        written.data("QQ3f", at + 300, at, i, 2 * i, 3 * i, name=name)
    return written


def test_a_vector_has_name_unit_axes_and_the_times_of_its_samples(path):
    log = read(rates().save(path))
    assert log.kind == "PX4 ULog"
    signal = log.signals["vehicle_angular_velocity.xyz"]
    np.testing.assert_array_equal(signal.times, [0, 1e-3, 2e-3])
    np.testing.assert_array_equal(signal.values, [[0, 0, 0], [1, 2, 3], [2, 4, 6]])
    assert (signal.unit, signal.frame, signal.quantity) == ("rad/s", "FRD", "angular_velocity")
    assert signal.components == ("x", "y", "z")
    np.testing.assert_array_equal(log.signal("vehicle_angular_velocity.xyz.y").values, [0, 2, 4])
    assert any("timestamp_sample" in words for words in log.assumed)
    assert list(log.signals) == ["vehicle_angular_velocity.xyz"]


def test_a_sample_time_that_is_not_set_is_not_taken(path):
    written = rates(2)
    written.data("QQ3f", BEGAN + 2300, 0, 1, 1, 1, name="vehicle_angular_velocity")
    log = read(written.save(path))
    times = log.signals["vehicle_angular_velocity.xyz"].times
    np.testing.assert_array_equal(times, [3e-4, 1.3e-3, 2.3e-3])
    assert not any("timestamp_sample" in words for words in log.assumed)


def test_the_accelerometer_of_sensor_combined_has_its_own_times(path):
    name = "sensor_combined"
    fields = (
        "uint64_t timestamp;float[3] gyro_rad;int32_t accelerometer_timestamp_relative;"
        "float[3] accelerometer_m_s2"
    )
    written = Written().topic(fields, name).subscribe(name)
    for i, relative in enumerate((-250, 500, 2**31 - 1)):
        at = BEGAN + 4000 * i
        written.data("Q3fi3f", at, 1, 2, 3, relative, 0, 0, -9.8125, name=name)
    log = read(written.save(path))
    gyroscope, accelerometer = log.signals["sensor_combined.gyro_rad"], None
    np.testing.assert_array_equal(gyroscope.times, [0, 0.004, 0.008])
    accelerometer = log.signals["sensor_combined.accelerometer_m_s2"]
    np.testing.assert_allclose(accelerometer.times, [-0.00025, 0.0045, 0.008])
    np.testing.assert_array_equal(accelerometer.values[:2], [[0, 0, -9.8125]] * 2)
    assert np.isnan(accelerometer.values[2]).all()
    described = accelerometer.unit, accelerometer.quantity, accelerometer.frame
    assert described == ("m/s²", "specific_force", "FRD")


@pytest.mark.parametrize(("turn", "frame"), [(0, "FRD"), (6, "FRD of the board")])
def test_instances_are_numbered_and_in_axes_of_the_board(path, turn, frame):
    written = Written()
    for axis in ("ROT", "X_OFF", "Y_OFF", "Z_OFF"):
        kind = "int32_t" if axis == "ROT" else "float"
        key = f"{kind} SENS_BOARD_{axis}"
        written += keyed("P", key, turn if axis == "ROT" else 0.0)
    written.topic("uint64_t timestamp;float x;float y;float z;float temperature", "sensor_gyro")
    for instance in (0, 1):
        written.subscribe("sensor_gyro", instance)
        for i in range(3):
            values = BEGAN + i, 1 + instance, 2, 3, 40
            written.data("Q4f", *values, name="sensor_gyro", instance=instance)
    log = read(written.save(path))
    second = log.signals["sensor_gyro[1].xyz"]
    np.testing.assert_array_equal(second.values, [[2, 2, 3]] * 3)
    assert (second.unit, second.frame, second.quantity) == ("rad/s", frame, "angular_velocity")
    assert set(log.signals) == {
        *("sensor_gyro[0].xyz", "sensor_gyro[1].xyz"),
        *("sensor_gyro[0].temperature", "sensor_gyro[1].temperature"),
    }
    assert any("board" in words for words in log.assumed) == (turn != 0)
    assert log.facts["parameter SENS_BOARD_ROT"] == str(turn)


def test_an_external_sensor_is_not_in_the_axes_of_the_board(path):
    written = Written()
    for axis in ("ROT", "X_OFF", "Y_OFF", "Z_OFF"):
        written += keyed("P", f"{'int32_t' if axis == 'ROT' else 'float'} SENS_BOARD_{axis}", 0)
    written.topic("uint64_t timestamp;bool is_external;float x;float y;float z", "sensor_mag")
    for instance in (0, 1):
        written.subscribe("sensor_mag", instance)
        values = BEGAN, instance == 1, 0.25, 0, 0.5
        written.data("Q?3f", *values, name="sensor_mag", instance=instance)
    log = read(written.save(path))
    frames = [log.signals[f"sensor_mag[{i}].xyz"].frame for i in (0, 1)]
    assert frames == ["FRD", "FRD of the board"]


def test_axes_of_the_board_are_not_those_of_the_vehicle_where_no_parameter_tells(path):
    written = Written().topic("uint64_t timestamp;float x;float y;float z", "sensor_accel")
    written.subscribe("sensor_accel", 1).data("Q3f", 1, 0, 0, 1, name="sensor_accel", instance=1)
    log = read(written.save(path))
    assert log.signals["sensor_accel[1].xyz"].frame == "FRD of the board"


def test_attitude_position_and_field(path):
    written = Written()
    written.topic("uint64_t timestamp;float[4] q", "vehicle_attitude")
    written.topic(
        "uint64_t timestamp;float x;float y;float z;bool xy_valid", "vehicle_local_position"
    )
    written.topic("uint64_t timestamp;float[3] magnetometer_ga", "vehicle_magnetometer")
    written.subscribe("vehicle_attitude").subscribe("vehicle_local_position")
    written.subscribe("vehicle_magnetometer")
    written.data("Q4f", BEGAN, 1, 0, 0, 0, name="vehicle_attitude")
    written.data("Q3f?", BEGAN, 1, 2, 3, True, name="vehicle_local_position")
    written.data("Q3f", BEGAN, 0.25, 0, 0.5, name="vehicle_magnetometer")
    log = read(written.save(path))
    attitude = log.signals["vehicle_attitude.q"]
    assert attitude.components == tuple("wxyz")
    described = attitude.order, attitude.direction, attitude.frame, attitude.space
    assert described == ("wxyz", "body to space", "FRD", "NED")
    position = log.signals["vehicle_local_position.xyz"]
    np.testing.assert_array_equal(position.values, [[1, 2, 3]])
    assert (position.unit, position.space, position.quantity) == ("m", "NED", "position")
    assert log.signals["vehicle_magnetometer.magnetometer_ga"].unit == "G"
    assert sum("not a measurement" in words for words in log.assumed) == 2


def test_space_of_odometry_is_that_of_its_messages(path):
    name = "vehicle_visual_odometry"
    written = Written().topic("uint64_t timestamp;uint8_t pose_frame;float[4] q", name)
    for instance, frames in enumerate(((1, 1), (1, 2))):
        written.subscribe(name, instance)
        for frame in frames:
            written.data("QB4f", BEGAN, frame, 1, 0, 0, 0, name=name, instance=instance)
    log = read(written.save(path))
    assert [log.signals[f"{name}[{i}].q"].space for i in (0, 1)] == ["NED", ""]


def test_rotor_speeds_are_one_signal_of_the_motors_there_are(path):
    written = Written().topic("uint64_t timestamp;int32_t esc_rpm;uint8_t esc_state", "esc_report")
    written.topic("uint64_t timestamp;uint8_t esc_count;esc_report[8] esc", "esc_status")
    written.subscribe("esc_status")
    speeds = [1000, -1100, 1200, 1300, 0, 0, 0, 0]
    reports = [number for speed in speeds for number in (BEGAN, speed, 1)]
    written.data("QB" + 8 * "QiB", BEGAN, 4, *reports, name="esc_status")
    log = read(written.save(path))
    signal = log.signals["esc_status.esc_rpm"]
    np.testing.assert_array_equal(signal.values, [speeds[:4]])
    assert (signal.unit, signal.quantity) == ("rpm", "rotor_speed")
    assert signal.components == ("esc0", "esc1", "esc2", "esc3")
    assert log.signals["esc_status.esc[1].esc_rpm"].values == [-1100]


@pytest.mark.parametrize(
    ("functions", "speeds", "components"),
    [
        ((103, 101, 104, 102), (2, 4, 1, 3), ("motor1", "motor2", "motor3", "motor4")),
        ((101, 0, 103, 104), (1, 2, 3, 4), ("esc0", "esc1", "esc2", "esc3")),
        ((101, 101, 103, 104), (1, 2, 3, 4), ("esc0", "esc1", "esc2", "esc3")),
    ],
)
def test_rotor_speeds_are_in_the_order_of_the_motors(path, functions, speeds, components):
    """The order of the outputs, which speed controllers have, may be another one."""
    written = Written().topic("int32_t esc_rpm;uint8_t actuator_function", "esc_report")
    written.topic("uint64_t timestamp;uint8_t esc_count;esc_report[8] esc", "esc_status")
    written.subscribe("esc_status")
    reports = [(i + 1, function) for i, function in enumerate(functions)] + [(0, 0)] * 4
    written.data("QB" + 8 * "iB", BEGAN, 4, *np.ravel(reports), name="esc_status")
    signal = read(written.save(path)).signals["esc_status.esc_rpm"]
    assert (tuple(signal.values[0]), signal.components) == (speeds, components)


def test_a_speed_controller_beyond_their_count_is_not_lost(path):
    """On a CAN bus a speed controller has the number that it was given."""
    written = Written().topic("int32_t esc_rpm", "esc_report")
    written.topic("uint64_t timestamp;uint8_t esc_count;esc_report[8] esc", "esc_status")
    written.subscribe("esc_status").data("QB8i", BEGAN, 1, *[0] * 5, 7, 0, 0, name="esc_status")
    signal = read(written.save(path)).signals["esc_status.esc_rpm"]
    assert (signal.values.tolist(), signal.components) == ([[0, 7]], ("esc0", "esc5"))


def test_commands_of_motors_have_no_quantity_and_the_time_of_writing(path):
    fields = "uint64_t timestamp;uint64_t timestamp_sample;float[12] control"
    written = Written().topic(fields, "actuator_motors").subscribe("actuator_motors")
    values = [0.5] * 4 + [np.nan] * 8
    written.data("QQ12f", BEGAN + 2000, BEGAN, *values, name="actuator_motors")
    log = read(written.save(path))
    signal = log.signals["actuator_motors.control"]
    assert signal.times == [0.002]  # of the command, not of the sample that it answers
    assert (signal.unit, signal.quantity, signal.values.shape) == ("1", "", (1, 12))
    assert np.isnan(signal.values[0, 4:]).all()
    assert any("square root" in words for words in log.assumed)


def test_armed_intervals(path):
    written = rates().topic("uint64_t timestamp;uint8_t arming_state", "vehicle_status")
    written.subscribe("vehicle_status")
    for at, state in ((0, 1), (2, 2), (3, 2), (4, 1), (6, 2)):
        written.data("QB", BEGAN + at * 1_000_000, state, name="vehicle_status")
    written.data("QQ3f", BEGAN + 8_000_000, 1, 0, 0, 0, name="vehicle_angular_velocity")
    assert read(written.save(path)).armed == ((2.0, 4.0), (6.0, 8.0))
    assert read(rates().save(path)).armed is None


def test_date_and_facts(path):
    written = Written()
    written += keyed("I", "char[3] sys_name", "PX4") + keyed("I", "int32_t ver_data_format", 1)
    rates(written=written)
    written.topic("uint64_t timestamp;uint64_t time_utc_usec", "vehicle_gps_position")
    written.subscribe("vehicle_gps_position")
    now = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)
    second = int(now.timestamp())
    for at, utc in ((0, 0), (1, second), (2, second + 1), (3, second + 500), (4, second + 3)):
        times = BEGAN + at * 1_000_000, utc * 1_000_000
        written.data("QQ", *times, name="vehicle_gps_position")
    log = read(written.save(path))
    assert log.start == datetime(2024, 5, 6, 7, 8, 8, tzinfo=UTC)
    assert log.facts == {"sys_name": "PX4", "ver_data_format": "1"}


def test_times_that_go_back_stay_and_are_told(path):
    written = rates(2)
    for at in (5000, 4000, 4000):
        written.data("QQ3f", BEGAN, BEGAN + at, 0, 0, 0, name="vehicle_angular_velocity")
    log = read(written.save(path))
    times = log.signals["vehicle_angular_velocity.xyz"].times
    np.testing.assert_array_equal(times, [0, 0.001, 0.005, 0.004, 0.004])
    words = "Times go back in the topics vehicle_angular_velocity; the order is that of the file."
    assert words in log.assumed


def test_changed_parameters_do_not_replace_the_first(path):
    written = Written()
    written += keyed("P", "int32_t MODE", 1)
    rates(written=written)
    written += keyed("P", "int32_t MODE", 2)
    assert read(written.save(path)).facts["parameter MODE"] == "1"


def test_dropouts_are_told(path):
    written = rates()
    written += message("O", struct.pack("<H", 400)) + message("O", struct.pack("<H", 100))
    words = (
        "The logger was too slow 2 times, for 0.5 s in all: messages of these times are missing."
    )
    assert words in read(written.save(path)).assumed


def test_padding_and_text_are_left_out(path):
    fields = "uint64_t timestamp;float value;uint8_t[4] _padding0;char[2] word;float[2] pair"
    written = Written().topic(f"{fields};uint8_t[5] _padding1", "debug").subscribe("debug")
    written.data("Qf4B2c2f", BEGAN, 2.5, 0, 0, 0, 0, b"a", b"b", 3, 4, name="debug")
    log = read(written.save(path))
    assert set(log.signals) == {"debug.value", "debug.pair"}
    assert log.signals["debug.pair"].components == ("0", "1")
    np.testing.assert_array_equal(log.signals["debug.value"].values, [2.5])


def test_a_file_that_is_cut_off_gives_what_is_whole(path):
    content = rates(30).content
    path.write_bytes(content[:-5])
    log = read(path)
    assert len(log.signals["vehicle_angular_velocity.xyz"]) == 29
    size = 3 + 2 + 16 + 12
    begin = len(content) - size
    words = f"The file ends in the middle of a message at byte {begin}: {size - 5} bytes were lost."
    assert words in log.assumed


def test_reading_goes_on_after_a_mark(path):
    written = rates(100)
    content = bytearray(written.content)
    begin = len(content) // 2
    content[begin : begin + 40] = bytes(40)
    path.write_bytes(bytes(content))
    log = read(path)
    signal = log.signals["vehicle_angular_velocity.xyz"]
    assert 80 < len(signal) < 100
    assert signal.times[-1] == 0.099
    assert any("is damaged at byte" in words for words in log.assumed)


def test_data_that_were_appended_to_a_cut_file_are_read(path):
    whole = rates(30).content
    flags = bytes(8) + b"\x01" + bytes(7) + struct.pack("<3Q", len(whole) - 5, 0, 0)
    content = rates(30, Written(flags)).content[:-5]
    number = struct.pack("<H", 0)
    later = message("D", number + struct.pack("<QQ3f", BEGAN, BEGAN + 10**6, 7, 8, 9))
    path.write_bytes(content + later)
    signal = read(path).signals["vehicle_angular_velocity.xyz"]
    assert len(signal) == 30
    np.testing.assert_array_equal(signal.values[-1], [7, 8, 9])


def test_messages_of_kinds_to_come_are_passed_over(path):
    log = read(rates(3, rates(3) + message("Z", bytes(50)), "vehicle_acceleration").save(path))
    assert [len(signal) for signal in log.signals.values()] == [3, 3]
    assert not any("byte" in words for words in log.assumed)


def test_fields_of_a_type_that_cannot_be_are_refused(path):
    written = rates().topic("int32_t esc_rpm", "esc_report")
    written.topic("uint64_t timestamp;float esc_count;esc_report[1] esc", "esc_status")
    written.subscribe("esc_status").data("Qfi", BEGAN, np.nan, 7, name="esc_status")
    with pytest.raises(LogError, match="cannot be read as PX4 ULog"):
        read(written.save(path))


def test_unknown_features_are_refused(path):
    flags = bytes(8) + b"\x02" + bytes(31)
    with pytest.raises(LogError, match="features that are not known here"):
        read(rates(written=Written(flags)).save(path))


def test_a_topic_without_time_costs_only_its_own_messages(path):
    written = rates(10).topic("uint64_t timestimp;float value", "strange").subscribe("strange")
    written.data("Qf", BEGAN, 1, name="strange")
    written.data("QQ3f", BEGAN, BEGAN + 10**6, 7, 8, 9, name="vehicle_angular_velocity")
    log = read(written.save(path))
    assert len(log.signals["vehicle_angular_velocity.xyz"]) == 11
    assert any(words.startswith("1 of 12 messages were left out") for words in log.assumed)


def test_formats_that_explode_or_contain_themselves_are_not_followed(path):
    written = rates(10)
    written.topic("uint64_t timestamp;float[60000] a", "level0")
    for level in range(1, 8):
        written.topic(f"uint64_t timestamp;level{level - 1}[60000] a", f"level{level}")
    written.topic("uint64_t timestamp;endless a", "endless").subscribe("endless")
    written.subscribe("level7")
    # Formats stand before the topics, wherever the file has them.
    with limited():
        log = read(written.save(path))
    assert set(log.signals) == {"vehicle_angular_velocity.xyz"}


def test_zeros_at_the_end_are_passed_over_at_once(path):
    path.write_bytes(rates(30_000).content + bytes(500_000))
    with limited():
        log = read(path)
    assert len(log.signals["vehicle_angular_velocity.xyz"]) == 30_000
    assert any("500000 bytes were lost" in words for words in log.assumed)


def test_a_file_of_which_most_is_lost_is_refused(path):
    path.write_bytes(rates(30).content + bytes(500_000))
    with pytest.raises(LogError, match="are no messages"):
        read(path)
    path.write_bytes(rates(0).content)
    with pytest.raises(LogError, match="of 0 messages with data only 0 can be read"):
        read(path)
    path.write_bytes(b"ULog")
    with pytest.raises(LogError, match="byte 0: must begin with the header"):
        read(path)


def test_the_package_that_is_missing_is_named(path, monkeypatch):
    rates().save(path)
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(ImportError, match="need pyulog: pip install"):
        read(path)


def test_damaged_files(path):
    written = rates(60, rates(60, name="vehicle_acceleration"))
    logs = check_damages(read, written.save(path))
    assert len(logs) > 100
