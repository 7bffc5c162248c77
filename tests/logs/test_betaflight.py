"""Logs of Betaflight and INAV: what was encoded comes back, with units and times; damaged files."""

import struct
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from lgvi.logs import LogError
from lgvi.logs import read as read_any
from lgvi.logs.betaflight.reading_blackbox import read

from .damages import check_damages, limited

PRODUCT = b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n"
BEGAN, PERIOD, LOOPS, EVERY = 5_000_000, 500, 32, 2  # us, us, loops to an intraframe, to a frame
REFERENCES = {4: 1070, 8: 1500, 9: 1680, 11: 158}


def unsigned(value):
    value &= 0xFFFFFFFF
    content = b""
    while value > 127:
        content += bytes([value & 127 | 128])
        value >>= 7
    return content + bytes([value])


def signed(value):
    return unsigned((value << 1) ^ (value >> 31))


def bits(*pairs):
    """Values of so many bits, the first ones highest."""
    text = "".join(format(value & ((1 << width) - 1), f"0{width}b") for value, width in pairs)
    return int(text, 2).to_bytes(len(text) // 8, "big")


def fit(value, width):
    return -(1 << width - 1) <= value < 1 << width - 1


def eight(values):
    if len(values) == 1:
        return signed(values[0])
    tag = sum(1 << i for i, value in enumerate(values) if value)
    return bytes([tag]) + b"".join(signed(value) for value in values if value)


def sized(values):
    sizes = [next(k for k in range(4) if fit(value, 8 * k + 8)) for value in values]
    content = bits((3, 2), *((size, 2) for size in sizes[::-1]))
    for value, size in zip(values, sizes, strict=True):
        content += value.to_bytes(size + 1, "little", signed=True)
    return content


def three(values):
    a, b, c = values
    if all(fit(value, 2) for value in values):
        return bits((0, 2), (a, 2), (b, 2), (c, 2))
    if all(fit(value, 4) for value in values):
        return bits((1, 2), (0, 2), (a, 4), (b, 4), (c, 4))
    if all(fit(value, 6) for value in values):
        return bits((2, 2), (a, 6), (0, 2), (b, 6), (0, 2), (c, 6))
    return sized(values)


def uneven(values):
    a, b, c = values
    if all(fit(value, 2) for value in values):
        return bits((0, 2), (a, 2), (b, 2), (c, 2))
    if fit(a, 5) and fit(b, 5) and fit(c, 4):
        return bits((1, 2), (a, 5), (b, 5), (c, 4))
    if fit(a, 8) and fit(b, 7) and fit(c, 7):
        return bits((2, 2), (a, 8), (b, 7), (c, 7))
    return sized(values)


def four(values):
    widths = [
        next(w for w in (0, 4, 8, 16) if (fit(value, w) if w else not value)) for value in values
    ]
    tag = bits(*(((0, 4, 8, 16).index(width), 2) for width in widths[::-1]))
    pairs = [(value, width) for value, width in zip(values, widths, strict=True) if width]
    if sum(widths) % 8:
        pairs.append((0, 4))
    return tag + (bits(*pairs) if pairs else b"")


ENCODERS = {  # fields that are packed together, and how
    0: (1, lambda values: signed(values[0])),
    1: (1, lambda values: unsigned(values[0])),
    3: (1, lambda values: unsigned(-values[0] & 0x3FFF)),
    6: (8, eight),
    7: (3, three),
    8: (4, four),
    9: (1, lambda values: b""),
    10: (3, uneven),
}
# Name, whether it is signed, predictor and encoding in intraframes and in interframes.
FIELDS = [
    ("loopIteration", 0, 0, 1, 6, 9),
    ("time", 0, 0, 1, 2, 0),
    *((f"axisP[{i}]", 1, 0, 0, 1, 0) for i in range(3)),
    *((f"axisI[{i}]", 1, 0, 0, 1, 7) for i in range(3)),
    *((f"rcCommand[{i}]", 1, 0, 0, 1, 8) for i in range(4)),
    ("vbatLatest", 0, 9, 3, 1, 6),
    ("amperageLatest", 1, 0, 0, 1, 6),
    ("rssi", 0, 0, 1, 1, 6),
    *((f"gyroADC[{i}]", 1, 0, 0, 3, 0) for i in range(3)),
    *((f"gyroUnfilt[{i}]", 1, 0, 0, 3, 10) for i in range(3)),
    *((f"accSmooth[{i}]", 1, 0, 0, 3, 0) for i in range(3)),
    *((f"imuQuaternion[{i}]", 1, 0, 0, 3, 0) for i in range(3)),
    ("motor[0]", 0, 11, 1, 3, 0),
    *((f"motor[{i}]", 0, 5, 0, 3, 0) for i in range(1, 4)),
    *((f"servo[{i}]", 0, 8, 6, 1, 6) for i in range(8)),
    ("debug[0]", 1, 4, 0, 0, 6),
    *((f"eRPM[{i}]", 0, 0, 1, 1, 0) for i in range(4)),
]
SLOW = [
    ("flightModeFlags", 0, 0, 1),
    ("stateFlags", 0, 0, 1),
    ("failsafePhase", 0, 0, 7),
    ("rxSignalReceived", 0, 0, 7),
    ("rxFlightChannelsValid", 0, 0, 7),
]
# All that INAV can log for a multirotor, in its order, but for the speed of the air.
INAV = [
    ("loopIteration", 0, 0, 1, 6, 9),
    ("time", 0, 0, 1, 2, 0),
    *((f"{name}[{i}]", 1, 0, 0, 1, 0) for name in ("axisRate", "axisP") for i in range(3)),
    *((f"axisI[{i}]", 1, 0, 0, 1, 7) for i in range(3)),
    *((f"{name}[{i}]", 1, 0, 0, 1, 0) for name in ("axisD", "axisF") for i in range(3)),
    *((f"mc{name}[{i}]", 1, 0, 0, 1, 0) for name in ("PosAxisP", *"PIDFO") for i in range(3)),
    *((f"mcSurface{name}", 1, 0, 0, 1, 0) for name in ("P", "I", "D", "Out")),
    *((f"rcData[{i}]", 1, 0, 0, 1, 8) for i in range(4)),
    *((f"rcCommand[{i}]", 1, 0, 0, 1, 8) for i in range(3)),
    ("rcCommand[3]", 0, 4, 1, 1, 8),
    ("vbat", 0, 9, 3, 1, 6),
    ("amperage", 1, 0, 0, 1, 6),
    *((f"magADC[{i}]", 1, 0, 0, 1, 6) for i in range(3)),
    ("BaroAlt", 1, 0, 0, 1, 6),
    ("surfaceRaw", 1, 0, 0, 1, 6),
    ("rssi", 0, 0, 1, 1, 6),
    *((f"gyro{name}[{i}]", 1, 0, 0, 3, 0) for name in ("ADC", "Raw", "Raw2") for i in range(3)),
    *((f"gyroPeak{name}[{i}]", 0, 0, 1, 3, 0) for name in ("Roll", "Pitch") for i in range(3)),
    *((f"accSmooth[{i}]", 1, 0, 0, 3, 0) for i in range(3)),
    ("accVib", 0, 0, 1, 3, 0),
    *((f"attitude[{i}]", 1, 0, 0, 3, 0) for i in range(3)),
    *((f"debug[{i}]", 1, 0, 0, 3, 0) for i in range(8)),
    ("motor[0]", 0, 4, 1, 3, 0),
    *((f"motor[{i}]", 0, 5, 0, 3, 0) for i in range(1, 4)),
    *((f"servo[{i}]", 0, 8, 0, 3, 0) for i in range(26)),
    *((name, 1, 0, 0, 1, 0) for name in ("navState", "navFlags", "navEPH", "navEPV")),
    *((f"navPos[{i}]", 1, 0, 0, 1, 0) for i in range(3)),
    *((f"nav{name}[{i}]", 1, 0, 0, 3, 0) for name in ("Vel", "TgtVel", "Acc") for i in range(3)),
]
INAV_SLOW = [
    ("activeWpNumber", 0, 0, 1),
    ("flightModeFlags", 0, 0, 1),
    ("stateFlags", 0, 0, 1),
    *((name, 0, 0, 7) for name in ("failsafePhase", "rxSignalReceived", "rxFlightChannelsValid")),
    ("rxUpdateRate", 0, 1, 1),
    ("IMUTemperature", 1, 0, 0),
    ("escTemperature", 1, 1, 0),
]
INAV_LINES = {
    "Firmware type": "Cleanflight",
    "Firmware revision": "INAV 8.0.0 (0f1d9b9d) MATEKF405",
    "P interval": "1/2",
}
HOME = [("GPS_home[0]", 1, 0, 0), ("GPS_home[1]", 1, 0, 0)]
GPS = [
    ("time", 0, 10, 1),
    ("GPS_numSat", 0, 0, 1),
    ("GPS_coord[0]", 1, 7, 0),
    ("GPS_coord[1]", 1, 7, 0),
]
LINES = {
    "Data version": 2,
    "Firmware type": "Betaflight",
    "Firmware revision": "Betaflight 4.5.1 (77d01ba3b) STM32F7X2",
    "Log start datetime": "0000-01-01T00:00:00.000+00:00",
    "Craft name": "Mücke",
    "I interval": LOOPS,
    "P interval": EVERY,
    "minthrottle": REFERENCES[4],
    "vbatref": REFERENCES[9],
    "motorOutput": f"{REFERENCES[11]},2047",
    "gyro_scale": "0x3f800000",
    "acc_1G": 2048,
    "motor_poles": 12,
    "looptime": 125,
}
NAMES = [field[0] for field in FIELDS]


class Written:
    """A log by the layout of its documentation."""

    def __init__(self, began: Any = BEGAN, fields: Any = FIELDS, slow: Any = SLOW, **lines: Any):
        self.content, self.fields = PRODUCT, fields
        for kind, fields in (("I", self.fields), ("S", slow), ("H", HOME), ("G", GPS)):
            for key, column in (("name", 0), ("signed", 1), ("predictor", 2), ("encoding", 3)):
                self.line(f"Field {kind} {key}", ",".join(str(field[column]) for field in fields))
        for key, column in (("predictor", 4), ("encoding", 5)):
            self.line(f"Field P {key}", ",".join(str(field[column]) for field in self.fields))
        for name, value in (LINES | lines).items():
            if value is not None:
                self.line(name, value)
        self.history: Any = ()
        self.began, self.home = began, (0, 0)

    def line(self, name, value):
        self.content += f"H {name}:{value}\n".encode()

    def encode(self, kind, fields, values):
        """A frame of some kind with such values."""
        column = 4 if kind == "P" else 2
        predictors = [field[column] for field in fields]
        encodings = [field[column + 1] for field in fields]
        last, before = self.history if self.history else (values, values)
        home, rests, first = iter(self.home), [], 0
        for i, (predictor, value) in enumerate(zip(predictors, values, strict=True)):
            first = value if fields[i][0] == "motor[0]" else first
            guesses = {
                1: last[i % len(last)],
                2: 2 * last[i % len(last)] - before[i % len(last)],
                3: int((last[i % len(last)] + before[i % len(last)]) / 2),
                5: first,
                6: value,
                7: next(home, 0) if predictor == 7 else 0,
                10: last[1],
            }
            rest = value - (guesses | REFERENCES).get(predictor, 0)
            rests.append((rest + 2**31) % 2**32 - 2**31)
        self.content += kind.encode()
        while rests:
            most, encoder = ENCODERS[encodings[0]]
            count = 1
            while count < most and encodings[count : count + 1] == encodings[:1]:
                count += 1
            self.content += encoder(rests[:count])
            rests, encodings = rests[count:], encodings[count:]
        return self

    def main(self, loop, numbers):
        """An intraframe or an interframe; numbers are those after the time."""
        values = [loop, (self.began + loop * PERIOD) % 2**32, *numbers]
        is_intra = loop % LOOPS == 0
        self.encode("I" if is_intra else "P", self.fields, values)
        self.history = values, values if is_intra else self.history[0]
        return self

    def event(self, content):
        self.content += b"E" + content
        return self

    def end(self):
        return self.event(b"\xffEnd of log\0")

    def save(self, path):
        path.write_bytes(self.content)
        return path


def motion(count=300, seed=0):
    """Whole numbers of all fields but the first two, of small and large steps."""
    random = np.random.default_rng(seed)
    size = random.choice([0, 1, 3, 12, 50, 200, 3000], (count, len(FIELDS) - 2))
    numbers = np.rint(size * random.uniform(-1, 1, size.shape)).astype(int)
    column = {name: NAMES.index(name) - 2 for name in NAMES[2:]}
    for name in column:
        if name[:5] in ("rssi", "motor", "servo", "eRPM["):
            numbers[:, column[name]] = abs(numbers[:, column[name]])
        if name.startswith("imu"):
            numbers[:, column[name]] *= 5
    numbers[:, column["axisI[0]"] : column["axisI[2]"] + 1] *= 1000
    numbers[:, column["vbatLatest"]] = random.integers(1500, 1800, count)
    return numbers


def record(numbers, written=None, first=0):
    written = written or Written()
    for i, values in enumerate(numbers.tolist()):
        written.main((first + i) * EVERY, values)
    return written


@pytest.fixture
def path(tmp_path):
    return tmp_path / "btfl_001.bbl"


def columns(numbers, name):
    return numbers[:, [i - 2 for i, field in enumerate(NAMES) if field.split("[")[0] == name]]


PLAIN = "axisP", "axisI", "rcCommand", "servo", "motor", "vbatLatest", "amperageLatest", "rssi"


def test_all_encodings_and_predictors_come_back(path):
    numbers = motion()
    log = read(record(numbers).end().save(path))
    for name in (*PLAIN, "debug"):
        values = columns(numbers, name)
        decoded = log.signals[name].values.reshape(values.shape)
        np.testing.assert_array_equal(decoded, values, err_msg=name)
        assert (log.signals[name].unit, log.signals[name].quantity) == ("", "")
    np.testing.assert_array_equal(log.signals["gyroADC"].values, columns(numbers, "gyroADC"))
    np.testing.assert_array_equal(log.signals["gyroUnfilt"].values, columns(numbers, "gyroUnfilt"))
    times = np.arange(len(numbers)) * EVERY * PERIOD / 1e6
    np.testing.assert_array_equal(log.signals["gyroADC"].times, times)
    assert not any("damaged" in words or "stops" in words for words in log.assumed)
    assert log.kind == read_any(path).kind == "Betaflight blackbox"
    assert log.facts["Craft name"] == "Mücke"
    assert log.facts["looptime"] == "125"


def test_times_begin_with_the_first_frame_and_the_clock_may_wrap(path):
    numbers = motion(100)
    for began in (1, 2**32 - 20 * PERIOD * EVERY, 2**32 - PERIOD * EVERY * LOOPS):
        log = read(record(numbers, Written(began)).save(path))
        times = np.arange(100) * EVERY * PERIOD / 1e6
        np.testing.assert_allclose(log.signals["gyroADC"].times, times, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(log.signals["motor"].values, columns(numbers, "motor"))


@pytest.mark.parametrize(
    ("lines", "factor", "unit"),
    [
        ({}, 1.0, "deg/s"),
        ({"blackbox_high_resolution": 1}, 0.1, "deg/s"),
        ({"gyro_scale": "0x3d79c190"}, struct.unpack(">f", b"\x3d\x79\xc1\x90")[0], "deg/s"),
        ({"gyro_scale": None, "gyro.scale": "0x3f800000"}, 1.0, "deg/s"),
        ({"gyro_scale": None}, 1.0, ""),
        ({"gyro_scale": "0x7fc00000"}, 1.0, ""),
        ({"gyro_scale": "0x3f8000"}, 1.0, ""),
        ({"Firmware type": "Baseflight", "Firmware revision": ""}, 1.0, ""),
    ],
)
def test_angular_velocity(path, lines, factor, unit):
    numbers = motion(50)
    signals = read(record(numbers, Written(**lines)).save(path)).signals
    for name in ("gyroADC", "gyroUnfilt"):
        signal = signals[name]
        np.testing.assert_allclose(signal.values, factor * columns(numbers, name), rtol=1e-12)
        assert (signal.unit, signal.quantity) == (unit, "angular_velocity")
        assert signal.components == ("x", "y", "z")


def test_range_of_gyroscopes(path):
    numbers = np.clip(motion(50), -2000, 2000)
    assert read(record(numbers).save(path)).signals["gyroADC"].limit == 1980
    numbers[7, NAMES.index("gyroADC[1]") - 2] = -3500
    signals = read(record(numbers).save(path)).signals
    assert np.isnan(signals["gyroADC"].limit)
    assert signals["gyroUnfilt"].limit == 1980
    log = read(record(numbers, Written(blackbox_high_resolution=1)).save(path))
    assert log.signals["gyroADC"].limit == 1980


def test_specific_force(path):
    numbers = motion(50)
    signal = read(record(numbers).save(path)).signals["accSmooth"]
    np.testing.assert_allclose(signal.values, columns(numbers, "accSmooth") / 2048)
    assert (signal.unit, signal.quantity, signal.frame) == ("g", "specific_force", "FLU")
    signal = read(record(numbers, Written(acc_1G=0)).save(path)).signals["accSmooth"]
    np.testing.assert_array_equal(signal.values, columns(numbers, "accSmooth"))
    assert (signal.unit, signal.quantity) == ("", "specific_force")


def test_a_part_of_a_vector_stays_as_it_is(path):
    numbers = motion(50)
    content = record(numbers, Written(blackbox_high_resolution=1)).content
    path.write_bytes(content.replace(b"gyroADC[2],", b"gyroADCx2],"))
    signal = read(path).signals["gyroADC"]
    np.testing.assert_array_equal(signal.values, columns(numbers, "gyroADC")[:, :2])
    assert (signal.unit, signal.quantity) == ("", "")


def test_speeds_of_motors_need_the_number_of_poles(path):
    numbers = motion(50)
    speeds = columns(numbers, "eRPM")
    log = read(record(numbers).save(path))
    signal = log.signals["motor_speed"]
    np.testing.assert_allclose(signal.values, speeds * 100 / 6)
    assert (signal.unit, signal.quantity) == ("rpm", "rotor_speed")
    assert signal.components == ("m0", "m1", "m2", "m3")
    assert "eRPM" not in log.signals
    assert any("12 poles" in words for words in log.assumed)
    log = read(path, motor_poles=14)
    np.testing.assert_allclose(log.signals["motor_speed"].values, speeds * 100 / 7)
    assert any("14 poles" in words for words in log.assumed)
    record(numbers, Written(motor_poles=None)).save(path)
    with pytest.raises(LogError, match="number of poles"):
        read(path)
    assert read(path, motor_poles=14).signals["motor_speed"].unit == "rpm"
    with pytest.raises(ValueError, match="`motor_poles` must be an even number, but is 7"):
        read(path, motor_poles=7)


def test_commands_of_motors_are_no_speeds(path):
    log = read(record(motion(50)).save(path))
    motor = log.signals["motor"]
    assert (motor.unit, motor.quantity, motor.components[:2]) == ("", "", ("m0", "m1"))
    assert any("commands from 158,2047" in words for words in log.assumed)


def test_a_quaternion_has_unit_length_and_goes_from_body_to_space(path):
    numbers = motion(50)
    quaternions = np.random.default_rng(3).normal(size=(50, 4))
    quaternions *= np.sign(quaternions[:, :1]) / np.linalg.norm(quaternions, axis=1)[:, None]
    first = NAMES.index("imuQuaternion[0]") - 2
    numbers[:, first : first + 3] = np.rint(quaternions[:, 1:] * 32767)
    signal = read(record(numbers).save(path)).signals["imuQuaternion"]
    np.testing.assert_allclose(signal.values[:, 1:], quaternions[:, 1:], atol=2e-5)
    np.testing.assert_allclose(signal.values[:, 0], quaternions[:, 0], atol=1e-2)
    np.testing.assert_allclose(np.linalg.norm(signal.values, axis=1), 1, rtol=1e-6)
    assert signal.components == tuple("wxyz")
    described = signal.order, signal.direction, signal.frame, signal.space, signal.quantity
    assert described == ("wxyz", "body to space", "FLU", "NWU", "attitude")


def test_a_log_of_inav(path):
    random = np.random.default_rng(2)
    numbers = random.integers(-900, 900, (100, len(INAV) - 2))
    numbers = np.where([not field[1] for field in INAV[2:]], abs(numbers), numbers)
    written = Written(fields=INAV, slow=INAV_SLOW, **INAV_LINES)
    for i, values in enumerate(numbers.tolist()):
        written.main(i * EVERY, values)
        if i in (3, 60):
            # Numbers are written as they are, although the header declares the frame before.
            written.content += b"S\x00" + unsigned(1 + (i == 3) * 4) + b"\x00" + three([0, 1, 1])
            written.content += unsigned(50 + i) + signed(251) + signed(-7)
        if i == 70:
            written.event(b"\x28\x02")
    log = read(written.event(b"\xffEnd of log (disarm reason:4)\0").save(path))
    names = [field[0].split("[")[0] for field in INAV[2:]]
    for name, signal in log.signals.items():
        if name in names:
            values = numbers[:, [i for i, other in enumerate(names) if other == name]]
            decoded = signal.values * (2048 if name == "accSmooth" else 1)
            np.testing.assert_array_equal(decoded.reshape(values.shape), values, err_msg=name)
    assert {*names} < {*log.signals}
    units = [log.signals[name].unit for name in ("gyroADC", "accSmooth", "attitude", "gyroRaw")]
    assert units == ["deg/s", "g", "", ""]
    assert {signal.frame for signal in log.signals.values()} == {""}
    np.testing.assert_array_equal(log.signals["rxUpdateRate"].values, [53, 110])
    np.testing.assert_array_equal(log.signals["escTemperature"].values, [-7, -7])
    assert log.armed == ((0.0, 0.099),)
    assert not any("damaged" in words or "stops" in words for words in log.assumed)


@pytest.mark.parametrize(
    ("kind", "revision", "frame"),
    [
        ("Betaflight", "Betaflight 4.5.1 (77d01ba3b) STM32F7X2", "FLU"),
        ("Cleanflight", "Betaflight 3.2.0 (1a2b3c4d5) SPRACINGF3", "FLU"),
        ("Cleanflight", "INAV 6.1.1 (0f1d9b9d) MATEKF405", ""),
        ("Cleanflight", "c49bd40", ""),
    ],
)
def test_axes_are_known_for_betaflight(path, kind, revision, frame):
    lines = {"Firmware type": kind, "Firmware revision": revision}
    log = read(record(motion(20), Written(**lines)).save(path))
    for name in ("gyroADC", "accSmooth", "imuQuaternion"):
        assert log.signals[name].frame == frame
    quaternion = log.signals["imuQuaternion"]
    assert quaternion.space == ("NWU" if frame else "")
    assert quaternion.direction == ("body to space" if frame else "")
    assert log.facts["Firmware revision"] == revision


def test_the_date_is_in_the_header(path):
    text = "2024-05-06T07:08:09.250+02:00"
    log = read(record(motion(20), Written(**{"Log start datetime": text})).save(path))
    assert log.start == datetime(2024, 5, 6, 5, 8, 9, 250_000, tzinfo=UTC)
    assert read(record(motion(20)).save(path)).start is None


def test_slow_frames_tell_when_the_switch_to_arm_was_on(path):
    numbers, written = motion(100), Written()
    for i, values in enumerate(numbers.tolist()):
        written.main(i * EVERY, values)
        if i in (2, 40, 70):
            written.encode("S", SLOW, [4 + (i != 70), 1, 9, -1, 40])
    log = read(written.end().save(path))
    flags = log.signals["flightModeFlags"]
    np.testing.assert_array_equal(flags.times, [0.002, 0.04, 0.07])
    np.testing.assert_array_equal(flags.values, [5, 5, 4])
    np.testing.assert_array_equal(log.signals["rxFlightChannelsValid"].values, [40, 40, 40])
    assert log.armed == ((0.0, 0.07),)
    np.testing.assert_array_equal(log.signals["gyroADC"].values, columns(numbers, "gyroADC"))
    assert read(record(numbers).save(path)).armed is None
    # The first flag of Cleanflight 1 is that the vehicle keeps itself level.
    path.write_bytes(written.content.replace(b"Betaflight 4.5.1 (77d01ba3b)", b"c49bd40"))
    log = read(path)
    np.testing.assert_array_equal(log.signals["flightModeFlags"].values, [5, 5, 4])
    assert log.armed is None


def test_positions_are_relative_to_the_last_home(path):
    numbers, written = motion(60), Written()
    home, place = (473_000_000, -85_000_000), [473_001_234, -85_004_321]
    for i, values in enumerate(numbers.tolist()):
        written.main(i * EVERY, values)
        if i == 20:
            written.encode("H", HOME, home).home = home
        if i in (10, 30):
            time = written.history[0][1] + 250
            written.encode("G", GPS, [time, 9, *place])
    log = read(written.end().save(path))
    signal = log.signals["GPS_coord"]
    np.testing.assert_allclose(signal.times, [0.01025, 0.03025])
    assert np.isnan(signal.values[0]).all()
    np.testing.assert_allclose(signal.values[1], [47.3001234, -8.5004321])
    assert signal.unit == "deg"
    np.testing.assert_array_equal(log.signals["GPS_numSat"].values, [9, 9])


def test_events_and_pauses_are_passed_over(path):
    numbers, written = motion(64), Written()
    events = (
        b"\x00\x90\x4e",
        b"\x1e\x05\x04",
        b"\x0d\x81\0\0\x80\x3f",
        b"\x0d\x06\x90\x01",
        b"\x0f\x04",
        b"\x14\x01\x05\x10\x27",
        *(bytes([number, 2]) for number in (40, 50, 51, 52)),
    )
    for i, values in enumerate(numbers.tolist()):
        paused = 100 * LOOPS if i >= 32 else 0
        if i == 32:
            loop = paused + i * EVERY
            written.event(b"\x0e" + unsigned(loop) + unsigned(BEGAN + loop * PERIOD))
        written.main(paused + i * EVERY, values)
        if i < len(events):
            written.event(events[i])
    log = read(written.end().save(path))
    times = (np.arange(64) * EVERY + np.repeat([0, 100 * LOOPS], 32)) * PERIOD / 1e6
    np.testing.assert_allclose(log.signals["motor"].times, times)
    np.testing.assert_array_equal(log.signals["motor"].values, columns(numbers, "motor"))
    assert not any("damaged" in words for words in log.assumed)


def test_several_logs_in_a_file(path):
    numbers = motion(1200)
    short, long = record(numbers[:100]).end().content, record(numbers).end().content
    path.write_bytes(b"other bytes\n" + short + bytes(50) + long + b"\xff" * 3000 + short)
    log = read(path)
    assert len(log.signals["gyroADC"]) == 1200
    assert any(words.startswith("Log 2 of 3 was read") for words in log.assumed)
    assert len(read(path, log=3).signals["gyroADC"]) == 100
    with pytest.raises(LogError, match="`log` must be from 1 to 3, but is 4"):
        read(path, log=4)
    path.write_bytes(short + long + long)
    with pytest.raises(LogError, match=r"1 \(0.096 s\), 2 \(1.18 s\), 3 \(1.18 s\); say which"):
        read(path)
    path.write_bytes(short + PRODUCT + long)
    assert len(read(path).signals["gyroADC"]) == 1200


@pytest.mark.parametrize(
    ("cut", "rest", "least"),
    [(0, b"\xff" * 5000, 100), (0, b"", 100), (0, bytes(50), 98), (5, b"", 98)],
)
def test_a_log_without_end(path, cut, rest, least):
    numbers = motion(100)
    content = record(numbers).content
    path.write_bytes(content[: len(content) - cut] + rest)
    log = read(path)
    motor = log.signals["motor"].values
    assert len(motor) >= least
    np.testing.assert_array_equal(motor, columns(numbers, "motor")[: len(motor)])
    assert any("without the event that ends it" in words for words in log.assumed)
    assert any("no frames follow" in words for words in log.assumed) == (least < 100)


def samples(log):
    motor = log.signals["motor"]
    return dict(zip(motor.times.round(6).tolist(), motor.values.tolist(), strict=True))


@pytest.mark.parametrize("kind", ["missing", "zeros", "other"])
def test_reading_goes_on_at_the_next_intraframe(path, kind):
    numbers = motion(320)
    content = record(numbers).end().content
    truth = samples(read(record(numbers).end().save(path)))
    random, told = np.random.default_rng(1), 0
    for _ in range(30):
        begin, size = int(random.integers(len(content) // 4, len(content) * 3 // 4)), 60
        part = {"missing": b"", "zeros": bytes(size), "other": random.bytes(size)}[kind]
        path.write_bytes(content[:begin] + part + content[begin + size :])
        log = read(path)
        values = samples(log)
        wrong = [time for time in values if values[time] != truth.get(time)]
        # Other bytes may be frames as well, of which those up to the next intraframe follow.
        assert len(wrong) <= (LOOPS // EVERY if kind == "other" else 1)
        assert len(truth) - 2 * LOOPS // EVERY - 4 <= len(values)
        assert list(values)[-1] == list(truth)[-1]
        told += any("damaged in 1 places" in words for words in log.assumed)
    assert told >= (25 if kind == "other" else 30)


def test_bytes_that_look_like_an_intraframe_are_left_out(path):
    numbers = motion(320)
    strange = Written(began=3_000_000_000)
    strange.content = b""
    record(numbers[:6], strange, first=40 * LOOPS // EVERY)
    truth = samples(read(record(numbers).end().save(path)))
    written = record(numbers[:160])
    written.content += strange.content
    log = read(record(numbers[160:], written, first=160).end().save(path))
    assert samples(log) == truth
    assert "6 frames were left out, as their times cannot be." in log.assumed


def test_positions_in_what_is_left_out_are_left_out(path):
    strange = Written(began=3_000_000_000)
    strange.content, strange.home = b"", (1, 2)
    numbers, home, place = motion(320), (473_000_000, -85_000_000), [473_001_234, -85_004_321]
    for i, values in enumerate(numbers[:6].tolist()):
        strange.main((40 + i) * LOOPS, values)
        strange.encode("H", HOME, (1, 2)).encode("G", GPS, [strange.history[0][1] + 250, 9, 1, 2])
    written = Written().encode("H", HOME, home)
    written.home = home
    for i, values in enumerate(numbers.tolist()):
        written.main(i * EVERY, values)
        if i in (100, 170):
            written.encode("G", GPS, [written.history[0][1] + 250, 9, *place])
        if i == 159:
            written.content += strange.content
    log = read(written.end().save(path))
    assert "6 frames were left out, as their times cannot be." in log.assumed
    signal = log.signals["GPS_coord"]
    np.testing.assert_allclose(signal.times, [0.10025, 0.17025], rtol=1e-12)
    np.testing.assert_allclose(signal.values, np.tile([47.3001234, -8.5004321], (2, 1)))


def test_times_do_not_go_back_after_a_damaged_one(path):
    numbers, written = motion(320), Written()
    for i, values in enumerate(numbers.tolist()):
        if i in (0, 21, 100, 250):
            written.began += 700_000
        elif i in (1, 22, 101, 251):
            written.began -= 700_000
        if i in (160, 161):
            written.began += 50_000 if i == 161 else -50_000
        if i == 317:
            written.began += 2_000_000
        written.main(i * EVERY, values)
    log = read(written.end().save(path))
    times = log.signals["motor"].times
    assert np.all(np.diff(times) >= 0)
    assert 200 <= len(times) <= 317
    assert times[-1] < 1.1


def test_interframes_without_end_are_left_out(path):
    numbers = motion(2100)
    written = Written()
    for i, values in enumerate(numbers.tolist()):
        written.main(i * LOOPS + 1 if i else 0, values)
    log = read(written.end().save(path))
    np.testing.assert_array_equal(log.signals["motor"].values, columns(numbers, "motor")[:2048])
    assert "52 frames were left out, as their times cannot be." in log.assumed


def test_a_damaged_line_of_the_header_is_told(path):
    content = record(motion(50)).end().content.replace(b"H Craft", b"X Craft")
    path.write_bytes(content)
    log = read(path)
    assert len(log.signals["gyroADC"]) == 50
    place = content.index(b"X Craft")
    assert f"A line of the header is damaged at byte {place}." in log.assumed
    assert "Craft name" not in log.facts


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (b"Data version:2", b"Data version:1", "must be 2, but is 1"),
        (b"Field P encoding:9,0", b"Field P encoding:9,4", "encodings that are not known here"),
        (b"Field P predictor:6,2", b"Field P predictor:6,7", "has the predictor 7"),
        (b"Field P encoding:9,", b"Field P encoding:", "a number for each of 44 fields"),
        (b"Field P encoding:9,", b"Field P encoding:x,", "whole numbers, but has 'x,0"),
        (b"H Field P predictor", b"H Field P predicter", "`Field P predictor` of the header: must"),
        (b"loopIteration,time", b"loopIteration,tame", "must have `time`"),
        (b"motor[0]", b"motor[9]", "must have `motor[0]`"),
        (b"H vbatref", b"H vbatrex", "line `vbatref` of the header: must be there"),
        (PRODUCT, b"", "must have a line `H Product:"),
    ],
)
def test_what_is_not_known_is_refused(path, before, after, words):
    content = record(motion(50)).end().content
    assert before in content
    path.write_bytes(content.replace(before, after))
    with pytest.raises(LogError, match=words.replace("[", r"\[")):
        read(path)


def test_a_log_of_which_most_is_lost_is_refused(path):
    numbers = motion(320)
    header = len(Written().content)
    content = record(numbers).end().content
    path.write_bytes(content[:header])
    with pytest.raises(LogError, match=f"byte {header}: must have frames, but has none"):
        read(path)
    size = len(content) - header
    middle = slice(header + size // 5, header + size * 4 // 5)
    path.write_bytes(content[: middle.start] + bytes(size * 3 // 5) + content[middle.stop :])
    with pytest.raises(LogError, match=r"is damaged: of \d+ bytes \d+ are no frames"):
        read(path)


@pytest.mark.parametrize("byte", [b"P", b"I", b"E", b"\xff", b"\x80", b"PI"])
def test_bytes_that_repeat_are_passed_over_at_once(path, byte):
    content = record(motion(50)).end().content
    path.write_bytes(content[:-13] + byte * (60_000 // len(byte)))
    with limited():
        try:
            assert len(read(path).signals["gyroADC"]) >= 48
        except LogError as error:  # such bytes may be frames as well
            assert "is damaged" in str(error)  # noqa: PT017


def test_damaged_files(path):
    numbers, written = motion(120), Written()
    for i, values in enumerate(numbers.tolist()):
        written.main(i * EVERY, values)
        if i % 20 == 3:
            written.encode("S", SLOW, [5, 1, 0, 1, 1]).event(b"\x1e\x05\x04")
            written.encode("H", HOME, (1, 2)).home = (1, 2)
            written.encode("G", GPS, [written.history[0][1] + 9, 9, 12, 34])
    logs = check_damages(read, written.end().save(path))
    assert len(logs) > 100
