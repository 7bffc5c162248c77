"""Logs of Betaflight: what was encoded comes back, with units, axes, times; and damaged files."""

import struct
from datetime import UTC, datetime

import numpy as np
import pytest

from lgvi.logs import LogError
from lgvi.logs import read as read_any
from lgvi.logs.betaflight import read

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
    widths = [next(w for w in (0, 4, 8, 16) if (fit(value, w) if w else not value)) for value in values]
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

    def __init__(self, began=BEGAN, **lines):
        self.content = PRODUCT
        for kind, fields in (("I", FIELDS), ("S", SLOW), ("H", HOME), ("G", GPS)):
            for key, column in (("name", 0), ("signed", 1), ("predictor", 2), ("encoding", 3)):
                self.line(f"Field {kind} {key}", ",".join(str(field[column]) for field in fields))
        for key, column in (("predictor", 4), ("encoding", 5)):
            self.line(f"Field P {key}", ",".join(str(field[column]) for field in FIELDS))
        for name, value in (LINES | lines).items():
            if value is not None:
                self.line(name, value)
        self.history, self.began, self.home = None, began, (0, 0)

    def line(self, name, value):
        self.content += f"H {name}:{value}\n".encode()

    def encode(self, kind, fields, values):
        """A frame of some kind with such values."""
        column = 4 if kind == "P" else 2
        predictors = [field[column] for field in fields]
        encodings = [field[column + 1] for field in fields]
        last, before = self.history if self.history else (values, values)
        home, rests = iter(self.home), []
        for i, (predictor, value) in enumerate(zip(predictors, values, strict=True)):
            guesses = {
                1: last[i % len(last)],
                2: 2 * last[i % len(last)] - before[i % len(last)],
                3: int((last[i % len(last)] + before[i % len(last)]) / 2),
                5: values[NAMES.index("motor[0]") % len(values)],
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
        self.encode("I" if is_intra else "P", FIELDS, values)
        self.history = (values, values if is_intra else self.history[0])
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
        if name[:5] in ("vbatL", "rssi", "motor", "servo", "eRPM["):
            numbers[:, column[name]] = abs(numbers[:, column[name]])
        if name.startswith("imu"):
            numbers[:, column[name]] *= 5
    numbers[:, column["axisI[0]"] : column["axisI[2]"] + 1] *= 1000
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
        found = log.signals[name].values.reshape(values.shape)
        np.testing.assert_array_equal(found, values, err_msg=name)
        assert (log.signals[name].unit, log.signals[name].quantity) == ("", "")
    np.testing.assert_array_equal(log.signals["gyroADC"].values, columns(numbers, "gyroADC"))
    np.testing.assert_array_equal(log.signals["gyroUnfilt"].values, columns(numbers, "gyroUnfilt"))
    times = np.arange(len(numbers)) * EVERY * PERIOD / 1e6
    np.testing.assert_array_equal(log.signals["gyroADC"].times, times)
    assert not any("damaged" in words or "stops" in words for words in log.assumed)
    assert log.kind == read_any(path).kind == "Betaflight blackbox"
    assert log.facts["Craft name"] == "Mücke"
    assert log.facts["looptime"] == "125"
