"""Delimited text comes back as it is, with what its header says, or is refused with the place."""

import gzip
import io
import resource
import subprocess
import sys
import time as clocks
import zipfile
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from lgvi.logs import LogError, read

from ..systems import rng
from .damages import check_damages

ROWS = [[0.0, 1.5, -2.25], [0.01, 2.5, 3.0], [0.02, 0.125, 4.0], [0.03, -7.0, 1e-3]]
VALUES = np.array(ROWS)
SENSORS = ("Gyroscope", "rad/s"), ("Acceleration", "m/s^2"), ("Magnetic field", "µT")


def write(path, text, encoding="utf-8"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


def table(header, rows, delimiter=",", decimal=".", end="\n"):
    cells = [[str(cell).replace(".", decimal) for cell in row] for row in rows]
    return end.join(delimiter.join(row) for row in [header, *cells]) + end


def assert_rows(log):
    """The rows above, as the signals `x` in deg/s and `y` without a unit."""
    assert {name: signal.unit for name, signal in log.signals.items()} == {"x": "deg/s", "y": ""}
    for i, signal in enumerate(log.signals.values()):
        np.testing.assert_array_equal(signal.times, VALUES[:, 0])
        np.testing.assert_array_equal(signal.values, VALUES[:, i + 1])
        assert (signal.quantity, signal.frame, signal.components) == ("", "", ())


HEADER = ["t [s]", "x [deg/s]", "y"]


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [
        *((",", "."), (", ", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", ".")),
        *((" ", "."), (" ", ","), ("   ", "."), (" \t ", ".")),
    ],
)
def test_the_dialect_is_recognised(delimiter, decimal, encoding, end, tmp_path):
    header = ["t_s", "x_dps", "y"] if delimiter.isspace() else ["t [s]", "x [°/s]", "y"]
    text = table(header, ROWS, delimiter, decimal, end)
    log = read(write(tmp_path / "log.csv", text, encoding))
    assert_rows(log)
    assert log.kind == "delimited text"
    mark = "\t" if "\t" in delimiter else delimiter.strip() or " "
    decimals = ", the decimal mark is ','" if decimal == "," else ""
    assert f"Cells are separated by {mark!r}{decimals}." in log.assumed
    assert "The names of columns are in line 1." in log.assumed
    assert ("The text is UTF-16." in log.assumed) == (encoding == "utf-16")
    assert "\N{ZERO WIDTH NO-BREAK SPACE}" not in "".join(log.assumed)  # the byte-order mark


@pytest.mark.parametrize(
    "text",
    [
        '"t [s]","x [deg/s]","y"\n"0.0","1.5","-2.25"\n"0.01","2.5","3"\n'
        '0.02,"0.125",4\n0.03,-7.0,"1e-3"\n',
        table([*HEADER, ""], [[*row, ""] for row in ROWS]),
        table(HEADER, [[*row, ""] for row in ROWS]),
        table([*HEADER, ""], ROWS),
        table(["#t [s]", *HEADER[1:]], ROWS),
        table(["% t [s]", *HEADER[1:]], ROWS),
        "# by a logger\n#\n\n" + table(HEADER, ROWS).replace("0.02,", "# a break\n\n0.02,"),
        "Device,Phone\nRate,100,Hz\n\n" + table(HEADER, ROWS),
        table(["t", "x", "y"], [["s", "deg/s", ""], *ROWS]),
        table(["t", "x", "y"], [["[s]", "[dps]", "[?]"], ["---", "---", "---"], *ROWS]),
        table(HEADER, [*ROWS, [",,"]]).replace(",,,", ",,"),
        table(HEADER, ROWS).replace("3.0\n", "3.0,\n"),
        table(HEADER, ROWS).replace(",", ",\t"),
        table(HEADER, ROWS).replace("2.5,", "\N{NO-BREAK SPACE}2.5,"),
        table(HEADER, ROWS) + "\0" * 4096,
        table(HEADER, ROWS)[:-1],
    ],
)
def test_what_is_around_samples_is_recognised(text, tmp_path):
    assert_rows(read(write(tmp_path / "log.csv", text)))


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("gyro_x [deg/s]", "gyro_x", "deg/s"),
        ("X (rad/s)", "X", "rad/s"),
        ("acc_x_g", "acc_x", "g"),
        ("gyro_x_rad_s", "gyro_x", "rad/s"),
        ("gyro_x_dps", "gyro_x", "deg/s"),
        ("acc_x_m_s2", "acc_x", "m/s²"),
        ("B x (µT)", "B x", "uT"),
        ("B x (\N{GREEK SMALL LETTER MU}T)", "B x", "uT"),
        ("w_x [rad s^-1]", "w_x", "rad/s"),
        ("w_x [rad s⁻¹]", "w_x", "rad/s"),
        ("a_x [m s^-2]", "a_x", "m/s²"),
        ("a_x (m/s/s)", "a_x", "m/s²"),
        ("a_x [m.s-2]", "a_x", "m/s²"),
        ("w_x [deg / s]", "w_x", "deg/s"),
        ("w_x_rad_per_s", "w_x", "rad/s"),
        ("v_x_m_s", "v_x", "m/s"),
        ("angle_rads", "angle_rads", ""),  # rad or rad/s
        ("gyro_r_min", "gyro_r_min", ""),  # the least
        ("force/N", "force", "N"),
        ("m/s", "m/s", ""),
        ("v_x [m s^-1]", "v_x", "m/s"),
        ("q_w []", "q_w", "1"),
        ("motor / rpm", "motor", "rpm"),
        ("gyro_x deg/s", "gyro_x", "deg/s"),
        ("motor[1]", "motor[1]", ""),
        ("motor [1/min]", "motor", "rpm"),
        ("acc (filtered)", "acc (filtered)", ""),
        ("Voltage (V)", "Voltage", "V"),
        ("ACC_X_G", "ACC_X_G", ""),  # gravity or gauss
    ],
)
def test_units_in_headers(header, name, unit, tmp_path):
    log = read(write(tmp_path / "log.csv", table(["t [s]", header], [[0, 1], [1, 2], [2, 3]])))
    assert [(signal.name, signal.unit) for signal in log.signals.values()] == [(name, unit)]


