"""Logs that are named arrays, in Parquet files: times, units and signals are recognised."""

import datetime as dt
import sys
from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from lgvi.logs import LogError
from lgvi.logs import read as read_log
from lgvi.logs.columns import Column, make_log, read

from .damages import check_damages

TIMES = 0.01 * np.arange(20)
RATES = np.random.default_rng(0).normal(size=(20, 3))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.parquet"


def log_of(columns, time=None, time_unit=None):
    columns = {
        name: column if isinstance(column, Column) else Column(np.asarray(column))
        for name, column in columns.items()
    }
    return make_log(Path("file"), "kind", columns, time, time_unit, {}, [])


def save(path, columns, **metadata):
    table = pyarrow.table(columns)
    for name, words in metadata.items():
        place = table.schema.get_field_index(name)
        described = table.schema.field(place).with_metadata(words)
        table = table.set_column(place, described, table[name])
    parquet.write_table(table, path)
    return path


def test_a_parquet_file_is_recognised_and_read(path):
    save(path, {"t": TIMES, "gyro_x": RATES[:, 0]}, gyro_x={"unit": "deg/s", "frame": "FRD"})
    log = read_log(path)
    assert log.kind == "Parquet"
    signal = log.signals["gyro_x"]
    np.testing.assert_array_equal(signal.times, TIMES)
    np.testing.assert_array_equal(signal.values, RATES[:, 0])
    assert (signal.unit, signal.frame, signal.quantity) == ("deg/s", "FRD", "")
    assert list(log.signals) == ["gyro_x"]
    assert log.assumed == (
        "`t` is taken in s: it has no unit, and its steps are 0.01.",
        "The times are `t`, in s.",
    )


def test_a_date_that_is_missing_is_no_time(path):
    dates = pyarrow.array([0, None, 2], pyarrow.timestamp("s"))
    times = read(save(path, {"moment": dates, "x": np.arange(3)})).signals["x"].times
    np.testing.assert_array_equal(times, [0, np.nan, 2])


def test_units_may_be_in_the_names_of_columns(path):
    columns = {"t (s)": np.arange(20), "gyro.x [deg/s]": TIMES, "t_gyro": TIMES}
    log = read(save(path, columns))
    np.testing.assert_array_equal(log.signals["t_gyro"].times, range(20))
    assert log.signals["gyro.x [deg/s]"].unit == "deg/s"
    assert log.signals["t_gyro"].unit == ""


def test_cells_may_be_lists_records_empty_or_text(path):
    lists = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(RATES.ravel()), 3)
    counts = pyarrow.array([None, *range(1, 20)], pyarrow.int32())
    imu = [{"x": float(x), "flag": x > 0, "word": "a"} for x in RATES[:, 0]]
    gappy = [*RATES.tolist()[:-1], None]
    columns = {
        "time_s": TIMES,
        "gyro": lists,
        "accelerometer": RATES.tolist(),
        "gappy": gappy,
        "gappy too": pyarrow.array(gappy, pyarrow.list_(pyarrow.float64(), 3)),
        "imu": [*imu[:-1], None],
        "count": counts,
        "decimal": [None, *map(Decimal, range(1, 20))],
        "ragged": [[1.0] * (i % 3) for i in range(20)],
        "word": ["a"] * 20,
    }
    log = read(save(path, columns))
    left_out = {"time_s", "ragged", "word", "imu"}
    assert set(log.signals) == {*columns, "imu.x", "imu.flag"} - left_out
    for name in ("gyro", "accelerometer"):
        np.testing.assert_array_equal(log.signals[name].values, RATES)
        assert log.signals[name].components == ("0", "1", "2")
    for name in ("gappy", "gappy too"):
        np.testing.assert_array_equal(log.signals[name].values[:-1], RATES[:-1])
        assert np.isnan(log.signals[name].values[-1]).all()
    for name, expected in (("x", RATES[:, 0]), ("flag", RATES[:, 0] > 0)):
        np.testing.assert_array_equal(log.signals[f"imu.{name}"].values, [*expected[:-1], np.nan])
    for name in ("count", "decimal"):
        np.testing.assert_array_equal(log.signals[name].values, [np.nan, *range(1, 20)])
    assert log.assumed[0] == "Columns of other values were left out: word, imu.word, ragged."


