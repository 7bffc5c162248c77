"""Recordings keep what they are given, say what they drop, and refuse what is malformed."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings

from ...systems import rng

ANY: Any = Recordings
T = np.array([0.0, 0.1, 0.25, 0.3])


class Group:
    """Rotations of another library, such as `jaxlie.SO3`."""

    def __init__(self, matrices):
        self.matrices = matrices

    def as_matrix(self):
        return self.matrices


def rotations(count=4, *key):
    return Rotation.random(count, rng=rng(70, *key))


def test_attitudes_of_every_kind_are_the_same_matrices():
    R = rotations()
    wxyz = R.as_quat(scalar_first=True)
    signs = np.array([1, -1, 1, -1])[:, None]
    for attitude in (R, Group(R.as_matrix()), R.as_matrix(), wxyz, signs * wxyz, 1.0005 * wxyz):
        found = Recordings.from_arrays(T, attitude=attitude).channels["attitude"]
        np.testing.assert_allclose(found.value[0], R.as_matrix(), atol=1e-14)
        np.testing.assert_array_equal(found.t[0], T)


def test_trajectories_of_different_lengths_are_padded_and_come_back():
    long = Recordings.from_arrays(T, attitude=rotations(), angular_velocity=np.ones((4, 3)))
    short = Recordings.from_arrays(attitude=(T[:2], rotations(2, 1)), name="short")
    both = Recordings.concatenate([long, short])
    assert both.names == ("0", "short")
    np.testing.assert_array_equal(
        both.channels["attitude"].mask, [[True] * 4, [True, True, False, False]]
    )
    np.testing.assert_array_equal(both.channels["attitude"].t[1], [0, 0.1, 0.1, 0.1])
    np.testing.assert_array_equal(
        both.channels["attitude"].value[1, 2], both.channels["attitude"].value[1, 1]
    )
    assert not both.channels["angular_velocity"].mask[1].any()
    t, R = both.channels["attitude"].of(1)
    np.testing.assert_array_equal(t, T[:2])
    np.testing.assert_allclose(R, rotations(2, 1).as_matrix(), atol=1e-15)
    assert "6 of attitude, 4 of angular velocity" in str(both)
    with pytest.raises(ValueError, match="read-only"):
        both.channels["attitude"].value[0] = 0


def test_what_is_dropped_is_counted():
    recordings = Recordings.concatenate(
        [Recordings.from_arrays(T, attitude=rotations(4, i), name=f"toss {i}") for i in range(3)]
    )
    fewer = recordings.drop(["toss 1"], "touched")
    assert fewer.names == ("toss 0", "toss 2")
    mask = np.zeros(8, bool)
    mask[4 + 2] = True
    fewer = fewer.drop_samples("attitude", mask, "blurred")
    np.testing.assert_array_equal(fewer.channels["attitude"].of(1)[0], T[[0, 1, 3]])
    assert fewer.dropped == ("trajectory toss 1 (touched)", "1 samples of attitude (blurred)")
    assert "toss 1 (touched)" in str(fewer)
    assert recordings.dropped == ()
    assert (
        Recordings.concatenate([fewer, recordings.drop("toss 0")])
        .dropped[-1]
        .startswith("trajectory toss 0")
    )


def test_inputs_that_are_held_keep_each_value_until_the_next():
    values = rng(77).normal(size=(2, len(T), 3))
    one = Recordings.from_arrays(T, angular_velocity=values[0], body_torque=values[1], name="a")
    held = one.hold("body_torque")
    t, torque = held["a"]["body_torque"]
    assert np.all(np.diff(t) > 0)
    between = T[:-1, None] + np.diff(T)[:, None] * [0.001, 0.5, 1.0]
    for k, times in enumerate(between):
        for i in range(3):
            np.testing.assert_array_equal(
                np.interp(times, t, torque[:, i]), np.repeat(values[1, k, i], 3)
            )
    assert np.all(torque[-1] == values[1, -1])
    np.testing.assert_array_equal(held["a"]["angular_velocity"][1], values[0])
    assert held.provenance[-1] == "held between samples: body_torque"
    for names in ((), ("angular_velocity",), ("rotor_speed",)):
        with pytest.raises(ValueError, match=r"`inputs` must be recorded .*\['body_torque'\]"):
            one.hold(*names)


def test_a_trajectory_is_taken_by_its_number_or_its_name():
    readings = rng(76).normal(size=(2, 4, 3))
    tosses = Recordings.concatenate(
        [
            Recordings.from_arrays(T, angular_velocity=w, name=n)
            for n, w in zip(("toss 1", "toss 2"), readings, strict=True)
        ]
    )
    for key in ("toss 2", 1, -1):
        np.testing.assert_array_equal(tosses[key]["angular_velocity"][1], readings[1])
    assert len(list(tosses)) == 2
    with pytest.raises(KeyError, match="no trajectory 'toss 3'; there are 'toss 1', 'toss 2'"):
        tosses["toss 3"]
    with pytest.raises(IndexError):
        tosses[2]


def test_some_trajectories_are_selected_and_the_others_counted():
    three = Recordings.concatenate(
        Recordings.from_arrays(T[:n], attitude=rotations(n, n), name=f"toss {n}") for n in (2, 3, 4)
    )
    long = three.select(lambda samples: len(samples["attitude"][0]) > 2, "short")
    assert long.names == ("toss 3", "toss 4")
    assert long.dropped == ("trajectory toss 2 (short)",)
    assert three.select(long.names).names == long.names
    assert three.select(lambda samples: True) is three


def both_kinds():
    """Attitudes at T, rates at half of them and after a pause, and torques around."""
    t = np.concatenate([T[:2], 5 + T])
    return Recordings.from_arrays(
        attitude=(T, rotations()),
        angular_velocity=(t, np.arange(18.0).reshape(6, 3)),
        body_torque=(np.arange(-1, 9) * 1.0, np.arange(30.0).reshape(10, 3)),
        name="toss",
    )


def test_what_was_read_before_and_after_is_cropped_and_counted():
    given = both_kinds()
    found = given.crop(0.1, 5.1)
    np.testing.assert_array_equal(found.channels["attitude"].times, T[1:])
    np.testing.assert_array_equal(found.channels["angular_velocity"].times, [0.1, 5, 5.1])
    np.testing.assert_array_equal(found.channels["angular_velocity"].values[:, 0], [3, 6, 9])
    np.testing.assert_array_equal(
        found.quantities["body_torque"].times, np.arange(7)
    )  # as far as is needed
    assert found.dropped == (
        "1 samples of attitude (cropped)",
        "3 samples of angular velocity (cropped)",
    )
    assert given.crop() is not None
    assert given.crop().dropped == ()
    two = Recordings.concatenate([given, given]).crop(np.array([0.0, 5.0]), reason="still")
    np.testing.assert_array_equal(two.channels["angular_velocity"].count, [6, 4])
    np.testing.assert_array_equal(two.channels["attitude"].count, [4, 0])


def test_a_recording_is_split_at_its_gaps():
    given = Recordings.concatenate([both_kinds(), both_kinds().crop(end=0.3)])
    parts = given.split(1.0)
    assert parts.names == ("0:toss[0]", "0:toss[1]", "1:toss")
    np.testing.assert_array_equal(parts.channels["attitude"].count, [4, 0, 4])
    np.testing.assert_array_equal(parts.channels["angular_velocity"].count, [2, 4, 2])
    for name, values in parts.quantities.items():
        before = set(map(float, given.quantities[name].values.ravel()))
        assert set(map(float, values.values.ravel())) <= before  # nothing is resampled
    np.testing.assert_array_equal(parts.quantities["body_torque"].of(1)[0], [5, 6])
    short = given.crop(end=5.0).split(1.0)
    assert short.names == ("0:toss[0]", "1:toss")
    assert short.dropped[-1] == "trajectory 0:toss[1] (fewer than two readings)"


def test_a_sensor_that_no_trajectory_has_any_more_keeps_the_shape_of_its_values():
    without = Recordings.from_arrays(T, angular_velocity=np.ones((4, 3)), name="rates")
    spoilt = Recordings.from_arrays(T, attitude=rotations(), angular_velocity=np.ones((4, 3)))
    spoilt = spoilt.drop_samples("attitude", np.ones(4, bool))
    for both in ([without, spoilt], [spoilt, without]):
        found = Recordings.concatenate(both).channels["attitude"]
        assert found.values.shape == (0, 3, 3)


def test_names_that_occur_twice_are_told_apart():
    one = Recordings.from_arrays(T, attitude=rotations())
    assert Recordings.concatenate([one, one]).names == ("0:0", "1:0")


BAD_Q = np.tile([1.0, 0, 0, 0], (4, 1))
BAD_Q[2] = [1, 0.1, 0, 0]
NAN_W = np.zeros((4, 3))
NAN_W[1, 2] = np.nan


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"attitude": rotations()}, ValueError, "`t` must be given, or `attitude`"),
        (
            {"t": T},
            ValueError,
            "`attitude` or `angular_velocity` or `specific_force` or `magnetic_field` or "
            "`direction` or `position` or `velocity` must be given, but none is",
        ),
        ({"t": T[:1], "attitude": rotations(1)}, ValueError, "two samples of `attitude`"),
        (
            {"t": T, "atitude": rotations()},
            TypeError,
            "no quantity or option `atitude`; quantities are `attitude`",
        ),
        ({"t": T[:3], "attitude": rotations()}, ValueError, r"`attitude` .*\(3, 3, 3\).*\(4, 3, 3"),
        ({"t": T, "attitude": np.eye(4)[:, :3]}, ValueError, r"\(4, 4\) or \(4, 3, 3\).*\(4, 3\)"),
        ({"t": T[::-1], "attitude": rotations()}, ValueError, "`t` must increase .* sample 1"),
        ({"t": T * np.nan, "attitude": rotations()}, ValueError, "`t` must be finite.* sample 0"),
        ({"t": T, "attitude": BAD_Q}, ValueError, "length 1, but has 1.00499, in sample 2"),
        ({"t": T, "attitude": -np.array([np.eye(3)] * 4)}, ValueError, "a rotation matrix"),
        ({"t": T, "angular_velocity": NAN_W}, ValueError, "finite, but is nan, in sample 1"),
        ({"t": T, "angular_velocity": [["a"] * 3] * 4}, TypeError, "`angular_velocity` .* numbers"),
        (
            {"t": T, "attitude": rotations(), "body_torque": (T[1:], np.zeros((3, 3)))},
            ValueError,
            "`body_torque` of trajectory '0' must cover its measurements, from 0 to 0.3",
        ),
    ],
)
def test_bad_arrays_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        ANY.from_arrays(**arguments)


def test_bad_requests_are_named():
    one = Recordings.from_arrays(T, attitude=rotations())
    forced = Recordings.from_arrays(T, attitude=rotations(), body_torque=np.zeros((4, 3)))
    for call, message in (
        (lambda: Recordings.concatenate([]), "at least one"),
        (lambda: Recordings.concatenate([one, forced]), "must have `body_torque`, as others"),
        (lambda: one.drop(["1"]), "no trajectory '1' to drop; there are '0'"),
        (lambda: one.drop(["0"]), "A trajectory must be left, but none is"),
        (lambda: one.select([]), "A trajectory must be left, but none is"),
        (lambda: one.select(lambda samples: False), "A trajectory must be left, but none is"),
        (lambda: one.select("1"), "no trajectory '1' to select; there are '0'"),
        (lambda: one.crop([0.0, 1.0]), "`start` must be a time, or one for each of 1 traj"),
        (lambda: one.crop(0.3, 0.2), "`start` must be a time before `end`, 0.2 s, but is 0.3 s"),
        (lambda: one.crop(end=np.nan), "`end` must be a time, or one for each"),
        (lambda: one.crop(0.29), "Trajectory '0' must have two samples"),
        (lambda: one.split(0.0), "`gap` must be a time above 0 s, but is 0.0"),
        (lambda: one.split(0.01), "`gap` must leave parts of two readings"),
        (lambda: one.drop_samples("body_torque", np.zeros(4, bool)), "'body_torque'"),
        (lambda: one.drop_samples("attitude", np.zeros(8, bool)), r"shape \(4,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="must be boolean, True for what is dropped"):
        ANY.drop_samples(one, "attitude", np.arange(4))
    several: Any = [one, 3]
    with pytest.raises(
        TypeError, match="must be several `Recordings`, but one is of the type `int`"
    ):
        Recordings.concatenate(several)


COUNTS = st.lists(st.tuples(st.integers(2, 5), st.integers(0, 4)), min_size=1, max_size=5)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(counts=COUNTS, seed=st.integers(0, 99))
def test_what_is_put_together_comes_back_and_what_is_dropped_is_missing(counts, seed):
    random = rng(75, seed)

    def trajectory(name, attitudes, rates):
        t = [np.cumsum(random.uniform(0.1, 1, count)) for count in (attitudes, rates)]
        R = Rotation.random(attitudes, rng=random).as_matrix()
        samples = {"attitude": (t[0], R)}
        if rates:
            samples["angular_velocity"] = t[1], random.normal(size=(rates, 3))
        return samples, ANY.from_arrays(**samples, name=str(name))

    made = [trajectory(i, n, m) for i, (n, m) in enumerate(counts)]
    together = Recordings.concatenate(each for _, each in made)
    for i, (samples, _) in enumerate(made):
        for channel, readings in samples.items():
            for found, wanted in zip(together.channels[channel].of(i), readings, strict=True):
                np.testing.assert_allclose(found, wanted, atol=1e-14)
    attitudes = together.channels["attitude"]
    dropped = random.uniform(size=len(attitudes.times)) < 0.3
    remaining = attitudes.split(~dropped)
    rates = [n for _, n in counts]
    if all(keep.sum() >= 2 or n >= 2 for keep, n in zip(remaining, rates, strict=True)):
        fewer = together.drop_samples("attitude", dropped)
        np.testing.assert_array_equal(fewer.channels["attitude"].times, attitudes.times[~dropped])
        np.testing.assert_array_equal(fewer.channels["attitude"].values, attitudes.values[~dropped])
        assert list(fewer.channels["attitude"].count) == [keep.sum() for keep in remaining]
    else:
        with pytest.raises(ValueError, match="must have two samples"):
            together.drop_samples("attitude", dropped)
    if len(counts) > 1:
        assert together.drop(["0"]).names == together.names[1:]


def test_files_of_one_flight_are_merged():
    camera = Recordings.from_arrays(T, attitude=rotations())
    gyroscope = Recordings.from_arrays(2 * T, angular_velocity=np.arange(12.0).reshape(4, 3))
    both = Recordings.merge([camera, gyroscope])
    assert both.names == ("0",)
    for channel, one in (("attitude", camera), ("angular_velocity", gyroscope)):
        for found, expected in zip(both.channels[channel].of(0), one[0][channel], strict=True):
            np.testing.assert_array_equal(found, expected)
    with pytest.raises(
        ValueError, match=r"`attitude`, `angular_velocity` of .*: `Recordings\.merg"
    ):
        Recordings.concatenate([camera, gyroscope])
    renamed = replace(gyroscope, names=("second",))
    assert Recordings.concatenate([camera, renamed]).names == ("0", "second")
    later = Recordings.from_arrays(1.7e9 + T, angular_velocity=np.ones((4, 3)))
    with pytest.raises(
        ValueError, match=r"of one clock, but .*'0' goes from 0 to 0.3 s and from 1700000000 "
    ):
        Recordings.merge([camera, later])
    with pytest.raises(ValueError, match="`attitude` is in several: `concatenate` puts"):
        Recordings.merge([both, camera])


def test_trajectories_are_merged_by_their_names():
    readings = rng(75).normal(size=(2, 4, 3))
    rates = Recordings.concatenate(
        [
            Recordings.from_arrays(T, angular_velocity=w, name=n)
            for n, w in zip("ab", readings, strict=True)
        ]
    )
    forces = Recordings.concatenate(
        [
            Recordings.from_arrays(T, specific_force=f, name=n)
            for n, f in zip("ba", readings, strict=True)
        ]
    )
    fewer = rates.drop_samples("angular_velocity", np.arange(8) == 0)
    merged = Recordings.merge([fewer, forces])
    assert merged.names == ("a", "b")
    assert len(merged.dropped) == 1
    np.testing.assert_array_equal(merged[0]["specific_force"][1], readings[1])
    np.testing.assert_array_equal(merged[1]["angular_velocity"][1], readings[1])
    with pytest.raises(ValueError, match=r"same names, but has \['a', 'b'\] and \['a'\]"):
        Recordings.merge([rates, forces.select(["a"])])
    with pytest.raises(TypeError, match="`recordings` must be several `Recordings`, but is Record"):
        ANY.merge(rates)


def test_what_is_kept_back_is_spread_evenly():
    parts = [Recordings.from_arrays(T, attitude=rotations(4, i), name=str(i)) for i in range(10)]
    fitted, kept_back = Recordings.concatenate(parts).hold_out(0.2)
    assert kept_back.names == ("2", "7")
    assert fitted.names == tuple(str(i) for i in range(10) if i not in (2, 7))
    assert fitted.dropped == ("trajectory 2, 7 (kept back for a validation)",)
    few = Recordings.concatenate(parts[:2])
    assert [len(part) for part in few.hold_out(0.9)] == [1, 1]
    for fraction in (0.0, 1.0, -1, np.nan):
        with pytest.raises(ValueError, match=r"Argument `fraction` must be above 0 and below 1"):
            few.hold_out(fraction)


def test_of_one_trajectory_the_end_is_kept_back():
    t = np.arange(11) * 0.1
    rates = rng(72).normal(size=(11, 3))
    recordings = Recordings.from_arrays(t, angular_velocity=rates)
    fitted, kept_back = recordings.hold_out(0.25)
    np.testing.assert_array_equal(fitted[0]["angular_velocity"][1], rates[:8])
    np.testing.assert_array_equal(kept_back[0]["angular_velocity"][1], rates[8:])


def test_where_samples_come_from_is_kept(tmp_path):
    file = tmp_path / "rates.csv"
    file.write_text("t,x,y,z\n0,1,2,3\n1,4,5,6\n2,7,8,9\n", "utf-8")
    recordings = Recordings.from_csv(file, angular_velocity=("x", "y", "z"))
    words = (f"file {file}",)
    assert recordings.provenance == words
    assert recordings.crop(end=1.5).provenance == words
    assert recordings.drop(()).provenance == words
    twice = Recordings.concatenate([recordings, recordings])
    assert twice.provenance == words
    assert twice.select(["0:0"]).provenance == words