def test_units_that_are_given(tmp_path):
    file = write(tmp_path / "log.csv", table(HEADER, ROWS))
    log = read(file, units={"x [deg/s]": "rad/s", "y": "dps"})
    assert [signal.unit for signal in log.signals.values()] == ["rad/s", "deg/s"]
    assert "`x` is in rad/s, as given (the file says deg/s)." in log.assumed
    with pytest.raises(LogError, match=r"must have a column or signal `z`, .* has `x`, `y`"):
        read(file, units={"z": "g"})


def test_missing_cells_and_columns_of_words(tmp_path):
    cells = ["", "NaN", "nan", "-", "null", "NA", "1.5"]
    rows = [[i, cell, "ANGLE MODE" if i else 0] for i, cell in enumerate(cells)]
    file = write(tmp_path / "log.csv", table(["t [s]", "x", "mode"], rows))
    log = read(file)
    np.testing.assert_array_equal(log.signals["x"].values, [np.nan] * 6 + [1.5])
    assert list(log.signals) == ["x"]
    assert "Columns of words were left out: `mode`." in log.assumed


@pytest.mark.parametrize(
    ("header", "cells", "times"),
    [
        ("time [s]", ["0.5", "0.75"], [0.5, 0.75]),
        ("Time (ms)", ["500", "750.5"], [0.5, 0.7505]),
        ("time_us", ["500000", "750001"], [0.5, 0.750001]),
        ("time (us)", ["3000000001", "3000000002"], [3000.000001, 3000.000002]),
        ("TimeUS", ["500000", "750001"], [0.5, 0.750001]),
        ("timestamp_ns", ["1500000001", "1500000002"], [1.500000001, 1.500000002]),
        ("millis", ["1", "3"], [0.001, 0.003]),
        ("seconds_elapsed", ["1", "3"], [1, 3]),
        ("Time since start (s)", ["1", "1"], [1, 1]),
        ("t", ["0.25", "0.5", "0.375"], [0.25, 0.5, 0.375]),
        ("time", ["01:00:00.25", "01:00:00.5"], [3600.25, 3600.5]),
        ("time", ["23:59:59.9", "00:00:00.1", "00:00:01"], [86399.9, 86400.1, 86401]),
        ("time", ["23:59:59.9", "00:00:00.1", "23:59:59.95"], [86399.9, 86400.1, 86399.95]),
        ("micros", ["4294967290", "4", "14"], [4294.96729, 4294.9673, 4294.96731]),
        (
            "micros",
            ["4294967290", "4294967286", "4", "4294967295", "14"],
            [4294.96729, 4294.967286, 4294.9673, 4294.967295, 4294.96731],
        ),
        ("t_ms", ["65530", "65535", "4", "9"], [65.53, 65.535, 65.54, 65.545]),
        ("t_s", ["4294.967", "0.000704", "0.001704"], [4294.967, 4294.968, 4294.969]),
        ("t_s", ["50", "51", "1", "2"], [50, 51, 1, 2]),
    ],
)
def test_times(header, cells, times, tmp_path):
    rows = [[cell, i] for i, cell in enumerate(cells)]
    log = read(write(tmp_path / "log.csv", table([header, "x"], rows)))
    np.testing.assert_allclose(log.signals["x"].times, times, rtol=1e-15)
    np.testing.assert_array_equal(log.signals["x"].values, range(len(cells)))
    said = " ".join(log.assumed)
    assert ("begins again" in said) == (header in ("micros", "t_ms") or "704" in str(cells))
    assert ("after midnight" in said) == (cells[0] == "23:59:59.9")
    assert ("assumed to be in s" in said) == (header == "t")
    assert log.start is None


@pytest.mark.parametrize(
    ("cells", "start"),
    [
        (["2024-03-31T23:59:59.9Z", "2024-04-01T00:00:00.100000001Z"], 0),
        (["2024-03-31 23:59:59,9+02:00", "2024-04-01 00:00:00,100000001+0200"], 2),
        (["2024-03-31 23:59:59.9 UTC-01:00", "2024-04-01 00:00:00.100000001 UTC-01:00"], -1),
        (["2024-03-31 23:59:59.9+02", "2024-03-31 22:00:00.100000001 GMT"], 2),
        (["2024/03/31 23:59:59.9", "2024/04/01 00:00:00.100000001"], None),
    ],
)
def test_dates(cells, start, tmp_path):
    text = table(["DateTime", "x"], [[cell, i] for i, cell in enumerate(cells)], ";")
    log = read(write(tmp_path / "log.csv", text))
    np.testing.assert_allclose(log.signals["x"].times, [0.9, 1.100000001], rtol=1e-15)
    second = datetime(2024, 3, 31, 23, 59, 59, tzinfo=UTC)
    assert log.start == (None if start is None else second - timedelta(hours=start))


def test_dates_and_times_of_day_in_two_columns(tmp_path):
    rows = [["2024-03-31", "23:59:59.9", 1], ["2024-04-01", "00:00:00.1", 2]]
    file = write(tmp_path / "log.csv", table(["Date", "Time", "x"], rows))
    both: Any = {"time": ("Date", "Time")}
    for options in ({}, both):
        times = read(file, **options).signals["x"].times
        np.testing.assert_allclose(times, [0.9, 1.1], rtol=1e-15)
    file = write(tmp_path / "log.csv", table(["Date", "Time", "x"], rows).replace("04-01", "04-31"))
    with pytest.raises(
        LogError, match="line 3, column `Date`: must be a date, but is '2024-04-31'"
    ):
        read(file)


def test_long_clocks_keep_their_digits(tmp_path):
    nanoseconds = 1_403_636_579_758_555_392 + np.array([0, 5_000_193, 10_000_007])
    text = table(["timestamp [ns]", "x"], [[t, 1] for t in nanoseconds])
    exact = (nanoseconds - 1_403_636_579 * 10**9) / 1e9
    log = read(write(tmp_path / "log.csv", text))
    np.testing.assert_array_equal(log.signals["x"].times, exact)
    assert any("counted from 1403636579 s" in words for words in log.assumed)
    rows = [[f"{t // 10**9}.{t % 10**9:09d}", 1] for t in nanoseconds]
    text = table(["unix time (s)", "x"], rows, ";", ",")
    log = read(write(tmp_path / "log.csv", text))
    np.testing.assert_allclose(log.signals["x"].times, exact, rtol=1e-15)
    assert log.start == datetime.fromtimestamp(1_403_636_579, UTC)


