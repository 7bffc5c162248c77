"""Grids of times and the levels of windows."""

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings
from lgvi.identification.least_squares.linearise import linearise_part
from lgvi.identification.least_squares.pieces import count_pieces
from lgvi.identification.model.configuration import ModelAt
from lgvi.identification.model.selection import body_of, select_free_leaves
from lgvi.identification.model.states import state_leaves
from lgvi.identification.windows.grid import whole_trajectories
from lgvi.identification.windows.initial_guess import guess_states
from lgvi.identification.windows.layout import lay_out
from lgvi.identification.windows.level import Level
from lgvi.identification.windows.measured import largest_rates
from lgvi.identification.windows.readings import simulate_readings_of
from lgvi.identification.windows.schedule import (
    FEWEST_SAMPLES,
    MOST,
    SHORTEST_TURN,
    cut_into_levels,
)

from ..systems import GENERIC, euler_equations, rng, rotation

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


def test_readings_are_at_their_times_and_no_step_is_too_long():
    recorded = recordings()
    longest = np.array([0.02, 0.07])
    (layout,) = lay_out(recorded, [whole_trajectories(recorded)], longest)
    (group,) = layout.groups
    windows = group.windows(np.arange(len(group)))
    t = np.asarray(windows.start)[:, None] + np.cumsum(np.pad(windows.dt, ((0, 0), (1, 0))), 1)
    for channel, readings in windows.readings.items():
        samples = recorded.channels[channel]
        for i in range(2):
            mask = np.asarray(readings.mask[i])
            expected, value = samples.of(i)
            np.testing.assert_allclose(t[i][readings.index[i][mask]], expected, atol=1e-13)
            np.testing.assert_array_equal(readings.value[i][mask], value)
    assert np.all(windows.dt[:2].max(1) <= longest * (1 + 1e-9))
    assert len(windows.dt) == len(recorded)
    # Linear torques are what they are at all times, and each of their samples is one of these.
    inside = slice(0, np.count_nonzero(windows.dt[0]) + 1)
    assert windows.body_torque is not None
    expected = t[0, inside, None] * [1, 2, 3]
    np.testing.assert_allclose(windows.body_torque[0, inside], expected, atol=1e-12)
    for time in np.linspace(0, 3, 40):
        if t[0, 0] < time < t[0, inside][-1]:
            assert np.min(abs(t[0] - time)) < 1e-12


@pytest.mark.parametrize("small", [True, False])
def test_refined_windows_take_steps_of_half_the_size_to_the_same_times(monkeypatch, small):
    if not small:
        monkeypatch.setattr("lgvi.identification.windows.layout.SMALL", 0)
    recorded = recordings()
    (layout,) = lay_out(recorded, [whole_trajectories(recorded)], np.array([0.02, 0.07]))
    assert (len(layout.groups) == 1) is small
    for group, refined in zip(layout.groups, layout.halve_steps().groups, strict=True):
        index = group.index
        np.testing.assert_array_equal(index, refined.index)
        windows, fine = (each.windows(np.arange(len(index))) for each in (group, refined))
        assert (fine.dt.shape == windows.dt.shape) is small
        assert np.asarray(fine.dt).max() == np.asarray(windows.dt).max() / 2
        t, of_fine = (
            np.asarray(each.start)[:, None] + np.cumsum(np.pad(each.dt, ((0, 0), (1, 0))), 1)
            for each in (windows, fine)
        )
        for channel, readings in windows.readings.items():
            same = fine.readings[channel]
            for i in range(len(index)):
                expected = t[i][readings.index[i]]
                np.testing.assert_allclose(of_fine[i][same.index[i]], expected, atol=1e-12)
        assert fine.body_torque is not None
        for i in np.flatnonzero(index == 0):
            inside = slice(0, np.count_nonzero(fine.dt[i]) + 1)
            expected = of_fine[i, inside, None] * [1, 2, 3]
            np.testing.assert_allclose(fine.body_torque[i, inside], expected, atol=1e-12)


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
    for before, after in pairwise(levels):
        kept = Level((after,), ()).starts_within(Level((before,), ()))
        assert [before[i].begin for i in kept] == [window.begin for window in after]
        assert len(after) <= len(before)
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
    for before, after in pairwise(levels):
        kept = Level((after,), ()).starts_within(Level((before,), ()))
        assert [before[i].begin for i in kept] == [window.begin for window in after]


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


