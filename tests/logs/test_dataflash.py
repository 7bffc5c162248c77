"""Logs of ArduPilot: units, axes, instances and times of messages, and what damaged files give."""

import struct
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from lgvi.logs import LogError
from lgvi.logs import read as read_any
from lgvi.logs.dataflash import read

from .damages import check_damages, limited

HEAD = b"\xa3\x95"
CODES = {
    "a": "64s",
    "b": "b",
    "B": "B",
    "h": "h",
    "H": "H",
    "i": "i",
    "I": "I",
    "g": "e",
    "f": "f",
    "d": "d",
    "n": "4s",
    "N": "16s",
    "Z": "64s",
    "c": "h",
    "C": "H",
    "e": "i",
    "E": "I",
    "L": "i",
    "M": "B",
    "q": "q",
    "Q": "Q",
}
UNITS = {"s": "s", "#": "instance", "E": "rad/s", "o": "m/s/s", "O": "degC", "z": "Hz", "-": ""}
UNITS |= {"?": "UNKNOWN", "d": "deg", "h": "degheading", "G": "Gauss", "m": "m", "q": "rpm"}
UNITS |= {"D": "deglatitude", "U": "deglongitude", "n": "m/s", "Y": "us", "v": "V", "A": "A"}
MULTIPLIERS = {"-": 0, "?": 1, "0": 1, "A": 1e-1, "B": 1e-2, "C": 1e-3, "F": 1e-6, "G": 1e-7}
# Letters, labels, units and multipliers of messages, as a firmware has them.
MESSAGES = {
    "UNIT": ("QbZ", "TimeUS,Id,Label", "s--", "F--"),
    "MULT": ("Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    "FMTU": ("QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    "PARM": ("QNff", "TimeUS,Name,Value,Default", "s---", "F---"),
    "MSG": ("QZ", "TimeUS,Message", "s-", "F-"),
    "VER": ("QBHZ", "TimeUS,BT,BST,FWS", "s---", "F---"),
    "ARM": ("QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method", "s----", "F----"),
    "EV": ("QB", "TimeUS,Id", "s-", "F-"),
    "IMU": (
        "QBffffffIIfBBHH",
        "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
        "s#EEEooo--O--zz",
        "F-000000-----00",
    ),
    "GYR": ("QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ", "s#sEEE", "F-F000"),
    "ATT": ("Qcccccc", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", "sddddhh", "FBBBBBB"),
    "XKQ": ("QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", "s#????", "F-????"),
    "XKF1": ("QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD", "s#nnnmmm", "F-000000"),
    "MAG": ("QBhhhB", "TimeUS,I,MagX,MagY,MagZ,Health", "s#GGG-", "F-CCC-"),
    "RCOU": ("QHHHH", "TimeUS,C1,C2,C3,C4", "sYYYY", "F----"),
    "ESC": ("QBfff", "TimeUS,Instance,RPM,Volt,Curr", "s#qvA", "F-000"),
    "GPS": (
        "QBBIHLLf",
        "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt",
        "s#---DUm",
        "F----GG0",
    ),
    "ISBD": ("QHa", "TimeUS,N,x", "s--", "F--"),
}


class Written:
    """A log by the layout of its documentation."""

    def __init__(self, has_units=True, messages=None):
        self.content, self.numbers = b"", {"FMT": 128}
        self.letters = {"FMT": "BBnNZ"}
        messages = messages or MESSAGES
        self.add("FMT", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        for number, (name, (letters, labels, *_)) in enumerate(messages.items(), 1):
            self.numbers[name], self.letters[name] = number, letters
            length = 3 + struct.calcsize("<" + "".join(CODES[letter] for letter in letters))
            self.add("FMT", number, length, name.encode(), letters.encode(), labels.encode())
        if has_units:
            for key, unit in UNITS.items():
                self.add("UNIT", 0, ord(key), unit.encode())
            for key, factor in MULTIPLIERS.items():
                self.add("MULT", 0, ord(key), factor)
            for name, (_, _, units, factors) in messages.items():
                self.add("FMTU", 0, self.numbers[name], units.encode(), factors.encode())

    def add(self, name, *values):
        codes = "".join(CODES[letter] for letter in self.letters[name])
        self.content += HEAD + bytes([self.numbers[name]]) + struct.pack("<" + codes, *values)
        return self

    def save(self, path):
        path.write_bytes(self.content)
        return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "00000012.BIN"


def rates(count=100, written=None, sensors=2, name="IMU"):
    written = written or Written()
    for i in range(count):
        for sensor in range(sensors):
            rate, force = (i, 0.25 + sensor, -i), (0.5, 0, -9.75)
            rest = 0, 0, 25, 1, 1, 1000, 1000
            written.add(name, 2_000_000 + 10_000 * i, sensor, *rate, *force, *rest)
    return written


def test_a_vector_of_each_sensor(path):
    log = read(rates().save(path))
    assert log.kind == read_any(path).kind == "ArduPilot dataflash"
    for sensor in (0, 1):
        rate, force = (log.signals[f"IMU[{sensor}].{name}"] for name in ("Gyr", "Acc"))
        np.testing.assert_allclose(rate.times, 2 + 0.01 * np.arange(100), rtol=1e-15)
        i = np.arange(100)
        np.testing.assert_array_equal(rate.values, np.column_stack([i, 0 * i + 0.25 + sensor, -i]))
        np.testing.assert_array_equal(force.values, [[0.5, 0, -9.75]] * 100)
        assert (rate.unit, rate.quantity, rate.frame) == ("rad/s", "angular_velocity", "FRD")
        assert (force.unit, force.quantity, force.frame) == ("m/s²", "specific_force", "FRD")
        assert rate.components == ("X", "Y", "Z")
    np.testing.assert_array_equal(log.signal("IMU[1].Gyr.Y").values, 1.25)
    assert log.signals["IMU[0].GHz"].unit == "Hz"
    assert log.signals["IMU[0].T"].values.shape == (100,)
    assert not any("IMU[0].I" in name or "TimeUS" in name for name in log.signals)
    assert not any("damaged" in words or "ends at" in words for words in log.assumed)
    assert any("INS_GYRO_FILTER" in words for words in log.assumed)


def test_raw_samples_have_the_times_when_they_were_taken(path):
    written = Written()
    for i in range(5):
        written.add("GYR", 7_000_000, 0, 6_000_000 + 125 * i, i, 2 * i, 3 * i)
    log = read(written.save(path))
    signal = log.signals["GYR[0].Gyr"]
    np.testing.assert_allclose(signal.times, 6 + 125e-6 * np.arange(5), rtol=1e-15)
    np.testing.assert_array_equal(signal.values[:, 2], 3 * np.arange(5))
    assert list(log.signals) == ["GYR[0].Gyr"]
    assert any("SampleUS" in words and "GYR" in words for words in log.assumed)


def test_angles_and_other_hundredths(path):
    written = Written().add("ATT", 1_000_000, 0, -1234, 0, 567, 0, 17890)
    for units in (True, False):
        if not units:
            written = Written(has_units=False).add("ATT", 1_000_000, 0, -1234, 0, 567, 0, 17890)
        log = read(written.save(path))
        for name, value in (("Roll", -12.34), ("Pitch", 5.67), ("Yaw", 178.9)):
            signal = log.signals[f"ATT.{name}"]
            np.testing.assert_allclose(signal.values, [value])
            assert (signal.unit, signal.components) == ("deg", ())
        assert any("gives no units" in words for words in log.assumed) != units


def test_a_quaternion_goes_from_body_to_space(path):
    written = Written().add("XKQ", 5_000_000, 0, 0.5, 0.5, -0.5, 0.5)
    written.add("XKQ", 5_000_000, 1, 1, 0, 0, 0)
    log = read(written.save(path))
    signal = log.signals["XKQ[0].Q"]
    np.testing.assert_array_equal(signal.values, [[0.5, 0.5, -0.5, 0.5]])
    described = signal.order, signal.direction, signal.frame, signal.space, signal.quantity
    assert described == ("wxyz", "body to space", "FRD", "NED", "attitude")
    assert (signal.components, signal.unit) == (tuple("wxyz"), "1")
    assert any("from body to space" in words for words in log.assumed)


def test_position_and_velocity(path):
    log = read(Written().add("XKF1", 5_000_000, 0, 1, 2, 3, 4, 5, 6).save(path))
    position, velocity = log.signals["XKF1[0].P"], log.signals["XKF1[0].V"]
    np.testing.assert_array_equal(position.values, [[4, 5, 6]])
    assert (position.unit, position.quantity, position.space) == ("m", "position", "NED")
    assert position.components == ("N", "E", "D")
    np.testing.assert_array_equal(velocity.values, [[1, 2, 3]])
    assert (velocity.unit, velocity.quantity) == ("m/s", "")


@pytest.mark.parametrize(("has_units", "factor", "unit"), [(True, 1e-3, "G"), (False, 1, "mG")])
def test_magnetic_field(path, has_units, factor, unit):
    written = Written(has_units).add("MAG", 1_000_000, 0, 210, -30, 415, 1)
    signal = read(written.save(path)).signals["MAG[0].Mag"]
    np.testing.assert_allclose(signal.values, factor * np.array([[210, -30, 415]]))
    assert (signal.unit, signal.quantity, signal.frame) == (unit, "magnetic_field", "FRD")


def test_speeds_and_commands_of_motors(path):
    written = Written()
    for motor in range(4):
        written.add("ESC", 1_000_000 + motor, motor, 5000 + motor, 16, 2)
    written.add("RCOU", 1_000_000, 1500, 1501, 1502, 1503)
    log = read(written.save(path))
    for motor in range(4):
        signal = log.signals[f"ESC[{motor}].RPM"]
        np.testing.assert_array_equal(signal.values, [5000 + motor])
        assert (signal.unit, signal.quantity) == ("rpm", "rotor_speed")
    command = log.signals["RCOU.C2"]
    np.testing.assert_array_equal(command.values, [1501])
    assert (command.unit, command.quantity) == ("us", "")
    assert log.signals["ESC[0].Volt"].unit == "V"
    assert any("SERVO1_FUNCTION" in words for words in log.assumed)
    assert not any("RawRPM" in words for words in log.assumed)


def test_speeds_that_the_firmware_interpolates_are_told(path):
    messages = {"ESC": ("QBff", "TimeUS,Instance,RPM,RawRPM", "s#qq", "F-00")}
    written = Written(messages=MESSAGES | messages).add("ESC", 1_000_000, 0, 5050, 5100)
    log = read(written.save(path))
    speeds = [log.signals[f"ESC[0].{name}"] for name in ("RPM", "RawRPM")]
    assert [signal.quantity for signal in speeds] == ["rotor_speed", ""]
    assert any("`RawRPM` is the last reading" in words for words in log.assumed)


def test_older_messages_have_numbers_in_their_names_and_no_units(path):
    letters, labels = "Qffffff", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"
    messages = {"IMU": (letters, labels), "IMU2": (letters, labels), "ESC3": ("Qe", "TimeUS,RPM")}
    messages["CURR"] = "IhhL", "TimeMS,Volt,Throttle,Lat"
    written = Written(has_units=False, messages=messages)
    written.add("IMU2", 3_000_000, 1, 2, 3, 4, 5, 6).add("ESC3", 3_000_000, 12_345_00)
    written.add("CURR", 2500, 1200, 3, -351_332_423)
    log = read(written.save(path))
    rate, force = log.signals["IMU2.Gyr"], log.signals["IMU2.Acc"]
    assert (rate.unit, rate.quantity, rate.frame) == ("rad/s", "angular_velocity", "FRD")
    assert (force.unit, force.quantity) == ("m/s²", "specific_force")
    np.testing.assert_allclose(log.signals["ESC3.RPM"].values, [12345])
    assert log.signals["ESC3.RPM"].quantity == "rotor_speed"
    np.testing.assert_array_equal(log.signals["CURR.Volt"].times, [2.5])
    np.testing.assert_allclose(log.signals["CURR.Lat"].values, [-35.1332423])


def test_all_letters(path):
    letters = "QbBhHiIgfdqQM"
    labels = ",".join(["TimeUS", *(f"f{i}" for i in range(1, len(letters)))])
    messages = {"ALL": (letters, labels), "TXT": ("QnNZa", "TimeUS,a,b,c,d")}
    written = Written(has_units=False, messages=messages)
    whole = -5, 250, -30000, 60000, -2 * 10**9, 4 * 10**9
    values = (*whole, 0.5, -1.5, 1e100, -(2**40), 2**60)
    written.add("ALL", 1_000_000, *values, 7).add("TXT", 1, b"abcd", b"b", b"c", bytes(64))
    log = read(written.save(path))
    for i, value in enumerate((*values, 7), 1):
        np.testing.assert_array_equal(log.signals[f"ALL.f{i}"].values, [float(value)])
    assert len(log.signals) == 12


def test_messages_that_are_unlike_those_of_the_documentation(path):
    messages = dict(MESSAGES)
    messages["TEMP"] = "Qcc", "TimeUS,a,b", "sO?", "F?-"
    messages["XKF5"] = "Qf", "TimeUS,P", "sm", "F0"
    messages["SIMS"] = "Qffff", "TimeUS,Gyr,GyrX,GyrY,GyrZ", "s----", "F----"
    messages["TWO"] = "QBB", "TimeUS,a,a", "s--", "F--"
    messages["FEW"] = "QB", "TimeUS", "s-", "F-"
    messages["XYZ"] = "Qfff", "TimeUS,X,Y,Z", "s---", "F---"
    written = Written(messages=messages).add("TEMP", 1_000_000, 2150, -50)
    written.add("XKF5", 1_000_000, 7).add("SIMS", 1_000_000, 1, 2, 3, 4).add("TWO", 1, 1, 2)
    written.add("FEW", 1, 1).add("XYZ", 1_000_000, 1, 2, 3)
    log = read(written.save(path))
    np.testing.assert_allclose(log.signals["TEMP.a"].values, [21.5])
    np.testing.assert_allclose(log.signals["TEMP.b"].values, [-0.5])
    assert (log.signals["TEMP.a"].unit, log.signals["TEMP.b"].unit) == ("degC", "")
    assert (log.signals["XKF5.P"].unit, log.signals["XKF5.P"].quantity) == ("m", "")
    assert {"SIMS.Gyr", "SIMS.GyrX", "XYZ.X"} <= set(log.signals)
    assert not any(name.startswith(("TWO", "FEW")) for name in log.signals)
    assert any(words.endswith("a second kind of their name: TWO, FEW.") for words in log.assumed)
    assert not any("damaged" in words for words in log.assumed)


@pytest.mark.parametrize("length", [20, 9])
def test_messages_of_another_length_than_their_fields_are_passed_over(path, length):
    written = rates(10).add("FMT", 200, length, b"ODD", b"QB", b"TimeUS,a")
    written.content += HEAD + bytes([200]) + bytes(length - 3)
    log = read(rates(10, written).save(path))
    assert len(log.signals["IMU[0].Gyr"]) == 20
    assert not any(name.startswith("ODD") for name in log.signals)
    assert not any("damaged" in words for words in log.assumed)


def test_a_format_is_the_first_one_of_its_number(path):
    written = rates(10)
    number, letters = written.numbers["IMU"], MESSAGES["IMU"][0]
    written.add("FMT", number, 56, b"IMX", letters.encode(), MESSAGES["IMU"][1].encode())
    assert len(read(written.save(path)).signals["IMU[0].Gyr"]) == 10


def test_numbers_that_are_none(path):
    content = rates(10, sensors=1).content
    place = content.rindex(struct.pack("<f", 0.25))
    path.write_bytes(content[:place] + bytes.fromhex("0100a07f") + content[place + 4 :])
    values = read(path).signals["IMU[0].Gyr"].values
    assert np.isnan(values[9, 1])
    assert np.isfinite(values).sum() == 29


def test_zeros_at_the_end_are_no_damage_to_the_rest(path):
    content = rates(30).content
    path.write_bytes(content + bytes(2 * len(content)))
    log = read(path)
    assert [len(log.signals[f"IMU[{sensor}].Gyr"]) for sensor in (0, 1)] == [30, 29]
    assert any("bytes that are no whole message" in words for words in log.assumed)


def test_armed_intervals(path):
    written = rates(10)
    for at, state in ((3, 1), (5, 0), (7, 1)):
        written.add("ARM", at * 1_000_000, state, 0, 0, 0)
    written.add("EV", 4_000_000, 11).add("ATT", 9_000_000, 0, 0, 0, 0, 0, 0)
    assert read(written.save(path)).armed == ((3.0, 5.0), (7.0, 9.0))
    written = rates(10)
    for at, event in ((3, 25), (4, 11), (6, 10)):
        written.add("EV", at * 1_000_000, event)
    assert read(written.save(path)).armed == ((2.0, 4.0), (6.0, 6.0))
    assert read(rates(10).save(path)).armed is None


def test_the_date_is_by_satellites(path):
    now = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)
    since = now - datetime(1980, 1, 6, tzinfo=UTC) + timedelta(seconds=18)
    week, milliseconds = (
        since // timedelta(weeks=1),
        since % timedelta(weeks=1) // timedelta(milliseconds=1),
    )
    written = rates(10)
    for _ in range(5):
        written.add("GPS", 1_000_000, 0, 1, 5, 2000, 0, 0, 0)
    for i in range(3):
        place = 473_000_000, -85_000_000, 400
        written.add("GPS", 10_000_000 + i * 200_000, 0, 3, milliseconds + i * 200, week, *place)
    log = read(written.save(path))
    assert log.start == now - timedelta(seconds=10)
    assert any("18 leap seconds" in words for words in log.assumed)
    latitude = log.signals["GPS[0].Lat"]
    np.testing.assert_allclose(latitude.values[5:], [47.3] * 3)
    assert latitude.unit == "deg"
    assert read(rates(10).save(path)).start is None


def test_facts(path):
    written = rates(10)
    written.add("MSG", 1, b"ArduCopter V4.5.1 (1b2c3d4e)").add("MSG", 2, b"EKF3 IMU0 started")
    written.add("PARM", 3, b"INS_GYRO_FILTER", 20, 20).add("PARM", 4, b"ATC_RAT_RLL_P", 0.135, 0)
    written.add("PARM", 9, b"INS_GYRO_FILTER", 40, 20).add("VER", 5, 3, 1024, b"4.5.1")
    log = read(written.save(path))
    assert log.facts == {
        "firmware": "ArduCopter V4.5.1 (1b2c3d4e)",
        "message 0": "ArduCopter V4.5.1 (1b2c3d4e)",
        "message 1": "EKF3 IMU0 started",
        "version TimeUS": "5",
        "version BT": "3",
        "version BST": "1024",
        "version FWS": "4.5.1",
        "parameter ATC_RAT_RLL_P": "0.135",
        "parameter INS_GYRO_FILTER": "20.0",
    }


def test_times_that_go_back_stay_and_are_told(path):
    written = Written()
    for at in (5000, 4000, 4000):
        written.add("ATT", at, 0, 0, 0, 0, 0, 0)
    log = read(written.save(path))
    np.testing.assert_array_equal(log.signals["ATT.Roll"].times, [0.005, 0.004, 0.004])
    assert "Times go back in the messages ATT; the order is that of the file." in log.assumed


def test_batches_are_told(path):
    log = read(rates(5).add("ISBD", 1, 2, bytes(64)).save(path))
    assert any("ISBH, ISBD" in words for words in log.assumed)
    assert not any("ISBD" in name for name in log.signals)


def test_bytes_that_look_like_a_header_are_data(path):
    look = struct.unpack("<f", HEAD + bytes([128, 0]))[0]
    written = Written()
    for i in range(50):
        rest = 0, 0, 25, 1, 1, 1000, 1000
        written.add("IMU", 10_000 * i, 0, look, look, i, look, 0, -9.75, *rest)
    log = read(written.save(path))
    values = log.signals["IMU[0].Gyr"].values
    np.testing.assert_array_equal(values, [[look, look, i] for i in range(50)])
    assert not any("damaged" in words for words in log.assumed)


@pytest.mark.parametrize("kind", ["missing", "zeros", "other"])
def test_reading_goes_on_at_the_next_message(path, kind):
    written = rates(200)
    begin, content = len(Written().content), written.content
    random = np.random.default_rng(2)
    for _ in range(30):
        place = int(random.integers(begin + 200, len(content) - 400))
        part = {"missing": b"", "zeros": bytes(100), "other": random.bytes(100)}[kind]
        path.write_bytes(content[:place] + part + content[place + 100 :])
        log = read(path)
        for sensor in (0, 1):
            signal = log.signals[f"IMU[{sensor}].Gyr"]
            i = np.rint((signal.times - 2) / 0.01)
            np.testing.assert_array_equal(signal.values[:, 0], i)
            np.testing.assert_array_equal(signal.values[:, 1], 0.25 + sensor)
            assert 196 <= len(signal) < 200
        words = next(words for words in log.assumed if "damaged in 1 places" in words)
        first = int(words.split("byte ")[1].split(":")[0])
        assert place - 200 < first <= place + 100


def test_a_file_that_is_cut_off_gives_what_is_whole(path):
    content = rates(30, sensors=1).content
    path.write_bytes(content[:-5])
    log = read(path)
    assert len(log.signals["IMU[0].Gyr"]) == 29
    size = len(rates(1, sensors=1).content) - len(Written().content)
    words = f"ends at byte {len(content) - size} with {size - 5} bytes"
    assert any(words in remark for remark in log.assumed)


def test_a_file_of_which_most_is_lost_is_refused(path):
    content = rates(30).content
    path.write_bytes(content + bytes([7]) * (2 * len(content)))
    with pytest.raises(LogError, match=r"is damaged: of \d+ bytes \d+ are no messages"):
        read(path)
    path.write_bytes(Written().content)
    with pytest.raises(LogError, match="must have messages with a time"):
        read(path)
    path.write_bytes(HEAD)
    with pytest.raises(LogError, match="is damaged"):
        read(path)


@pytest.mark.parametrize("part", [bytes(300_000), HEAD * 150_000, (HEAD + b"\x80") * 100_000])
def test_bytes_that_repeat_are_passed_over_at_once(path, part):
    content = rates(6000).content
    path.write_bytes(content + part)
    with limited():
        assert len(read(path).signals["IMU[0].Gyr"]) >= 5998


def test_damaged_files(path):
    written = rates(60)
    for i in range(40):
        written.add("ATT", 10_000 * i, 0, 1, 2, 3, 4, 5).add("XKQ", 10_000 * i, 0, 1, 0, 0, 0)
        written.add("GPS", 10_000 * i, 0, 3, 1000 * i, 2300, 1, 2, 3).add(
            "EV", 10_000 * i, 10 + i % 2
        )
    written.add("PARM", 3, b"INS_GYRO_FILTER", 20, 20).add("VER", 5, 3, 1024, b"4.5.1")
    logs = check_damages(read, written.save(path))
    assert len(logs) > 180