def test_the_unit_of_time_is_not_guessed(tmp_path):
    for header, cells in (
        ("time", ["1000", "3500", "6000"]),
        ("time", ["0.5", "3500.5"]),
        ("t", ["1", "2", "3"]),
        ("timestamp", ["0.1", "0.2"]),
        ("Time (rad)", ["0.1", "0.2"]),
    ):
        file = write(tmp_path / "log.csv", table([header, "x"], [[cell, 1] for cell in cells]))
        place = f"line 1, column `{header.replace('(', '.').replace(')', '.')}`"
        with pytest.raises(LogError, match=rf"{place}: must have a unit.* write `time_unit=` one"):
            read(file)
        log = read(file, time_unit="us")
        np.testing.assert_allclose(log.signals["x"].times, np.array(cells, float) / 1e6)
        assert any("in us, as given" in words for words in log.assumed)
    file = write(tmp_path / "log.csv", table(HEADER, ROWS))
    log = read(file, time_unit="ms")
    np.testing.assert_allclose(log.signals["x"].times, VALUES[:, 0] / 1e3)
    assert "Times are `t [s]`, in ms, as given (the file says s)." in log.assumed


def test_each_sensor_may_have_its_times(tmp_path):
    rows = [[0, 1, 2, 10, 5], [1000, 3, 4, 2010, 6], [2000, 5, 6, "", ""], ["", "", "", 4010, 7]]
    header = ["gyro_t_us", "gx", "gy", "mag_t_us", "mx"]
    file = write(tmp_path / "log.csv", table(header, rows))
    names, headers = ("gyro_t", "mag_t"), ["mag_t_us", "gyro_t_us"]
    given: Any = ({}, {"time": names}, {"time": headers})
    for options in given:
        log = read(file, **options)
        np.testing.assert_array_equal(log.signals["gy"].times, [0, 1e-3, 2e-3])
        np.testing.assert_array_equal(log.signals["gy"].values, [2, 4, 6])
        np.testing.assert_array_equal(log.signals["mx"].times, [1e-5, 2.01e-3, 4.01e-3])
        np.testing.assert_array_equal(log.signals["mx"].values, [5, 6, 7])
    log = read(file, time="gyro_t")
    np.testing.assert_array_equal(log.signals["mx"].values, [5, 6, np.nan])
    np.testing.assert_array_equal(log.signals["mag_t"].values, [10, 2010, np.nan])


@pytest.mark.parametrize("names", [("gyro_t_s", "mag_t_s"), ("t [s]", "t [s]"), ("time", "time")])
def test_sensors_of_other_rates_end_before_others(names, tmp_path):
    header = ["{}", "m", "{}", "g"]
    slow = [[i / 10, i] for i in range(10)]
    rows = [[*(slow[i] if i < 10 else ["", ""]), i / 100 + 0.005, -i] for i in range(100)]
    log = read(write(tmp_path / "log.csv", table(header, rows).format(*names)))
    assert list(log.signals) == ["m", "g"]
    np.testing.assert_array_equal(log.signals["m"].times, np.array(slow)[:, 0])
    np.testing.assert_array_equal(log.signals["m"].values, np.arange(10))
    np.testing.assert_allclose(log.signals["g"].times, np.arange(100) / 100 + 0.005, rtol=1e-14)
    assert any("left out: 90" in words for words in log.assumed)


def test_names_that_repeat(tmp_path):
    header = ["t [s]", "x", "x", "x (2)", "x"]
    log = read(write(tmp_path / "log.csv", table(header, [[0, 1, 2, 3, 4], [1, 1, 2, 3, 4]])))
    assert {name: signal.values[0] for name, signal in log.signals.items()} == {
        "x": 1,
        "x (2)": 2,
        "x (2) (2)": 3,
        "x (3)": 4,
    }


def test_times_by_a_rate(tmp_path):
    text = "# Sample rate: 200 Hz\n" + table(["a", "b"], [[1, 2], [3, 4], [5, 6]])
    log = read(write(tmp_path / "log.csv", text))
    np.testing.assert_array_equal(log.signals["b"].times, [0, 0.005, 0.01])
    assert "Times are counted by the rate of 200 Hz." in log.assumed
    with pytest.raises(LogError, match="line 2: must have a column of time: write `time=` one of"):
        read(write(tmp_path / "log.csv", text.replace("Sample rate", "Battery")))


def test_a_table_without_a_header(tmp_path):
    file = write(tmp_path / "log.csv", table(["0", "1.5", "-2.25"], ROWS[1:]))
    log = read(file, time="0", time_unit="s")
    np.testing.assert_array_equal(log.signals["2"].values, VALUES[:, 2])
    assert "There is no header: columns have numbers, counted from 0, as names." in log.assumed
    with pytest.raises(LogError, match=r"log.csv: must have a column of time.* `0`, `1`, `2`"):
        read(file)


