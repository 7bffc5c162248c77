"""Grids of times and the levels of windows."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings
from lgvi.identification.segments.levels import (
    FEWEST_SAMPLES,
    MOST,
    SHORTEST_TURN,
    Level,
    cut_into_levels,
)
from lgvi.identification.segments.segment import cut_path, lay_out, whole_trajectories
from lgvi.identification.start.guess import guess_states
from lgvi.identification.start.measured import largest_rates

from ...systems import GENERIC, euler_equations, rng, rotation

GRAVITY = np.array([0.0, 0.3, -1.5])


def spinning(times, omega, name="0", **given):
    """Attitudes of a sphere that turns at a constant rate."""
    attitude = Rotation.from_rotvec(np.outer(times - times[0], omega))
    return Recordings.from_arrays(times, attitude=attitude, name=name, **given)


def model_of(recorded):
    """A model with a sensor for each channel."""
    sensors = {
        "attitude": lgvi.AttitudeSensor(1e-3),
        "angular_velocity": lgvi.Gyroscope(1e-3),
        "position": lgvi.PositionSensor(np.array([0.1, 0.2, -0.1]), 0.1, GRAVITY, drag=0.1),
    }
    body = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 1.2, 1.5])
    return Model(body, [sensors[channel] for channel in recorded.channels])


def assert_each_begins_with_one_before(recorded, levels):
    longest_step = np.full(len(recorded), 10.0)
    chains = lay_out(recorded, levels, longest_step, model_of(recorded))
    for (before, of_before), (after, of_after) in pairwise(zip(levels, chains, strict=True)):
        kept = Level((of_after,)).starts_within(Level((of_before,)))
        assert [before[i].begin for i in kept] == [window.begin for window in after]


def recordings():
    random = rng(90)
    t = np.cumsum(random.uniform(0.01, 0.05, 60))
    gyroscope = t[3:50:2] + 0.003
    first = spinning(
        t,
        np.array([0.3, 0.2, 2.0]),
        angular_velocity=(gyroscope, np.ones((len(gyroscope), 3))),
        body_torque=(np.linspace(0, 3, 40), np.linspace(0, 3, 40)[:, None] * [1, 2, 3]),
    )
    t = np.arange(10) * 0.2
    second = spinning(
        t,
        np.array([0.0, 0.0, 1.0]),
        "1",
        angular_velocity=np.zeros((10, 3)),
        body_torque=(np.array([-1, 5.0]), np.zeros((2, 3))),
    )
    return Recordings.concatenate([first, second])


def table_of(recorded, windows, longest):
    """The segments of windows, and the times of their nodes (segments, nodes)."""
    (chains,) = lay_out(recorded, [windows], longest, model_of(recorded))
    found = chains.table(np.zeros(1))
    t = found.segments.start[:, None] + np.cumsum(np.pad(found.segments.dt, ((0, 0), (1, 0))), 1)
    return chains, found, t


def test_readings_are_at_their_times_and_no_step_is_too_long():
    recorded = recordings()
    longest = np.array([0.02, 0.07])
    _, table, t = table_of(recorded, whole_trajectories(recorded), longest)
    segments, window = table.segments, np.repeat(np.arange(2), table.counts)
    for channel, mask in segments.mask.items():
        samples = recorded.channels[channel]
        for i in range(2):
            some = mask & (window == i)[:, None]
            expected, value = samples.of(i)
            np.testing.assert_allclose(t[some], expected, atol=1e-13)
            np.testing.assert_array_equal(segments.readings[channel][some], value)
    assert np.all(segments.dt <= longest[window, None] * (1 + 1e-9))
    # Linear torques are what they are at all times, and each of their samples is one of these.
    first = window == 0
    expected = t[first][:, :, None] * [1, 2, 3]
    np.testing.assert_allclose(segments.inputs["body_torque"][first], expected, atol=1e-12)
    rates = segments.rates["body_torque"][first]
    np.testing.assert_allclose(rates, np.broadcast_to([1, 2, 3], rates.shape), atol=1e-9)
    for time in np.linspace(0, 3, 40):
        if t[first].min() < time < t[first].max():
            assert np.min(abs(t[first] - time)) < 1e-12


def test_segments_of_half_the_steps_have_the_same_readings():
    recorded = recordings()
    windows, longest = whole_trajectories(recorded), np.array([0.02, 0.07])
    chains, table, t = table_of(recorded, windows, longest)
    halved = chains.halve_steps()
    np.testing.assert_array_equal(halved.steps, 2 * chains.steps)
    fine = halved.table(np.zeros(1))
    of_fine = fine.segments.start[:, None]
    of_fine = of_fine + np.cumsum(np.pad(fine.segments.dt, ((0, 0), (1, 0))), 1)
    for channel, mask in table.segments.mask.items():
        expected = t[mask]
        np.testing.assert_allclose(of_fine[fine.segments.mask[channel]], expected, atol=1e-12)


def test_windows_grow_to_whole_trajectories_and_each_begins_with_one_before():
    t = np.arange(3000) * 0.01
    recorded = Recordings.concatenate(
        [spinning(t, np.array([0, 0, 3.0])), spinning(t[:20], np.array([0, 0, 1.0]), "1")]
    )
    speeds = largest_rates(model_of(recorded), recorded)
    np.testing.assert_allclose(speeds, [3, 1], rtol=0.01)
    levels = cut_into_levels(recorded, speeds)
    assert len(levels) > 2
    first = [window for window in levels[0] if window.trajectory == 0]
    assert len(first) > 30
    assert max(window.end - window.begin for window in first) * 3 == pytest.approx(
        SHORTEST_TURN, rel=0.02
    )
    assert [(w.trajectory, w.begin, w.end) for w in levels[-1]] == [(0, 0, t[-1]), (1, 0, t[19])]
    assert_each_begins_with_one_before(recorded, levels)
    lengths = [len(windows) for windows in levels]
    assert lengths == sorted(lengths, reverse=True)
    samples = [np.sum((w.begin <= t) & (t <= w.end)) for w in first]
    assert min(samples) >= FEWEST_SAMPLES // 2


@pytest.mark.parametrize("segment", [None, 900.0])
def test_of_long_recordings_there_are_samples_until_the_last_level(segment):
    t = np.arange(40_000) * 0.1
    recorded = Recordings.concatenate(
        [spinning(t[:length], np.array([0, 0, 3.0])) for length in (40_000, 30_000, 100)]
    )
    levels = cut_into_levels(recorded, np.full(3, 3.0), segment)
    lengths = [sum(window.end - window.begin for window in windows) for windows in levels]
    assert max(lengths[:3]) < MOST * FEWEST_SAMPLES * 0.1
    assert lengths[-1] == pytest.approx(7010, rel=0.01)
    assert_each_begins_with_one_before(recorded, levels)


def test_segments_have_samples_enough_however_short_they_are_wished():
    t = np.arange(100) * 0.03
    recorded = spinning(t, np.array([0.0, 0.0, 3.0]))
    levels = cut_into_levels(recorded, largest_rates(model_of(recorded), recorded), segment=0.05)
    assert len(levels[-1]) > 3
    for windows in levels:
        assert min(np.sum((w.begin <= t) & (t <= w.end)) for w in windows) >= FEWEST_SAMPLES


def test_a_wrong_reading_does_not_make_a_body_fast():
    t = np.arange(100) * 0.03
    rates = np.tile([0.0, 0.0, 3.0], (100, 1))
    rates[17] = 1e4
    recorded = spinning(t, np.array([0.0, 0.0, 3.0]), angular_velocity=rates)
    assert largest_rates(model_of(recorded), recorded) == pytest.approx([3], rel=0.01)


def ragged(long=60, count=9):
    """A long trajectory between short ones."""
    short = [spinning(np.arange(5) * 0.01, np.ones(3), name=str(i)) for i in range(count)]
    return Recordings.concatenate(
        [short[0], spinning(np.arange(long) * 0.01, np.ones(3), name="long"), *short[1:]]
    )


def test_a_long_trajectory_takes_no_room_in_short_ones():
    recorded = ragged(long=2_000, count=100)
    longest = np.full(len(recorded), 0.01)
    chains, table, _ = table_of(recorded, whole_trajectories(recorded), longest)
    np.testing.assert_array_equal(table.counts, -(-chains.steps // table.segments.dt.shape[1]))
    assert len(table.segments.dt) == np.sum(table.counts)
    assert sum(np.sum(mask) for mask in table.segments.mask.values()) == 2_000 + 100 * 5


def test_segments_follow_one_another_and_share_no_reading():
    t = np.arange(3000) * 0.01
    late = t[5:] + 0.004  # of another sensor, with nothing from 15 to 16 s
    late = late[(late < 15) | (late > 16)]
    first = spinning(t, np.array([0, 0, 3.0]), angular_velocity=(late, np.ones((len(late), 3))))
    short = spinning(t[:20], np.array([0, 0, 1.0]), "1", angular_velocity=np.ones((20, 3)))
    recorded = Recordings.concatenate([first, short])
    levels = cut_into_levels(recorded, largest_rates(model_of(recorded), recorded), segment=6.0)
    assert_each_begins_with_one_before(recorded, levels)
    *first, last = levels[-1]
    assert (last.trajectory, last.joined) == (1, False)
    assert [window.joined for window in first] == [True] * (len(first) - 1) + [False]
    np.testing.assert_allclose([w.end - w.begin for w in first], 6, rtol=0.01)

    chains, table, t = table_of(recorded, levels[-1], np.array([0.02, 0.07]))
    np.testing.assert_array_equal(chains.joined, [w.joined for w in levels[-1]])
    ends, starts = t[table.first + table.counts - 1, -1], t[table.first, 0]
    np.testing.assert_allclose(ends[: len(first) - 1], starts[1 : len(first)], atol=1e-12)
    for channel, mask in table.segments.mask.items():
        samples = recorded.channels[channel]
        # Each reading is in one segment, in the order in which it was recorded.
        found = table.segments.readings[channel][mask]
        np.testing.assert_array_equal(found, samples.value[samples.mask])


@pytest.mark.parametrize("noise", [0, 3e-3])
@pytest.mark.parametrize("kind", ["attitude", "angular_velocity"])
def test_starting_states_are_near_the_truth_without_any_guess(kind, noise):
    random, t = rng(91), 2.0 + np.arange(80) * 0.02
    omega = np.array([1.0, -2.0, 0.5])
    R, pi = euler_equations(rotation(92), GENERIC @ omega, GENERIC, t)
    attitude = Rotation.from_matrix(R) * Rotation.from_rotvec(noise * random.normal(size=(80, 3)))
    rates = np.linalg.solve(GENERIC, pi.T).T + noise * random.normal(size=(80, 3))
    values = {"attitude": attitude, "angular_velocity": rates}
    recorded = Recordings.from_arrays(t, **{kind: values[kind]})
    found = guess_states(
        model_of(recorded),
        recorded,
        whole_trajectories(recorded),
        largest_rates(model_of(recorded), recorded),
    )
    error = np.linalg.norm(found.omega[0] - omega) / np.linalg.norm(omega)
    assert error < 0.01 + 10 * noise
    if kind == "attitude":
        turn = Rotation.from_matrix(R[0]).inv() * Rotation.from_matrix(np.array(found.R[0]))
        assert turn.magnitude() < 1e-3 + 3 * noise


def test_a_state_begins_at_the_first_sample_of_either_sensor():
    t, omega = np.arange(40) * 0.02, np.array([0.0, 0.0, 2.0])
    late = spinning(t + 0.1, omega, angular_velocity=(t, np.tile(omega, (40, 1))))
    found = guess_states(
        model_of(late), late, whole_trajectories(late), largest_rates(model_of(late), late)
    )
    turn = np.arctan2(found.R[0, 1, 0], found.R[0, 0, 0])
    assert turn == pytest.approx(-0.2, abs=1e-6)


def test_a_body_at_rest_has_a_start():
    still = spinning(np.arange(10.0), np.zeros(3))
    speeds = largest_rates(model_of(still), still)
    found = guess_states(model_of(still), still, cut_into_levels(still, speeds)[0], speeds)
    np.testing.assert_allclose(found.omega, 0, atol=1e-12)


def test_a_time_offset_that_is_lost_is_named_and_takes_no_memory():
    t = np.arange(10) * 0.1
    samples = {"attitude": (t, np.tile(np.eye(3), (10, 1, 1))), "angular_velocity": (t, t[:, None])}
    (window,) = whole_trajectories(Recordings.from_arrays(t, attitude=samples["attitude"][1]))
    path = cut_path(samples, window, 0.01, {"angular_velocity": 1}, np.array([0.0, 0.05]))
    assert 90 <= path.steps.sum() <= 110
    with pytest.raises(RuntimeError, match=r"beyond the recordings \(`angular_velocity.time_off"):
        cut_path(samples, window, 0.01, {"angular_velocity": 1}, np.array([0.0, 1e12]))
