"""From the signals of a log to recordings, and back to files."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgvi.logs import Log, LogError, Signal, from_recordings, read

RANDOM = np.random.default_rng(0)
T = np.arange(40) * 0.01
RATES = RANDOM.normal(size=(40, 3))  # rad/s, forward, left, up
ATTITUDES = Rotation.random(40, rng=RANDOM)  # from FLU to ENU
XYZ = "x", "y", "z"
GYRO = Signal("gyro", T, RATES, "rad/s", frame="FLU", quantity="angular_velocity", components=XYZ)
POSE = Signal("pose", T, ATTITUDES.as_quat(), "1", frame="FLU", space="ENU", order="xyzw")


def log_of(*signals):
    return Log("flight.log", "a test", {signal.name: signal for signal in signals})


def rates(recordings, i=0):
    return recordings[i]["angular_velocity"]


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("deg/s", np.pi / 180), ("dps", np.pi / 180), ("rpm", np.pi / 30), ("0.1 dps", np.pi / 1800)],
)
def test_units_are_those_of_the_library(unit, factor):
    log = log_of(replace(GYRO, unit=unit))
    recordings = log.recordings(angular_velocity="gyro")
    np.testing.assert_allclose(rates(recordings)[1], RATES * factor, rtol=1e-15)
    assert any("angular velocity is `gyro`, in " in words for words in recordings.provenance)


def test_a_unit_that_is_not_told_is_asked_for():
    log = log_of(replace(GYRO, unit=""))
    with pytest.raises(LogError, match=r"flight.log, signal `gyro`: must have a unit.*deg/s"):
        log.recordings(angular_velocity="gyro")
    recordings = log.recordings(angular_velocity="gyro", units={"angular_velocity": "deg/s"})
    np.testing.assert_allclose(rates(recordings)[1], np.deg2rad(RATES))
    assert "angular velocity is `gyro`, in deg/s as given" in recordings.provenance


def test_a_unit_of_another_quantity_is_an_error():
    with pytest.raises(LogError, match=r"must have a unit of angular velocity, .*, but has 'm'"):
        log_of(replace(GYRO, unit="m")).recordings(angular_velocity="gyro")


def test_axes_of_body_and_space_are_turned():
    """The attitude of FRD in NED is that of FLU in ENU between two turns that are known."""
    to_ned = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # from ENU
    to_frd = np.diag([1, -1, -1])
    turned = Rotation.from_matrix(to_ned @ ATTITUDES.as_matrix() @ to_frd)
    pose = replace(POSE, values=turned.as_quat(), frame="FRD", space="NED")
    gyro = replace(GYRO, values=RATES @ to_frd, frame="FRD")
    recordings = log_of(pose, gyro).recordings(
        attitude="pose", angular_velocity="gyro", frame="FLU", space="ENU"
    )
    np.testing.assert_allclose(rates(recordings)[1], RATES)
    np.testing.assert_allclose(recordings[0]["attitude"][1], ATTITUDES.as_matrix(), atol=1e-15)


def test_north_is_north_in_all_axes_of_space():
    """East, north and up of a place, in the axes of each kind."""
    place = {"ENU": [1.0, 2.0, 3.0], "NED": [2.0, 1.0, -3.0], "NWU": [2.0, -1.0, 3.0]}
    for source, position in place.items():
        signal = Signal("p", T, np.tile(position, (40, 1)), "m", space=source)
        for target, expected in place.items():
            recordings = log_of(signal).recordings(position="p", space=target)
            np.testing.assert_array_equal(recordings[0]["position"][1][0], expected)


def test_signals_in_different_axes_come_to_those_of_the_first():
    gyro = replace(GYRO, values=RATES * [1, -1, -1], frame="FRD")
    recordings = log_of(POSE, gyro).recordings(attitude="pose", angular_velocity="gyro")
    np.testing.assert_allclose(rates(recordings)[1], RATES)
    assert "angular velocity is turned from the axes FRD to FLU" in recordings.provenance
    with pytest.raises(ValueError, match=r"angular velocity is in the axes 'phone'"):
        log_of(POSE, replace(GYRO, frame="phone")).recordings(
            attitude="pose", angular_velocity="gyro"
        )


@pytest.mark.parametrize("order", ["wxyz", "xyzw", "rotation_vector", "ZYX"])
@pytest.mark.parametrize("direction", ["body to space", "space to body"])
def test_attitudes_of_any_order_and_direction(order, direction):
    turned = ATTITUDES if direction == "body to space" else ATTITUDES.inv()
    values = {
        "wxyz": turned.as_quat(scalar_first=True),
        "xyzw": turned.as_quat(),
        "rotation_vector": turned.as_rotvec(),
        "ZYX": turned.as_euler("ZYX"),
    }[order]
    unit = "1" if order in ("wxyz", "xyzw") else "rad"
    pose = replace(POSE, values=values, unit=unit, order=order, direction=direction)
    attitudes = log_of(pose).recordings(attitude="pose")[0]["attitude"][1]
    np.testing.assert_allclose(attitudes, ATTITUDES.as_matrix(), atol=1e-14)


def test_an_order_is_asked_for_and_an_assumed_direction_is_said():
    log = log_of(replace(POSE, order=""))
    with pytest.raises(LogError, match=r"signal `pose`: must have an order"):
        log.recordings(attitude="pose")
    words = log.recordings(attitude="pose", attitude_order="xyzw").provenance
    assert any("assumed to be from body to space" in line for line in words)
    with pytest.raises(LogError, match=r"unit quaternions, but one has the length 2"):
        log_of(replace(POSE, values=2 * POSE.values)).recordings(attitude="pose")


def test_components_are_joined_if_they_have_one_clock_and_unit():
    scalars = [
        Signal(name, T, column, "rad/s") for name, column in zip("abc", RATES.T, strict=True)
    ]
    recordings = log_of(*scalars).recordings(angular_velocity=("a", "b", "c"))
    np.testing.assert_array_equal(rates(recordings)[1], RATES)
    late = replace(scalars[1], times=T + 1)
    with pytest.raises(LogError, match=r"`a` and `b`: must have the same times"):
        log_of(scalars[0], late, scalars[2]).recordings(angular_velocity=("a", "b", "c"))
    component = log_of(GYRO).recordings(angular_velocity=("gyro.x", "gyro[y]", "gyro.z"))
    np.testing.assert_array_equal(rates(component)[1], RATES)


def test_samples_without_numbers_and_out_of_order_are_counted():
    values, order = RATES.copy(), RANDOM.permutation(40)
    values[3, 1] = np.nan
    recordings = log_of(replace(GYRO, times=T[order], values=values[order])).recordings(
        angular_velocity="gyro"
    )
    t, read_rates = rates(recordings)
    np.testing.assert_array_equal(t, np.delete(T, 3))
    np.testing.assert_array_equal(read_rates, np.delete(RATES, 3, 0))
    assert "1 samples of angular velocity (without a number)" in recordings.dropped
    assert any("sorted by their times" in words for words in recordings.dropped)


def test_samples_of_one_time_are_an_error_unless_it_is_said_what_to_do():
    log = log_of(replace(GYRO, times=np.repeat(T[::2], 2)))
    with pytest.raises(LogError, match=r"duplicates="):
        log.recordings(angular_velocity="gyro")
    t, values = rates(log.recordings(angular_velocity="gyro", duplicates="first"))
    np.testing.assert_array_equal(t, T[::2])
    np.testing.assert_array_equal(values, RATES[::2])


def test_intervals_are_trajectories_and_inputs_cover_them():
    speed = Signal("wheel", np.arange(0, 0.5, 0.02), np.full(25, 60.0), "rpm")
    intervals = [("first", 0.051, 0.149), ("second", 0.2, 0.3)]
    recordings = log_of(GYRO, speed).recordings(
        angular_velocity="gyro", rotor_momentum="wheel", intervals=intervals
    )
    assert recordings.names == ("first", "second")
    assert "trajectory first: from 0.051 to 0.149 s of the log" in recordings.provenance
    t, values = rates(recordings)
    np.testing.assert_array_equal(t, T[6:15])
    np.testing.assert_array_equal(values, RATES[6:15])
    wheel = recordings[0]["rotor_momentum"]
    assert wheel[0][0] <= t[0]
    assert wheel[0][-1] >= t[-1]
    np.testing.assert_allclose(wheel[1], 2 * np.pi)
    with pytest.raises(
        LogError,
        match=r"interval 'late' from 5 to 6 s must have samples, but the log has 0 to 0.39 s",
    ):
        log_of(GYRO).recordings(angular_velocity="gyro", intervals=[("late", 5, 6)])


def test_no_interval_is_not_the_whole_log():
    for intervals in ([], [("a", 0, 0.1), ("a", 0.2, 0.3)]):
        with pytest.raises(LogError, match=r"intervals must be there, each with a name of its own"):
            log_of(GYRO).recordings(angular_velocity="gyro", intervals=intervals)


def test_readings_without_inputs_are_counted():
    speed = Signal("wheel", T[:20], np.full(20, 60.0), "rpm")
    recordings = log_of(GYRO, speed).recordings(angular_velocity="gyro", rotor_momentum="wheel")
    np.testing.assert_array_equal(rates(recordings)[0], T[:20])
    assert "20 samples of angular velocity (no input at their time)" in recordings.dropped


def test_a_momentum_of_rotors_is_turned_with_the_body():
    momentum = Signal("rho", T, RATES * [1, -1, -1], "kg m²/s", frame="FRD")
    recordings = log_of(GYRO, momentum).recordings(angular_velocity="gyro", rotor_momentum="rho")
    np.testing.assert_allclose(recordings[0]["rotor_momentum"][1], RATES)


def test_the_order_of_components_is_asked_for():
    log = log_of(replace(POSE, components=("x", "y", "z", "w")))
    names = [f"pose.{component}" for component in "wxyz"]
    with pytest.raises(LogError, match=r"must have an order"):
        log.recordings(attitude=names)
    recordings = log.recordings(attitude=names, attitude_order="wxyz")
    np.testing.assert_allclose(recordings[0]["attitude"][1], ATTITUDES.as_matrix(), atol=1e-14)


def test_what_is_not_known_is_named():
    with pytest.raises(LogError, match=r"there is no quantity `angular_velocit`"):
        log_of(GYRO).recordings(angular_velocit="gyro")
    with pytest.raises(LogError, match=r"units are given for position, which is not among"):
        log_of(GYRO).recordings(angular_velocity="gyro", units={"position": "m"})
    with pytest.raises(ValueError, match=r"Argument `duplicates` must be one of"):
        log_of(GYRO).recordings(angular_velocity="gyro", duplicates="frist")
    empty = replace(GYRO, times=T[:0], values=RATES[:0])
    with pytest.raises(LogError, match=r"signal `gyro`: must have a sample, but has none"):
        log_of(empty).recordings(angular_velocity="gyro")
    with pytest.raises(LogError, match=r"must have 3 components as `angular_velocity`, but has 2"):
        log_of(GYRO).recordings(angular_velocity=("gyro.x", "gyro.y"))
    with pytest.raises(ValueError, match=r"Argument `attitude_order` must be 'wxyz', .* 'ypr'"):
        log_of(replace(POSE, values=RATES, unit="rad")).recordings(
            attitude="pose", attitude_order="ypr"
        )


def test_columns_of_a_quantity_may_be_in_any_order(tmp_path):
    file = tmp_path / "log.csv"
    names = ",".join(f"angular_velocity.{axis} (rad/s)" for axis in "zyx")
    table = np.column_stack([T, RATES[:, ::-1]])
    np.savetxt(file, table, delimiter=",", header=f"t (s),{names}", comments="", fmt="%.17g")
    recordings = read(file).recordings(angular_velocity="angular_velocity")
    np.testing.assert_array_equal(rates(recordings)[1], RATES)
    file.write_text(file.read_text("utf-8").replace("y (rad/s)", "y (deg/s)"), "utf-8")
    assert "angular_velocity" not in read(file).signals  # units differ


def test_attitudes_from_space_to_body_are_not_written(tmp_path):
    log = log_of(replace(POSE, direction="space to body"))
    with pytest.raises(LogError, match=r"must be from body to space"):
        log.write(tmp_path / "log.csv")


def test_a_signal_that_is_not_there_is_an_error_with_those_that_are():
    with pytest.raises(LogError, match=r"signal `speed`: is not there; there are gyro \(x, y, z\)"):
        log_of(GYRO).recordings(angular_velocity="speed")
    with pytest.raises(ValueError, match=r"Argument `quantities` must name a signal"):
        log_of(GYRO).recordings()


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_recordings_come_back_from_a_file(tmp_path, ending):
    attitude = replace(POSE, times=T[::2], values=POSE.values[::2])
    recordings = log_of(attitude, GYRO).recordings(attitude="pose", angular_velocity="gyro")
    (log,) = from_recordings(recordings)
    path = tmp_path / f"log{ending}"
    log.write(path)
    again = read(path).recordings(attitude="attitude", angular_velocity="angular_velocity")
    for quantity, (t, values) in recordings[0].items():
        np.testing.assert_allclose(again[0][quantity][0], t, atol=1e-15)
        np.testing.assert_allclose(again[0][quantity][1], values, atol=1e-14)


def test_a_vector_of_any_name_comes_back_from_a_file(tmp_path):
    log_of(GYRO).write(tmp_path / "log.csv")
    recordings = read(tmp_path / "log.csv").recordings(angular_velocity="gyro")
    np.testing.assert_allclose(rates(recordings)[1], RATES, rtol=1e-15)


def test_a_file_needs_one_sample_for_each_time(tmp_path):
    log = log_of(replace(GYRO, times=np.zeros(40)))
    with pytest.raises(LogError, match=r"signal `gyro`: must have one sample for each time"):
        log.write(tmp_path / "log.csv")
    with pytest.raises(ValueError, match=r"must end with .csv or .parquet"):
        log.write(tmp_path / "log.txt")