GOOD = table(HEADER, ROWS * 20)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.replace("0.02,0.125", "0.02,0.1z5", 1), "line 4, column `x .*`: .* number.* '0.1z5'"),
        (GOOD.replace("0.0,1.5", "0.0,1,5", 1), "line 2: must have 3 cells as the header, .* 4"),
        (GOOD.replace("0.02,0.125,4.0", "0.02,5"), "line 4, column `y`: is missing: the line ends"),
        (GOOD.replace("0.02,0.125,4.0", "0.02,5,4,3"), "line 4: must have 3 cells .*, but has 4"),
        (GOOD.replace("0.0,1.5", "0.0,x", 1), "line 2, column `x .*`: must be a number, .* 'x'"),
        (GOOD.replace("\n0.0,", "\nzero,", 1), "line 2, column `t .*`: must be a number.* 'zero'"),
        (GOOD.replace("0.02,", "x,"), "line 4, column `t .*`: must be a number, but is 'x'"),
        (
            GOOD.replace("\n0.03,", "\n1_0,"),
            "line 5, column `t .*`: must be a number, but is '1_0'",
        ),
        (GOOD.replace("\n0.03,", "\ninf,"), "line 5, column `t .*`: must be a time, but is 'inf'"),
        (GOOD + GOOD, "line 82: must be a sample, but repeats the header: divide the file"),
        (GOOD[:29] + "\n" + GOOD, "line 2: must not be in front of the header: divide the file"),
        (GOOD.replace("t [s],x [deg/s],y", "t [s],x"), "line 1: must have 3 names .*, but has 2"),
        (GOOD.replace("2.5", '"2.5', 1), "line 3: must have 3 cells as the header, but has 2"),
        (GOOD + '1,"2,3\n', "line 82, column `y`: is missing: the line ends before it"),
        (GOOD.replace("2.5", "2.5\x07"), "line 3: must be text in UTF-8, .*, but has the byte 7"),
        ("t_s,x\n1,2\n" + ",2\n" * 9, "line 3, column `t_s`: must be a time, but is ''"),
        (
            "t [s];x\n" + "1;2\n" * 30 + "1,5;2\n" + "1;2\n" * 300,
            r"line 32, .*write `decimal=','`",
        ),
        ("a,b\nwords,and\nmore,words\n", "must be a table of numbers"),
        ("t [s]\n0.5\n1\n", "must have a column of numbers besides the time"),
        ("\n \n", "must be a table of numbers"),
        ("1," * 600_000, "must have lines of at most"),
        (
            "31.12.2024 23:59:59,1;0\n" * 9,
            r"of times such as .*, but has '31.12.2024 23:59:59,1;0'",
        ),
        (b"\x89PNG\r\n\x1a\n\0\0\0", "must be text, but is a picture"),
        (gzip.compress(GOOD.encode(), mtime=0), "must be text, but is compressed: unpack it"),
        (GOOD.encode("utf-32"), "line 1: must be text in UTF-8, in Latin-1, or .* has the byte 0"),
        (
            "time,x\n" + "2024-01-01T00:00:00Z,1\n" * 3 + "2024-01-01T00:00:01,1\n",
            "line 5, column `time`: must be a date with a time zone, .*, but is '2024-01-01T00",
        ),
        ("t [min],x\n1,2\n2,3\n", r"column `t .min.`: must have a unit of time, but has 'min'"),
    ],
)
def test_a_bad_file_is_refused_with_the_place(text, message, tmp_path):
    file = write(tmp_path / "log.csv", text)
    with pytest.raises(LogError, match=f"log.csv.*{message}") as raised:
        read(file)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < len(str(file)) + 400


def test_a_file_that_is_cut_off_is_read_to_its_last_whole_line(tmp_path):
    for end in ("0.04", "0.04,", "0.04,1.5", "0.04,1.5,-", "0.04,1.5,-2e"):
        log = read(write(tmp_path / "log.csv", table(HEADER, ROWS) + end))
        if end != "0.04,1.5,-":
            assert_rows(log)
            assert "The file ends in the middle of line 6: the line was left out." in log.assumed
        else:
            assert any("may be cut off" in words for words in log.assumed)


def test_options_are_checked(tmp_path):
    file = write(tmp_path / "log.csv", table(HEADER, ROWS))
    wrong: Any = (
        ({"delimiter": ":"}, r"`delimiter` must be one of ',', ';'"),
        ({"decimal": ";"}, r"`decimal` must be one of '.', ','"),
        ({"delimiter": ",", "decimal": ","}, "`decimal` must not be the `delimiter`"),
        ({"time_unit": "h"}, r"`time_unit` must be one of 's', 'ms', 'us', 'ns'"),
        ({"units": "g"}, "`units` must give units by columns"),
        ({"units": {"x": 1}}, "`units` must give units by columns"),
        ({"time": [5.0]}, "`time` must be names of columns"),
        ({"time": 5}, "`time` must be names of columns"),
    )
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            read(file, **options)
    with pytest.raises(LogError, match=r"line 1: must have a column `z`, .* `x`"):
        read(file, time="z")
    file = write(tmp_path / "log.csv", table(HEADER, ROWS, ";", ","))
    assert_rows(read(file, delimiter=";", decimal=",", time="t", time_unit="s"))
    with pytest.raises(LogError, match="must be a"):
        read(file, delimiter="|")


def phyphox(delimiter=",", decimal=".", newer=True, metadata=True):
    """The files of an export of phyphox, and the samples of each sensor."""
    files, samples = {}, {}
    for i, (sensor, unit) in enumerate(SENSORS):
        rows = rng(i).normal(size=(5, 4))
        rows[:, 0] = 0.01 * np.arange(5) + i / 1000
        name = "Accelerometer" if sensor == "Acceleration" else sensor
        name = "Magnetometer" if sensor == "Magnetic field" else name
        axes = [f"{sensor} {axis}" for axis in "xyz"] if newer else ["X", "Y", "Z"]
        header = ['"Time (s)"', *(f'"{axis} ({unit})"' for axis in axes)]
        cells = [
            [f"{cell:.9E}".replace("E+0", "E").replace("E-0", "E-") for cell in row] for row in rows
        ]
        files[f"{name}.csv"] = table(header, cells, delimiter, decimal)
        samples[name] = np.array([[float(cell) for cell in row] for row in cells])
    d = delimiter
    files["meta/device.csv"] = (
        f'"property"{d}"value"\n"deviceModel"{d}"Pixel 7"\n"version"{d}"1.1.16"\n'
    )
    times = f'"event"{d}"experiment time"{d}"system time"{d}"system time text"\n'
    for event, experiment, system in (
        ("START", "1.5E0", 1616519405.312),
        ("PAUSE", "5E0", 1616519410.3),
    ):
        number = str(system).replace(".", decimal)
        times += f'"{event}"{d}{experiment}{d}{number}{d}"2021-03-23 18:10:05.312 UTC+01:00"\n'
    files["meta/time.csv"] = times
    return {name: text for name, text in files.items() if metadata or "meta" not in name}, samples