@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_dates_are_times(path, zone):
    begin = dt.datetime(2024, 5, 6, 7, 8, 9, 500_000)
    dates = [begin + dt.timedelta(microseconds=1250 * i) for i in range(4)]
    moments = pyarrow.array(dates, pyarrow.timestamp("ns", tz=zone))
    log = read(save(path, {"moment": moments, "x": np.arange(4)}))
    np.testing.assert_array_equal(log.signals["x"].times, [0.5, 0.50125, 0.5025, 0.50375])
    expected = None if zone is None else begin.replace(microsecond=0, tzinfo=dt.UTC)
    assert log.start == expected


@pytest.mark.parametrize(
    ("name", "per_second"),
    [
        *[("t_us", 10**6), ("timestamp_ns", 10**9), ("time (ms)", 1000), ("TimeUS", 10**6)],
        *[("Time_seconds", 1), ("time [s]", 1), ("time_stamp_us", 10**6)],
    ],
)
def test_units_in_the_names_of_times(name, per_second):
    whole = np.arange(5) * per_second
    np.testing.assert_array_equal(log_of({name: whole, "x": whole}).signals["x"].times, range(5))


def test_times_may_be_missing():
    times = np.where(np.arange(20) == 3, np.nan, TIMES)
    np.testing.assert_array_equal(log_of({"t": times, "x": TIMES}).signals["x"].times, times)


def test_other_names_are_no_times():
    for name in ("ts", "tension", "test_s", "t0", "timer"):
        with pytest.raises(LogError, match="say which are the times"):
            log_of({name: TIMES, "x": TIMES})


def test_the_unit_of_the_file_and_that_of_the_user():
    whole = np.arange(5) * 1000
    declared = Column(whole, "milliseconds since 2024-01-01")
    np.testing.assert_array_equal(log_of({"t": declared, "x": whole}).signals["x"].times, range(5))
    log = log_of({"t": declared, "x": whole}, time_unit="us")
    np.testing.assert_array_equal(log.signals["x"].times, 1e-3 * np.arange(5))


@pytest.mark.parametrize(
    "times", [np.arange(5), np.arange(5.0), 2.5 * np.arange(5), 1e-6 * np.arange(5)]
)
def test_times_without_a_clear_unit_are_asked_for(times):
    with pytest.raises(LogError, match="`t`: must have a unit of time: say 's', 'ms'"):
        log_of({"t": times, "x": times})
    log = log_of({"t": times, "x": times}, time_unit="s")
    np.testing.assert_array_equal(log.signals["x"].times, times)


def test_unknown_units_are_refused(unchecked):
    with pytest.raises(LogError, match="the file says 'parsec'"):
        log_of({"t": Column(TIMES, "parsec"), "x": TIMES})
    with pytest.raises(LogError, match="check the unit"):
        log_of({"t": 10**18 + np.arange(5), "x": np.arange(5)}, time_unit="s")
    with pytest.raises(ValueError, match="Argument `time_unit` must be one of 's'"):
        log_of({"t": TIMES, "x": TIMES}, time_unit="h")


def test_late_times_are_exact():
    """Nanoseconds since 1970, which float64 does not resolve."""
    begin = 1_715_000_000_123_456_789
    log = log_of({"timestamp_ns": begin + np.arange(5), "x": np.arange(5)})
    times = log.signals["x"].times
    np.testing.assert_allclose(np.diff(times), 1e-9, rtol=1e-6)
    assert abs(times[0] - 0.123456789) < 1e-15
    assert "The zero of the times is 1715000000 s of the times in the file." in log.assumed
    assert log.start is None


def test_arrays_have_the_times_of_their_group_or_the_next_larger():
    late = TIMES[:7] + 100
    columns = {"t": TIMES, "speed": TIMES, "mocap.time": late, "mocap.body.q": np.ones((7, 4))}
    columns |= {"mocap.raw": np.ones(20), "mass": np.ones(5)}
    log = log_of(columns)
    np.testing.assert_array_equal(log.signals["speed"].times, TIMES)
    np.testing.assert_array_equal(log.signals["mocap.body.q"].times, late)
    assert set(log.signals) == {"speed", "mocap.body.q"}
    assert "All times are taken as times of one clock." in log.assumed
    left = "components, were left out: `mocap.raw` (20,), `mass` (5,)."
    assert any(words.endswith(left) for words in log.assumed)