def test_recordings_of_different_lengths_take_the_memory_of_their_samples():
    recorded = ragged(long=2_000, count=2_000)  # side by side they would be 4 million samples
    assert recorded.channels["attitude"].values.nbytes == (2_000 + 10_000) * 9 * 8
    longest = np.full(len(recorded), 0.01)
    for layout in lay_out(recorded, [whole_trajectories(recorded)], longest):
        held = [jax.tree.leaves(group.windows(np.arange(len(group)))) for group in layout.groups]
        data = (
            recorded.channels["attitude"].values.nbytes + recorded.channels["attitude"].times.nbytes
        )
        assert sum(x.nbytes for leaves in held for x in leaves) < 5 * data


def test_neither_padding_nor_batches_change_the_problem(monkeypatch):
    recorded = ragged()
    model = model_of(recorded)
    free = select_free_leaves(model, body_of, ())
    states = guess_states(
        model_of(recorded),
        recorded,
        whole_trajectories(recorded),
        largest_rates(model_of(recorded), recorded),
    )
    method = lgvi.MoserVeselovIntegrator(1.0, order=6, throw=False)

    def problem():
        (layout,) = lay_out(recorded, [whole_trajectories(recorded)], np.full(len(recorded), 0.01))
        at = ModelAt(model, free.selected, free.theta, None)
        found = linearise_part(at, states, layout, method, blocks=16, keep="residuals")
        gram = np.einsum("nij,nik->njk", found.system.triangles, found.system.triangles)
        return len(layout.groups), gram, found.readings["attitude"]

    parts, gram, residuals = problem()
    monkeypatch.setattr("lgvi.identification.windows.layout.SMALL", 0)
    monkeypatch.setattr("lgvi.identification.windows.batching.FEWEST", 4)
    apart, gram_apart, residuals_apart = problem()
    assert (parts, apart) == (1, 2)
    scale = np.sqrt(np.einsum("njj->nj", gram)) + 1e-300
    error = abs(gram - gram_apart) / scale[:, :, None] / scale[:, None, :]
    assert error.max() < 1e-10
    assert residuals is not None
    np.testing.assert_allclose(np.asarray(residuals_apart), residuals, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("segment", [None, 3.0])
def test_pieces_do_not_change_the_problem(monkeypatch, segment):
    """With rates of other times, positions, rotors, steps of half the size, blocks of time."""
    t, of_rotor = np.arange(400) * 0.03, np.linspace(0, 12, 50)
    first, second = (
        spinning(
            t[:count],
            np.array([0.3, 2.0, 1.0]),
            str(count),
            angular_velocity=(t[: count - 7 : 3] + 0.01, np.ones((len(t[: count - 7 : 3]), 3))),
            position=np.outer(t[:count] ** 2 / 2, GRAVITY),
            rotor_momentum=(of_rotor, 0.1 * np.sin(of_rotor)[:, None] * [1, 2, 3]),
            rotor_speed=(of_rotor, (2 + np.cos(of_rotor))[:, None] * [0.3, 0.2]),
        )
        for count in (400, 300)
    )
    recorded = Recordings.concatenate([first, second])
    arms, axis = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([0.0, 0.0, 1.0])
    rotors = lgvi.Multirotor(arms, axis, 0.2, 0.1, 0.5, (1, -1), inertia=0.3)
    model = replace(model_of(recorded), rotors=rotors)
    speeds = largest_rates(model, recorded)
    free, method = select_free_leaves(model, body_of, ()), lgvi.MoserVeselovIntegrator(1.0)
    windows = cut_into_levels(recorded, speeds, segment)[-1]
    (layout,) = lay_out(recorded, [windows], np.full(2, 0.05))
    states = guess_states(model, recorded, windows, speeds)
    at = ModelAt(model, free.selected, free.theta, None, state_leaves(model))
    width = np.ones(6 + 6 + 2)

    def problem(keep=None):
        given = layout.halve_steps(), replace(method, throw=False), width
        return linearise_part(at, states, *given, blocks=2, keep=keep)

    whole = problem("residuals")
    monkeypatch.setattr("lgvi.identification.windows.group.SMALL", 0)
    monkeypatch.setattr("lgvi.identification.least_squares.pieces.PIECE", 64)
    in_pieces = problem()
    assert count_pieces(model, layout.groups[0], 2) > 2
    one, other = (
        np.einsum("nij,nik->njk", each.system.triangles, each.system.triangles)
        for each in (whole, in_pieces)
    )
    scale = np.sqrt(np.einsum("njj->nj", one)) + 1e-300
    assert np.max(abs(one - other) / scale[:, :, None] / scale[:, None, :]) < 1e-10
    blocks = in_pieces.factors.blocks
    assert blocks is not None
    of_blocks = np.einsum("nbrj,nbrk->njk", blocks, blocks)
    np.testing.assert_allclose(of_blocks, other, rtol=1e-9, atol=1e-9 * np.max(other))
    np.testing.assert_allclose(in_pieces.factors.cost, whole.factors.cost, rtol=1e-10)
    np.testing.assert_allclose(in_pieces.factors.spread, whole.factors.spread, rtol=1e-10)
    given = layout.halve_steps(), replace(method, throw=False), "residuals"
    alone = simulate_readings_of(at, states, *given, mesh=None)
    for channel, r in whole.readings.items():
        np.testing.assert_allclose(alone[channel], r, rtol=0, atol=1e-9)
    if segment is not None:
        assert whole.system.gaps is not None
        assert in_pieces.system.gaps is not None
        np.testing.assert_allclose(in_pieces.system.gaps, whole.system.gaps, rtol=1e-8, atol=1e-9)
        assert whole.system.gaps.any()


def test_segments_follow_one_another_and_share_no_reading():
    t = np.arange(3000) * 0.01
    late = t[5:] + 0.004  # of another sensor, with nothing from 15 to 16 s
    late = late[(late < 15) | (late > 16)]
    first = spinning(t, np.array([0, 0, 3.0]), angular_velocity=(late, np.ones((len(late), 3))))
    short = spinning(t[:20], np.array([0, 0, 1.0]), "1", angular_velocity=np.ones((20, 3)))
    recorded = Recordings.concatenate([first, short])
    levels = cut_into_levels(recorded, largest_rates(model_of(recorded), recorded), segment=6.0)
    for before, after in pairwise(levels):
        kept = Level((after,), ()).starts_within(Level((before,), ()))
        assert [before[i].begin for i in kept] == [window.begin for window in after]
    *first, last = levels[-1]
    assert (last.trajectory, last.joined) == (1, False)
    assert [window.joined for window in first] == [True] * (len(first) - 1) + [False]
    np.testing.assert_allclose([w.end - w.begin for w in first], 6, rtol=0.01)

    (layout,) = lay_out(recorded, [levels[-1]], np.array([0.02, 0.07]))
    (group,) = layout.groups
    windows = group.windows(np.arange(len(group)))
    count = len(levels[-1])
    assert layout.joined is not None
    np.testing.assert_array_equal(layout.joined[:count], [w.joined for w in levels[-1]])
    ends = windows.start + windows.dt.sum(1)
    np.testing.assert_allclose(ends[: len(first) - 1], windows.start[1 : len(first)], atol=1e-12)
    for channel, readings in windows.readings.items():
        samples = recorded.channels[channel]
        # Each reading is in one segment, in the order in which it was recorded.
        found = readings.value[np.asarray(readings.mask)]
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