def pack(path, files):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize(
    ("delimiter", "decimal"), [(",", "."), ("\t", "."), (";", "."), ("\t", ","), (";", ",")]
)
@pytest.mark.parametrize("newer", [True, False])
def test_phyphox(newer, delimiter, decimal, packed, tmp_path):
    files, samples = phyphox(delimiter, decimal, newer)
    if packed:
        path = pack(tmp_path / "phone.zip", files)
    else:
        path = tmp_path / "phone"
        for name, text in files.items():
            write(path / name, text)
    log = read(path)
    assert log.kind == "CSV of phyphox"
    assert set(log.signals) == set(samples)
    quantities = {
        "Gyroscope": ("angular_velocity", "rad/s"),
        "Accelerometer": ("specific_force", "m/s²"),
        "Magnetometer": ("magnetic_field", "uT"),
    }
    for name, rows in samples.items():
        signal = log.signals[name]
        np.testing.assert_array_equal(signal.times, rows[:, 0])
        np.testing.assert_array_equal(signal.values, rows[:, 1:])
        assert (signal.quantity, signal.unit) == quantities[name]
        assert (signal.frame, signal.clock) == ("phone", "log")
        assert signal.components == ("x", "y", "z")
    assert log.facts["deviceModel"] == "Pixel 7"
    assert log.start == datetime(2021, 3, 23, 17, 10, 3, 812000, UTC)


def test_linear_acceleration_of_phyphox_is_no_specific_force(tmp_path):
    for title, axis in (
        ("Raw Data", "Linear Acceleration {}"),
        ("Linear Accelerometer", "{}"),
        ("Linear Acceleration", "{}"),
    ):
        header = [
            "Time (s)",
            *(f"{axis.format(name)} (m/s^2)" for name in "xyz"),
            "Absolute (m/s^2)",
        ]
        text = table(
            [f'"{cell}"' for cell in header],
            [[0, 1, 2, 3, 4], [0.1, 1, 2, 3, 4], [0.2, 1, 2, 3, 4]],
        )
        log = read(write(tmp_path / f"{title}.csv", text))
        assert list(log.signals) == ["Linear Acceleration", "Absolute"]
        assert log.signals["Linear Acceleration"].quantity == ""
        assert log.signals["Linear Acceleration"].frame == "phone"


def blackbox(units=True):
    header = ["loopIteration", "time (us)"]
    header += [f"gyroADC[{i}]{' (deg/s)' * units}" for i in range(3)]
    header += [f"accSmooth[{i}]{' (g)' * units}" for i in range(3)]
    header += [f"motor[{i}]" for i in range(4)] + [f"eRPM[{i}]" for i in range(4)]
    header += ["vbatLatest (V)", "flightModeFlags (flags)"]
    rows = []
    for i in range(40):
        numbers = [i, (2**32 - 10_000 + 500 * i) % 2**32, *range(i, i + 14), 16.1]
        mode = "ANGLE_MODE|HORIZON_MODE" if i == 7 else 0
        rows.append([*(f"{number:3}" for number in numbers), mode])
    return table(header, rows, ", ")


def test_blackbox_decode(tmp_path):
    log = read(write(tmp_path / "LOG00001.01.csv", blackbox()))
    assert log.kind == "CSV of blackbox_decode"
    gyroscope, force = log.signals["gyroADC"], log.signals["accSmooth"]
    np.testing.assert_allclose(np.diff(gyroscope.times), 5e-4, atol=1e-12)
    np.testing.assert_array_equal(gyroscope.values[5], [5, 6, 7])
    assert (gyroscope.quantity, gyroscope.unit, gyroscope.components) == (
        "angular_velocity",
        "deg/s",
        ("x", "y", "z"),
    )
    assert (force.quantity, force.unit) == ("specific_force", "g")
    np.testing.assert_array_equal(log.signals["motor"].values[0], [6, 7, 8, 9])
    assert log.signals["motor"].quantity == log.signals["eRPM"].quantity == ""
    assert log.signals["motor"].components == ("0", "1", "2", "3")
    assert log.signals["vbatLatest"].unit == "V"
    assert "Columns of words were left out: `flightModeFlags (flags)`." in log.assumed
    settings = "".join(f'"setting {i}","{i},{i + 1}"\n' for i in range(400))  # as of the explorer
    explored = settings + blackbox().replace("time (us)", "time")
    explored = read(write(tmp_path / "explored.csv", explored))
    np.testing.assert_array_equal(explored.signals["gyroADC"].times, gyroscope.times)
    assert explored.facts["setting 7"] == "7,8"
    mixed = blackbox().replace("gyroADC[1] (deg/s)", "gyroADC[1] (rad/s)")
    assert "gyroADC" not in read(write(tmp_path / "mixed.csv", mixed)).signals
    log = read(write(tmp_path / "LOG00001.01.csv", blackbox(units=False)))
    assert log.signals["gyroADC"].unit == log.signals["accSmooth"].unit == "raw"


def ulog2csv(path):
    """Files of topics, as ulog2csv names and writes them."""
    t = 100_000_000 + 4000 * np.arange(6)
    topics = {
        "vehicle_attitude_0": ["timestamp_sample", *(f"q[{i}]" for i in range(4)), "resets"],
        "sensor_gyro_0": ["x", "y", "z", "temperature"],
        "sensor_gyro_1": ["x", "y", "z", "temperature"],
        "sensor_combined_0": [f"gyro_rad[{i}]" for i in range(3)]
        + [f"accelerometer_m_s2[{i}]" for i in range(3)],
        "vehicle_local_position_0": ["x", "y", "z", "vx"],
        "esc_status_0": [f"esc[{i}].esc_rpm" for i in range(2)],
        "cpuload_0": ["load"],
    }
    for topic, fields in topics.items():
        rows = [[i, *range(len(fields))] for i in t]
        if topic.startswith("vehicle_attitude"):
            rows = [[i, i - 1000, 1, 0, 0, 0, 0] for i in t]
        write(path / f"log_7_2024_{topic}.csv", table(["timestamp", *fields], rows))
    return path


