"""Recordings keep what they are given, say what they drop, and refuse what is malformed."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings

from ..systems import rng

ANY: Any = Recordings
T = np.array([0.0, 0.1, 0.25, 0.3])
HEADER = "t,qw,qx,qy,qz,wx,wy,wz"
Q = ("qw", "qx", "qy", "qz")
W = ("wx", "wy", "wz")


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
        ({"t": T}, ValueError, "`attitude` or `angular_velocity` must be given, but none is"),
        ({"t": T[:1], "attitude": rotations(1)}, ValueError, "two samples of `attitude`"),
        (
            {"t": T, "atitude": rotations()},
            TypeError,
            "no quantity `atitude`; there are `attitude`",
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
        (lambda: one.drop(["0"]), "must leave a trajectory"),
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


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_a_file_comes_back_with_columns_by_name(tmp_path):
    rows = [
        "b, 0.5, 1,0,0,0, 1,2,3",
        "a, 0.0, 0,1,0,0, , , ",  # attitudes are sampled more often than rates
        "b, 0.75, -1,0,0,0, 4,5,6",
        "a, 0.1, 0,0,1,0, 7,8,9",
        "",
        "a, 0.3, 0,0,0,1, , , ",
    ]
    file = write(tmp_path / "log.csv", rows, f"trajectory,{HEADER}")
    found = Recordings.from_csv(file, attitude=Q, angular_velocity=W)
    assert found.names == ("b", "a")
    np.testing.assert_array_equal(found.channels["attitude"].of(1)[0], [0, 0.1, 0.3])
    np.testing.assert_array_equal(found.channels["attitude"].of(1)[1][2], np.diag([-1, -1, 1]))
    np.testing.assert_array_equal(found.channels["angular_velocity"].of(1)[0], [0.1])
    np.testing.assert_array_equal(
        found.channels["angular_velocity"].of(0)[1], [[1, 2, 3], [4, 5, 6]]
    )


def test_a_trajectory_of_a_file_may_lack_a_sensor(tmp_path):
    rows = ["a,0,1,0,0,0,,,", "a,1,1,0,0,0,,,", "b,0,,,,,1,2,3", "b,1,,,,,4,5,6"]
    file = write(tmp_path / "log.csv", rows, f"trajectory,{HEADER}")
    found = Recordings.from_csv(file, attitude=Q, angular_velocity=W)
    np.testing.assert_array_equal(found.channels["attitude"].count, [2, 0])
    np.testing.assert_array_equal(found.channels["angular_velocity"].count, [0, 2])
    assert [samples["attitude"][1].shape for samples in found] == [(2, 3, 3), (0, 3, 3)]


def test_a_file_of_matrices_needs_no_trajectory(tmp_path):
    R = rotations().as_matrix()
    header = "time," + ",".join(f"r{i}" for i in range(9))
    rows = [",".join(map(repr, map(float, [t, *r.ravel()]))) for t, r in zip(T, R, strict=True)]
    file = write(tmp_path / "log.csv", rows, header)
    found = Recordings.from_csv(file, attitude=header.split(",")[1:], t="time")
    np.testing.assert_allclose(found.channels["attitude"].value[0], R, atol=1e-15)


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ([], HEADER, "line 2, column `t`: there is no sample"),
        (["0,1,0,0,0"], "t,qw,qx,qy", "line 1, column `qz`: must be there once"),
        (["0,1,0,0,0"], "t,qw,qw,qx,qy,qz", "line 1, column `qw`: must be there once"),
        (["0,1,0,0,0,0"], "t,qw,qx,qy,qz", "line 2, column `6`: has no name"),
        (["0,1,0,0,0", "1,1,0,0"], "t,qw,qx,qy,qz", "line 3, column `qz`: is missing"),
        (["0,1,0,zero,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number.*'zero'"),
        (["0,1,0,,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number, but is ''"),
        (["0,1,0,0_0,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number, but is '0_0'"),
        (["0,1,0,0,0"], "Time,qw,qx,qy,qz", 'line 1, column `t`: must .*; write `t="Time"` if'),
        (["0,1,0,0,0", "1,1,0,0," + 200_000 * "0"], "t,qw,qx,qy,qz", "line 3: must be CSV, but"),
        (["0,1,0,0,nan"], "t,qw,qx,qy,qz", "line 2, column `qz`: must be finite"),
        (["0,1,0,0,0", "", "0,1,0,0,0"], "t,qw,qx,qy,qz", "line 4, column `t`: must increase"),
        (["0,1,0,0,0.1"], "t,qw,qx,qy,qz", "line 2, column `qw,qx,qy,qz`: must have length 1"),
    ],
)
def test_a_bad_file_is_refused_with_line_and_column(rows, header, message, tmp_path):
    file = write(tmp_path / "log.csv", rows, header)
    with pytest.raises(ValueError, match=f"log.csv, {message}"):
        Recordings.from_csv(file, attitude=Q)


def test_a_file_that_is_no_text_or_wants_other_columns_is_refused(tmp_path):
    file = tmp_path / "log.csv"
    file.write_bytes(b"t,qw\n\xff\xfe")
    with pytest.raises(ValueError, match=r"log.csv: must be text in UTF-8"):
        Recordings.from_csv(file, attitude=Q)
    for names in (W, 5, "qw", ("qw", "qx", "qx", "qz"), (1, 2, 3, 4)):
        with pytest.raises(ValueError, match="`attitude` must name 4 or 9 different columns"):
            ANY.from_csv(file, attitude=names)
    write(file, ["0,1,0,0,0", "1,1,0,0,0"], "t,qw,qx,qy,qz")
    assert Recordings.from_csv(file, attitude=Q).names == ("0",)
    with pytest.raises(ValueError, match="line 1, column `toss`: must be there once"):
        Recordings.from_csv(file, attitude=Q, trajectory="toss")
    with pytest.raises(ValueError, match="`attitude` or `angular_velocity` must be given"):
        Recordings.from_csv(file)
    write(file, ["0,1,0,0,0"], "t,qw,qx,qy,qz")
    with pytest.raises(ValueError, match=r"log\.csv: Trajectory '0' must have two samples"):
        Recordings.from_csv(file, attitude=Q)
