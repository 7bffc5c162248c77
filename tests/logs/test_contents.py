"""The contents of a log are what was put into it."""

import json
import time
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from lgvi.logs import Log, describe
from lgvi.logs.contents import is_saturated
from lgvi.logs.signal import Signal

RATE = 200.0
T = np.arange(2000) / RATE


def smooth(t=T):
    """A motion (samples, 3) that is smooth at the rate of the samples."""
    return np.column_stack([np.sin(3 * t), 2 * np.cos(2 * t + 1), np.sin(t) + np.cos(5 * t)])


def noisy(sigma=0.02, seed=0):
    return smooth() + sigma * np.random.default_rng(seed).normal(size=(len(T), 3))


def contents_of(values, times=T, **options):
    signal = Signal("gyro", times, np.asarray(values, float), "rad/s", **options)
    return describe(Log("a.csv", "made", {"gyro": signal})).signals["gyro"]


def test_rate_range_and_times_are_those_of_the_samples():
    values = noisy()
    found = contents_of(values, T + 5)
    assert found.samples == 2000
    assert (found.begin, found.end) == (5.0, 5 + T[-1])
    np.testing.assert_allclose(found.rate, RATE, rtol=1e-6)
    np.testing.assert_allclose([found.lowest, found.highest], [values.min(0), values.max(0)])
    assert found.jitter < 1e-9
    assert found.components == ("0", "1", "2")
    assert not found.warnings()


def test_jitter_is_the_deviation_of_the_intervals_without_gaps():
    random = np.random.default_rng(1)
    intervals = (1 + 0.2 * random.uniform(-1, 1, 1999)) / RATE
    intervals[1000] = 3.0
    found = contents_of(noisy(), np.concatenate([[0], np.cumsum(intervals)]))
    np.testing.assert_allclose(found.jitter, 0.2 / np.sqrt(3) / RATE, rtol=0.05)
    assert f"intervals vary by {100 * found.jitter * RATE:.0f} %" in found.warnings()


def test_gaps_duplicates_and_times_that_go_back_are_counted():
    times = T.copy()
    times[700:] += 1.5
    times[1200:] += 0.01  # two samples are missing
    times[40] = times[39]  # and two intervals to the next one, which is no gap
    times[1501] = times[1500]
    times[1800] = times[1790]
    found = contents_of(noisy(), times)
    gaps = [(T[699], times[700]), (times[1199], times[1200]), (times[1800], times[1801])]
    np.testing.assert_allclose(found.gaps, gaps)
    assert (found.duplicates, found.backward) == (2, 1)
    text = "; ".join(found.warnings())
    assert "3 gaps, the longest of 1.5 s at 3.50 s" in text
    assert "2 times equal to the one before; 1 time before the one before" in text


def test_samples_without_a_number_are_counted_and_left_out():
    values = noisy()
    expected = contents_of(values)
    values[5:15, 1] = np.nan
    values[10:20, 2] = np.inf
    found = contents_of(values)
    assert found.missing == 15
    np.testing.assert_allclose(found.highest, expected.highest)
    np.testing.assert_allclose(found.noise, expected.noise, rtol=0.1)
    assert "15 samples without a number (NaN)" in found.warnings()


@pytest.mark.parametrize("sigma", [0.001, 0.02, 0.3])
def test_noise_is_told_apart_from_motion_and_from_hits(sigma):
    values = noisy(sigma)
    values[300:330] += 100 * np.random.default_rng(2).normal(size=(30, 3))
    np.testing.assert_allclose(contents_of(values).noise, [sigma] * 3, rtol=0.1)


def test_noise_is_unknown_where_the_motion_is_all_that_is_seen():
    assert np.isnan(contents_of(smooth()).noise).all()


@pytest.mark.parametrize("step", [0.01, 2000 / 2**15, 0.3])
@pytest.mark.parametrize("decimals", [12, 4])
def test_the_step_is_that_to_which_values_were_rounded(step, decimals):
    """Also after rounding again in a text."""
    values = np.round(np.round(noisy(0.3 * step) / step) * step + 0.05, decimals)
    found = contents_of(values)
    np.testing.assert_allclose(found.step, [step] * 3, rtol=3e-3)
    assert np.min(found.noise) >= 0.999 * np.min(found.step) / np.sqrt(12)
    few = "has only" in " ".join(found.warnings())
    assert few == (np.ptp(values, axis=0).min() < 50 * step)


def test_the_noise_of_a_sensor_that_reads_one_level_is_that_of_rounding():
    values = np.where(np.random.default_rng(0).random((2000, 3)) < 0.02, 0.01, 0.0)
    values[7] = -0.01
    np.testing.assert_allclose(contents_of(values).noise, [0.01 / np.sqrt(12)] * 3)


@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_numbers_that_were_not_rounded_have_no_step(precision):
    assert np.isnan(contents_of(noisy().astype(precision)).step).all()
    weight = 9.8 + 1e-4 * np.random.default_rng(0).normal(size=(2000, 3))
    assert np.isnan(contents_of(weight.astype(precision)).step).all()


def test_a_constant_component_is_named():
    values = noisy()
    values[:, 1] = 0.5
    found = contents_of(values, components=("x", "y", "z"))
    assert found.constant == ("y",)
    assert "constant: y" in found.warnings()
    assert contents_of(np.zeros(2000)).warnings() == ["constant"]