def test_ulog2csv(tmp_path):
    folder = ulog2csv(tmp_path / "flight")
    log = read(folder)
    assert log.kind == "CSV of ulog2csv, of PX4"
    attitude = log.signals["vehicle_attitude.q"]
    np.testing.assert_allclose(attitude.times, 99.999 + 0.004 * np.arange(6), rtol=1e-15)
    assert (attitude.order, attitude.direction) == ("wxyz", "body to space")
    assert (attitude.frame, attitude.space, attitude.quantity) == ("FRD", "NED", "attitude")
    assert log.signals["sensor_combined.gyro_rad"].unit == "rad/s"
    assert log.signals["sensor_combined.accelerometer_m_s2"].quantity == "specific_force"
    np.testing.assert_array_equal(log.signals["sensor_gyro[1].xyz"].values[0], [0, 1, 2])
    assert log.signals["sensor_gyro[0].xyz"].quantity == "angular_velocity"
    assert log.signals["vehicle_local_position.xyz"].space == "NED"
    assert log.signals["esc_status.esc_rpm"].quantity == "rotor_speed"
    np.testing.assert_allclose(log.signals["cpuload.load"].times[0], 100)
    assert {signal.clock for signal in log.signals.values()} == {"log"}
    alone = read(folder / "log_7_2024_vehicle_attitude_0.csv")
    np.testing.assert_array_equal(alone.signals["vehicle_attitude.q"].values, attitude.values)
    with pytest.raises(LogError, match="column `timestamp`: must have a unit"):
        read(folder / "log_7_2024_cpuload_0.csv")


def motive(rotation="Quaternion", unit="Meters", labels=True):
    axes = "XYZW" if rotation == "Quaternion" else "XYZ"
    name, number = ("Type", "Name") if labels else ("", "")
    kinds = [*["Rotation"] * len(axes), *["Position"] * 3]
    lines = [["", name], ["", number], ["", "ID"], ["", ""], ["Frame", "Time (Seconds)"]]
    for body in ("Cube", "Rod"):
        lines[0] += ["Rigid Body"] * (len(kinds) + 1)
        lines[1] += [body] * (len(kinds) + 1)
        lines[2] += ['"1"'] * (len(kinds) + 1)
        lines[3] += [*kinds, "Mean Marker Error"]
        lines[4] += [*axes, *"XYZ", ""]
    lines[0] += ["Marker"] * 3
    lines[1] += ['"Cube:Marker 1"'] * 3
    lines[2] += ['"9"'] * 3
    lines[3] += ["Position"] * 3
    lines[4] += "XYZ"
    width = len(lines[0])
    first = (
        "Format Version,1.23,Take Name,Throw,Take Notes,,Capture Frame Rate,120.000000,"
        "Export Frame Rate,120.000000,Capture Start Time,2024-05-02 03.04.05.678 PM,"
        f"Rotation Type,{rotation},Length Units,{unit},Coordinate Space,Global\n\n"
    )
    rows = [[i, f"{i / 120:.6f}", *np.arange(width - 2) / 100 + i] for i in range(30)]
    rows[3][2:] = [""] * (width - 2)
    return first + "\n".join(map(",".join, lines)) + "\n" + table(map(str, rows[0]), rows[1:])


@pytest.mark.parametrize("labels", [True, False])
def test_optitrack(labels, tmp_path):
    log = read(write(tmp_path / "take.csv", motive(labels=labels)))
    assert log.kind == "CSV of OptiTrack Motive"
    rotation, position = log.signals["Cube.rotation"], log.signals["Cube.position"]
    np.testing.assert_allclose(rotation.times, np.arange(30) / 120, atol=1e-6)
    np.testing.assert_allclose(rotation.values[2], [2, 2.01, 2.02, 2.03])
    np.testing.assert_allclose(position.values[2], [2.04, 2.05, 2.06])
    np.testing.assert_allclose(log.signals["Rod.rotation"].values[0], [0.08, 0.09, 0.1, 0.11])
    assert np.isnan(rotation.values[3]).all()
    assert np.isnan(position.values[3]).all()
    assert (rotation.quantity, rotation.order) == ("attitude", "xyzw")
    assert (rotation.direction, rotation.unit) == ("body to space", "1")
    assert (position.quantity, position.unit) == ("position", "m")
    assert log.signals["Cube:Marker 1.position"].unit == "m"
    assert log.signals["Rod.mean marker error"].values[0] == 0.15
    assert log.facts["Take Name"] == "Throw"
    assert log.start is None  # the file gives the local time


def test_a_single_marker_of_optitrack(tmp_path):
    text = motive().split("\n")[0] + "\n\n,,Marker,Marker,Marker\n,,M,M,M\n,,9,9,9\n"
    text += ",,Position,Position,Position\nFrame,Time (Seconds),X,Y,Z\n"
    text += "".join(f"{i},{i / 100},1,2,3\n" for i in range(20))
    log = read(write(tmp_path / "take.csv", text))
    assert log.signals["M.position"].components == ("x", "y", "z")


def test_angles_and_units_of_optitrack(tmp_path):
    log = read(write(tmp_path / "take.csv", motive("ZYX", "Millimeters")))
    rotation = log.signals["Cube.rotation"]
    assert (rotation.order, rotation.unit, rotation.components) == ("ZYX", "deg", ("z", "y", "x"))
    np.testing.assert_allclose(rotation.values[1], [1.02, 1.01, 1])  # in the order of the turns
    assert log.signals["Cube.position"].unit == "mm"


def vicon(section="Segments", name="Subject:{}", axes=("RX", "RY", "RZ", "TX", "TY", "TZ")):
    units = ["mm" if "T" in axis or len(axis) == 1 else "deg" for axis in axes]
    units = ["" if len(axes) == 7 and unit == "deg" else unit for unit in units]
    bodies = [name.format(body) for body in ("Body", "Head")]
    groups = ",".join([",", *(body + "," * (len(axes) - 1) for body in bodies)])
    header = ["Frame", "Sub Frame", *axes, *axes]
    rows = [[i, 0, *np.arange(2 * len(axes)) / 10] for i in range(1, 21)]
    rows[4][2:] = [""] * 2 * len(axes)
    text = table(header, [["", "", *units, *units], *rows])
    return f"{section}\n100\n{groups}\n{text}\n"