def test_one_of_several_times_is_told_by_its_length_or_by_the_user():
    columns = {"t_s": TIMES, "time": TIMES[:7], "a": np.ones((20, 2)), "b": np.ones(7)}
    log = log_of(columns)
    assert (len(log.signals["a"]), len(log.signals["b"])) == (20, 7)
    columns = {"t_s": TIMES, "time": TIMES + 1, "a": np.ones(20), "group.b": np.ones(20)}
    with pytest.raises(LogError, match=r"array `a`: may belong to several times: .* t_s, time"):
        log_of(columns)
    log = log_of(columns, time="time")
    assert log.signals["a"].times[0] == log.signals["group.b"].times[0] == 1
    np.testing.assert_array_equal(log.signals["t_s"].values, TIMES)
    log = log_of(columns, time={"a": "t_s", "group": "time"})
    assert (log.signals["a"].times[0], log.signals["group.b"].times[0]) == (0, 1)
    same = log_of(columns | {"time": TIMES})
    assert set(same.signals) == {"a", "group.b"}


def test_times_under_any_name_are_told_by_the_user():
    columns = {"imu.clock": TIMES, "imu.gyro": RATES, "x": TIMES}
    for time in ("clock", "imu.clock", {"imu": "imu.clock"}):
        log = log_of(columns, time=time)
        np.testing.assert_array_equal(log.signals["imu.gyro"].times, TIMES)
    for time in ("tick", {"imu": "tick"}, {"tick": "imu.clock"}):
        with pytest.raises(LogError, match=r"`tick`: is not there; there are imu\.clock"):
            log_of(columns, time=time)


def test_samples_along_the_last_axis_are_turned():
    matrices = np.random.default_rng(0).normal(size=(20, 3, 3))
    columns = {"t": TIMES, "a": RATES.T, "b": matrices, "c": np.moveaxis(matrices, 0, -1)}
    columns |= {
        "square": np.arange(400).reshape(20, 20),
        "row": TIMES[None],
        "column": TIMES[:, None],
    }
    log = log_of(columns)
    np.testing.assert_array_equal(log.signals["a"].values, RATES)
    for name in "bc":
        np.testing.assert_array_equal(log.signals[name].values, matrices.reshape(20, 9))
    np.testing.assert_array_equal(log.signals["square"].values[1], range(20, 40))
    for name in ("row", "column"):
        np.testing.assert_array_equal(log.signals[name].values, TIMES)
    assert "`a` has its samples along the last axis." in log.assumed
    alike = "`square`, whose axes are alike, is taken with samples along the first."
    assert alike in log.assumed
    assert "The matrices of `b` are signals of their elements, row by row." in log.assumed


def test_a_file_without_times_or_arrays_is_refused(path):
    with pytest.raises(LogError, match=r"the times \(none\) and the arrays `x` \(20,\)"):
        read(save(path, {"x": TIMES}))
    with pytest.raises(LogError, match=r"the times \(none\) and the arrays \(none\)"):
        read(save(path, {"word": ["a", "b"]}))


def test_a_file_of_too_many_cells_is_refused(path, monkeypatch):
    """By what it declares, before it is read: a constant column of any length is a small file."""
    save(path, {"t": TIMES, "gyro": RATES.tolist()})  # twice 20 rows, and 60 cells in lists
    monkeypatch.setattr("lgvi.logs.columns.MOST_BYTES", 8 * 100)
    assert set(read(path).signals) == {"gyro"}
    monkeypatch.setattr("lgvi.logs.columns.MOST_BYTES", 8 * 99)
    monkeypatch.setattr(parquet.ParquetFile, "read", None)
    with pytest.raises(LogError, match="must have arrays of less than"):
        read(path)


def test_the_package_that_is_missing_is_named(path, monkeypatch):
    save(path, {"t": TIMES})
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match="need pyarrow: pip install"):
        read(path)


def test_damaged_files(path):
    columns = {"t": TIMES, "gyro_x": RATES[:, 0], "gyro": RATES.tolist(), "word": ["a"] * 20}
    columns["imu"] = pyarrow.array([{"g": [1.0, 2.0, 3.0]}, None] * 10)
    check_damages(read, save(path, columns))