def test_saturation_at_a_known_limit_is_a_part_of_the_samples():
    values = np.clip(noisy(), -1.5, 1.5)
    found = contents_of(values, limit=1.5)
    np.testing.assert_allclose(found.saturated, np.mean(np.any(abs(values) == 1.5, axis=1)))
    assert found.saturated > 0.1
    assert any(words.startswith("saturated at 1.5: ") for words in found.warnings())
    assert contents_of(values, limit=1.6).saturated == 0
    values[:, 0] = np.nan
    assert any("saturated at 1.5: " in words for words in contents_of(values, limit=1.5).warnings())


@pytest.mark.parametrize("step", [None, 0.01])
def test_a_limit_that_is_not_known_is_seen_where_curves_are_cut_off(step):
    values = noisy(0.005) * 3
    if step is not None:
        values = np.round(values / step) * step
    assert not is_saturated(values).any()
    cut = np.clip(values, -4.0, 3.9)
    expected = np.any((cut == 3.9) | (cut == -4.0), axis=1)
    assert expected.any()
    np.testing.assert_array_equal(is_saturated(cut), expected)


@pytest.mark.parametrize(
    "values",
    [
        np.round(20 * smooth(T / 20)),  # smooth tops, of coarse steps
        np.repeat(noisy()[:400], 5, axis=0),  # each value five times
        np.where(T[:, None] < 3, 0, abs(noisy()) + 1),  # at rest first
        np.where(T[:, None] < 3, 0.5, abs(noisy()) + 1),  # at another small value first
        np.ones((2000, 3)),
        np.full((2000, 3), np.nan),
    ],
)
def test_values_that_repeat_for_other_reasons_are_no_limit(values):
    assert not is_saturated(values).any()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
@pytest.mark.parametrize("shape", [(), (3,)])
def test_a_few_samples_are_described(count, shape):
    found = contents_of(np.zeros((count, *shape)), T[:count])
    assert found.samples == count
    assert np.isnan(found.rate) == (count < 2)
    assert np.isnan(found.begin) == (count == 0)
    assert found.warnings() or count == 1


def log_of_all():
    values = noisy()
    values[5, 0] = np.nan
    gyro = Signal(
        "gyro",
        T,
        np.clip(values, -1.5, 1.5),
        "rad/s",
        quantity="angular_velocity",
        components=("x", "y", "z"),
    )
    name = "vehicle_angular_velocity_groundtruth[0].xyz"
    long = replace(gyro, name=name, times=T + 3, quantity="")
    signals = {"gyro": gyro, name: long, "empty": Signal("empty", T[:0], np.zeros((0, 3)))}
    return Log(
        "flight.ulg",
        "PX4 ULog",
        signals,
        start=datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC),
        armed=((2.0, 5.0), (3.0, 4.0)),
        assumed=(
            "The unit of time is taken as microseconds, " + "as the file does not tell. " * 9,
        ),
    )


def test_the_text_has_a_line_for_each_signal_and_fits_a_terminal():
    text = str(describe(log_of_all()))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 100
    assert lines[0] == "flight.ulg: PX4 ULog"
    assert "12.99 s, from 2024-05-06 07:08:09" in lines[1]
    (row,) = [line for line in lines if line.startswith("gyro ")]
    assert row.split()[1:6] == ["2000", "0.00", "9.99", "200", "rad/s"]
    following = lines[lines.index("vehicle_angular_velocity_groundtruth[0].xyz") + 1]
    assert following.split()[:3] == ["2000", "3.00", "12.99"]
    assert "angular velocity: gyro" in lines
    assert "disarmed: 0.00 to 2.00, 5.00 to 12.99 s" in lines
    assert "Warning: empty: there are no samples" in lines
    assert any(line.startswith("Warning: gyro: 1 sample without a number") for line in lines)
    assert any(line.startswith("Assumed: The unit of time") for line in lines)


def test_cells_that_are_full_stay_apart():
    values = np.array([-1.234e-5, -9.876e-5])
    log = Log("a.csv", "made", {"drift": Signal("drift", 999_999 + T[:2], values, "kg m²/s")})
    (row,) = [line for line in str(describe(log)).splitlines() if line.startswith("drift")]
    times = ["999999.00", "999999.01"]
    assert row.split() == ["drift", "2", *times, "200", "kg", "m²/s", "-9.88e-05", "-1.23e-05"]


def test_a_vehicle_that_is_always_armed_or_does_not_tell_has_no_disarmed_part():
    log = log_of_all()
    assert describe(replace(log, armed=((-1.0, 99.0),))).disarmed == ()
    assert "disarmed: never" in str(describe(replace(log, armed=((-1.0, 99.0),))))
    assert describe(replace(log, armed=None)).disarmed is None
    assert describe(replace(log, armed=())).disarmed == ((0.0, T[-1] + 3),)
    assert "disarmed" not in str(describe(replace(log, armed=None)))
    nothing = describe(Log("empty.csv", "made", {}, armed=()))
    assert nothing.disarmed == ()
    assert str(nothing).startswith("empty.csv: made")


def test_the_dictionary_is_json():
    read = json.loads(json.dumps(describe(log_of_all()).as_dict(), allow_nan=False))
    assert read["signals"]["gyro"]["samples"] == 2000
    assert read["signals"]["gyro"]["missing"] == 1
    assert read["signals"]["empty"]["rate"] is None
    assert read["disarmed"] == [[0.0, 2.0], [5.0, T[-1] + 3]]


def test_a_million_samples_take_less_than_a_second():
    times = np.arange(1_000_000) / 1000
    values = np.round(np.random.default_rng(0).normal(size=(1_000_000, 3)), 3)
    log = Log("long.csv", "made", {"gyro": Signal("gyro", times, values, "rad/s")})
    begin = time.process_time()
    describe(log)
    assert time.process_time() - begin < 1.0