def test_vicon(tmp_path):
    text = vicon() + vicon("Trajectories", "Subject:M{}", ("X", "Y", "Z"))
    log = read(write(tmp_path / "trial.csv", text))
    assert log.kind == "CSV of Vicon"
    rotation, position = log.signals["Subject:Head.rotation"], log.signals["Subject:Body.position"]
    np.testing.assert_allclose(rotation.times, np.arange(1, 21) / 100)
    np.testing.assert_allclose(rotation.values[0], [0.6, 0.7, 0.8])
    assert np.isnan(rotation.values[4]).all()
    assert (rotation.quantity, rotation.unit, rotation.order) == ("attitude", "deg", "")
    assert (position.quantity, position.unit) == ("position", "mm")
    marker = log.signals["Subject:MHead"]
    np.testing.assert_allclose(marker.values[1], [0.3, 0.4, 0.5])
    assert (marker.quantity, marker.unit) == ("position", "mm")
    with pytest.raises(LogError, match="line 32, column `X`: must be a number, but is 'x'"):
        read(
            write(
                tmp_path / "trial.csv",
                text.replace("\n1,0,0.0,0.1,0.2,0.3,0.4,0.5\n", "\n1,0,x,0.1,0.2,0.3,0.4,0.5\n"),
            )
        )


def test_attitudes_of_vicon_by_their_header(tmp_path):
    axes = ("RX", "RY", "RZ", "RW", "TX", "TY", "TZ")
    text = vicon("Objects", "Global Angle (Quaternion) {0}:{0}", axes)
    rotation = read(write(tmp_path / "trial.csv", text)).signals["Body:Body.rotation"]
    assert (rotation.order, rotation.direction, rotation.unit) == ("xyzw", "body to space", "1")
    text = vicon("Objects", "Global Angle (Helical) {0}:{0}")
    rotation = read(write(tmp_path / "trial.csv", text)).signals["Body:Body.rotation"]
    assert (rotation.order, rotation.direction) == ("rotation_vector", "body to space")


def test_samples_between_frames_of_vicon(tmp_path):
    rows = [[frame, sub, frame * 10 + sub] for frame in (1, 2, 3) for sub in range(10)]
    text = "Devices\n1000\n,,Plate,\n" + table(["Frame", "Sub Frame", "Fz"], [["", "", "N"], *rows])
    force = read(write(tmp_path / "trial.csv", text)).signals["Plate.Fz"]
    np.testing.assert_allclose(force.times, np.arange(10, 40) / 1000)
    assert force.unit == "N"


def tum(header=True):
    rows = [[f"1305031098.{i:04d}", 1, 2, 3, 0.5, 0.5, 0.5, -0.5] for i in range(0, 900, 100)]
    names = "# ground truth trajectory\n# file: 'x.bag'\n# timestamp tx ty tz qx qy qz qw\n"
    body = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    return names * header + body


@pytest.mark.parametrize("header", [True, False])
def test_tum(header, tmp_path):
    log = read(write(tmp_path / "groundtruth.txt", tum(header)))
    assert log.kind == "a trajectory of TUM"
    attitude, position = log.signals["attitude"], log.signals["position"]
    np.testing.assert_allclose(attitude.times, np.arange(9) / 100, atol=1e-15)
    np.testing.assert_array_equal(attitude.values[0], [0.5, 0.5, 0.5, -0.5])
    assert (attitude.order, attitude.direction) == ("xyzw", "body to space")
    assert (position.quantity, position.unit) == ("position", "")
    assert log.start == datetime.fromtimestamp(1305031098, UTC)
    with pytest.raises(LogError, match="must have a column of time"):
        read(write(tmp_path / "other.txt", tum(False).replace("-0.5", "-1.5")))


def euroc(folder):
    begin = 1_403_636_579_758_555_392
    axes = [
        f"{name}_{axis} [{unit}]"
        for name, unit in (("w_RS_S", "rad s^-1"), ("a_RS_S", "m s^-2"))
        for axis in "xyz"
    ]
    rows = [[begin + 5_000_000 * i, *range(6)] for i in range(8)]
    write(folder / "imu0" / "data.csv", table(["#timestamp [ns]", *axes], rows))
    axes = [f" p_RS_R_{axis} [m]" for axis in "xyz"] + [f" q_RS_{axis} []" for axis in "wxyz"]
    axes += [f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"]
    rows = [[begin + 1_000_000_000 + 5_000_000 * i, 1, 2, 3, 1, 0, 0, 0, 4, 5, 6] for i in range(8)]
    truth = table(["#timestamp", *axes], rows)
    write(folder / "state_groundtruth_estimate0" / "data.csv", truth)
    rows = [[begin, f"{begin}.png"], [begin + 1, f"{begin + 1}.png"]]
    write(folder / "cam0" / "data.csv", table(["#timestamp [ns]", "filename"], rows))
    return folder


def test_euroc(tmp_path):
    folder = euroc(tmp_path / "mav0")
    log = read(folder)
    rate, force = log.signals["imu0.w_RS_S"], log.signals["imu0.a_RS_S"]
    assert (rate.quantity, rate.unit, rate.frame) == ("angular_velocity", "rad/s", "IMU")
    assert (force.quantity, force.unit, force.frame) == ("specific_force", "m/s²", "IMU")
    attitude = log.signals["state_groundtruth_estimate0.q_RS"]
    np.testing.assert_array_equal(attitude.values[0], [1, 0, 0, 0])
    assert (attitude.order, attitude.direction, attitude.frame) == ("wxyz", "body to space", "IMU")
    assert attitude.times[0] - rate.times[0] == 1
    assert attitude.clock == rate.clock
    assert log.signals["state_groundtruth_estimate0.b_w_RS_S"].quantity == ""
    assert any("cam0" in words and "left out" in words for words in log.assumed)
    alone = read(folder / "state_groundtruth_estimate0" / "data.csv")
    assert list(alone.signals) == ["p_RS_R", "b_w_RS_S", "q_RS"]


def test_files_of_a_folder_have_clocks_of_their_own(tmp_path):
    write(tmp_path / "logs" / "a.csv", table(HEADER, ROWS))
    write(tmp_path / "logs" / "b.txt", table(HEADER, ROWS, "\t"))
    write(tmp_path / "logs" / "notes.txt", "Thrown by hand.\n")
    log = read(tmp_path / "logs", units={"y": "g"})
    assert {name: signal.clock for name, signal in log.signals.items()} == {
        "a.x": "a",
        "a.y": "a",
        "b.x": "b",
        "b.y": "b",
    }
    assert "notes.txt is no table of numbers: left out." in log.assumed
    assert log.signals["a.y"].unit == log.signals["b.y"].unit == "g"
    write(tmp_path / "logs" / "b.txt", table(HEADER, ROWS, "\t").replace("2.5", "2.5x"))
    with pytest.raises(LogError, match=r"b.txt, line 3, column `x .*`: must be a number"):
        read(tmp_path / "logs")
    write(tmp_path / "logs" / "b.txt", table(["mass", "length"], [[1, 2], [3, 4]]))
    log = read(tmp_path / "logs")
    assert list(log.signals) == ["a.x", "a.y"]
    assert "b has no time: left out." in log.assumed
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="must have 1 to 1000 files of text"):
        read(tmp_path / "empty")


def test_a_zip_file_cannot_fill_the_memory(tmp_path):
    head = table(HEADER, ROWS)
    bomb = pack(tmp_path / "bomb.zip", {"a.csv": head + "0.04,0,0\n" * 10_000_000})
    assert bomb.stat().st_size < 1e6
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LogError, match=r"bomb.zip, file `a.csv`: holds more text than"):
        read(bomb)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB
    many = pack(tmp_path / "many.zip", {f"{i}.csv": head for i in range(1001)})
    with pytest.raises(LogError, match=r"must have 1 to 1000 files of text .* has 1001"):
        read(many)
    for size in (5, 300):
        cut = write(tmp_path / "cut.zip", many.read_bytes()[:size])
        with pytest.raises(LogError, match=r"cut.zip: must be a whole zip file, but its end is"):
            read(cut)
    sheet = pack(tmp_path / "log.xlsx", {"xl/workbook.xml": "", "xl/a.csv": head})
    with pytest.raises(LogError, match="is a spreadsheet: save its sheets as CSV"):
        read(sheet)


def test_pyarrow_is_not_needed(tmp_path, monkeypatch):
    texts = [table(HEADER, ROWS), table(["t_s", "x_dps", "y"], ROWS, "  ")]
    texts += [
        table(HEADER, ROWS, ";", ","),
        table(HEADER, [[f" {a}", f"+{b}", c] for a, b, c in ROWS]),
    ]
    for text in texts:
        file = write(tmp_path / "log.csv", text.replace("+-", "-"))
        assert_rows(read(file))
        with monkeypatch.context() as without:
            without.setitem(sys.modules, "pyarrow", None)
            assert_rows(read(file))


def test_a_million_lines_take_seconds(tmp_path):
    rows = rng(0).normal(size=(1000, 6))
    lines = [",".join(f"{cell:.6f}" for cell in row) for row in rows]
    body = "\n".join(f"{1000 * i},{lines[i % 1000]}" for i in range(1_000_000))
    file = write(tmp_path / "log.csv", f"time (us),a,b,c,d,e,f\n{body}\n")
    read(write(tmp_path / "small.csv", table(HEADER, ROWS)))  # imports packages
    begin = clocks.process_time()
    log = read(file)
    assert clocks.process_time() - begin < 6  # of two processors
    assert len(log.signals["f"]) == 1_000_000
    np.testing.assert_allclose(log.signals["f"].values[-1], rows[-1, 5], atol=1e-6)


def zipped():
    packed = io.BytesIO()
    pack(packed, phyphox()[0])
    return packed.getvalue()


FORMATS = {
    "log.csv": lambda: table(HEADER, ROWS * 30).encode(),
    "log16.csv": lambda: table(HEADER, ROWS * 30, ";", ",").encode("utf-16"),
    "dates.csv": lambda: table(
        ["time", "x"], [[f"2024-01-01T00:00:{i:02d}.5Z", i] for i in range(60)]
    ).encode(),
    "phone.zip": zipped,
    "Gyroscope.csv": lambda: phyphox(";", ",")[0]["Gyroscope.csv"].encode() * 2,
    "LOG00001.01.csv": lambda: blackbox().encode(),
    "take.csv": lambda: motive().encode(),
    "trial.csv": lambda: (vicon() + vicon("Trajectories", "M{}", ("X", "Y", "Z"))).encode(),
    "groundtruth.txt": lambda: tum().encode(),
    "x_vehicle_attitude_0.csv": lambda: table(
        ["timestamp", *(f"q[{i}]" for i in range(4))], [[1000 * i, 1, 0, 0, 0] for i in range(50)]
    ).encode(),
}


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_refused_or_read(name, tmp_path):
    logs = check_damages(read, write(tmp_path / name, FORMATS[name]()))
    assert 0 < len(logs) < 200
    for log in logs:
        assert log.signals
        for signal in log.signals.values():
            assert signal.times.shape == signal.values.shape[:1]
            assert np.isfinite(signal.times).all()


def test_lines_that_are_lost_are_no_other_values(tmp_path):
    text = table(HEADER, [[i, i * i % 97, -i] for i in range(500)])
    for seed in range(100):
        content = text.encode()[: np.random.default_rng(seed).integers(30, len(text))]
        log = read(write(tmp_path / "log.csv", content))
        times = log.signals["x"].times
        whole = slice(None) if content.endswith(b"\n") else slice(0, -1)
        np.testing.assert_array_equal(times[whole], np.arange(len(times))[whole])
        np.testing.assert_array_equal(log.signals["x"].values[whole], times[whole] ** 2 % 97)
        if not content.endswith(b"\n"):
            assert any(
                "cut off" in words or "in the middle of line" in words for words in log.assumed
            )


def test_reading_needs_no_jax():
    code = "import sys, lgvi.logs.delimited.reading_text; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
