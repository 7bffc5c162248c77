"""A sensor that the package does not know, from a file to a picture."""

import csv
import re
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from jaxtyping import Array

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.segments.segment import whole_trajectories
from lgvi.identification.start.guess import guess_with_trials
from lgvi.identification.start.measured import largest_rates
from lgvi.plotting import plot_fit, plot_residuals

from ..systems import euler_equations, rotation
from .recorded import SIGMA_W, J, errors_of, ratios


class Magnetometer(lgvi.AbstractSensor):
    """A known direction in space, seen in the body frame, with a bias and noise."""

    channel, unit, axes = "magnetic_field", "µT", ("x", "y", "z")
    shapes, depends_on_attitude = ((3,),), True

    sigma: Array
    bias: Array
    field: Array  # in the space frame

    def predict(self, state):
        return state.R.T @ self.field + self.bias

    def compute_residual(self, predicted, measured):
        return (measured - predicted) / self.sigma

    def add_noise(self, predicted, noise):
        return predicted + self.sigma * noise

    def guess_state(self, readings):
        return None, None  # one direction tells neither

    @staticmethod
    def from_columns(columns):
        return columns

    @staticmethod
    def as_curves(readings):
        return "magnetic field (µT)", dict(zip("xyz", readings.T, strict=True))


SIGMAS = np.array([2e-3, 2e-3, 1e-3])
BIAS = np.array([3.0, -2.0, 1.0])
GYROSCOPE = lgvi.Gyroscope(SIGMA_W)


def magnetometer(bias):
    return Magnetometer(jnp.asarray(0.1), jnp.asarray(bias), jnp.array([20.0, 5.0, -40.0]))


@pytest.mark.slow
def test_a_magnetometer_goes_from_a_file_to_an_estimate_and_a_picture(tmp_path):
    true = Model(lgvi.PhysicalRigidBody.from_inertia(J), [magnetometer(BIAS), GYROSCOPE])
    R = np.stack([rotation(i, 120) for i in range(3)])
    omega = np.array([[2.0, -3.0, 1.0], [-3.0, 1.0, 2.0], [1.0, 2.0, 4.0]])
    states = InitialStates(jnp.asarray(R), jnp.asarray(omega))
    made = simulate_recordings(true, np.arange(60) * 0.03, states, key=jax.random.key(7))

    with open(tmp_path / "log.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["trajectory", "t", "bx", "by", "bz", "wx", "wy", "wz"])
        for name, samples in zip(made.names, made, strict=True):
            t, field = samples["magnetic_field"]
            _, rates = samples["angular_velocity"]
            writer.writerows([name, *row] for row in np.column_stack([t, field, rates]).tolist())
    read = Recordings.from_csv(
        tmp_path / "log.csv",
        magnetic_field=("bx", "by", "bz"),
        angular_velocity=("wx", "wy", "wz"),
        sensors=Magnetometer,
    )
    assert str(read) == "3 trajectories; samples: 180 of magnetic field, 180 of angular velocity"

    isotropic = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
    start = Model(isotropic, [magnetometer(np.zeros(3)), GYROSCOPE])

    def free(model):
        return model.body, model.sensors["magnetic_field"].bias

    estimate = identify(start, read, free=free)
    assert estimate.converged
    assert estimate.messages == ()
    assert estimate.chi_square / estimate.degrees_of_freedom == pytest.approx(1, abs=0.15)
    assert np.all(abs(errors_of(estimate, ratios, ratios(true))) < 4)
    assert np.all(abs(errors_of(estimate, lambda m: m.sensors["magnetic_field"].bias, BIAS)) < 4)
    report = str(estimate)
    assert "magnetic_field.bias[0]" in report
    assert re.search(r"magnetic field: residual 0\.\d+ µT for each axis", report)
    residuals, fit = plot_residuals(estimate), plot_fit(estimate)
    assert residuals.axes[0].get_ylabel() == "residual of the\nmagnetic field (µT)"
    assert fit.axes[0].get_ylabel() == "magnetic field (µT)"
    plt.close("all")


class SunSensor(lgvi.AbstractSensor):
    """The cosine of the angle between an axis of the body and the sun: one number."""

    channel, unit, axes = "sun", "1", ("cosine",)
    shapes, depends_on_attitude = ((1,),), True

    sigma: Array
    loss: lgvi.AbstractLoss

    def predict(self, state):
        return state.R[:1, 2]

    compute_residual = Magnetometer.compute_residual
    add_noise = Magnetometer.add_noise
    guess_state = Magnetometer.guess_state
    from_columns = staticmethod(Magnetometer.from_columns)
    as_curves = staticmethod(Magnetometer.as_curves)


@pytest.mark.slow
def test_two_sensors_of_one_kind_and_one_of_a_single_axis_are_fitted_together():
    tilt = np.array([0.3, -0.2, 0.1])
    front, back = lgvi.AttitudeSensor(1e-3), lgvi.AttitudeSensor(SIGMAS, tilt)
    kinds = {"front": front, "back": back, "sun": SunSensor(jnp.asarray(0.01), lgvi.Huber(2.0))}
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    omega = jnp.array([[2.0, -3.0, 1.0], [-3.0, 1.0, 2.0]])
    states = InitialStates.from_rates(omega)
    made = simulate_recordings(
        Model(body, kinds), np.arange(60) * 0.03, states, key=jax.random.key(9)
    )
    readings = list(made)
    again = Recordings.concatenate(
        Recordings.from_arrays(name=str(i), sensors=kinds, **dict(each))
        for i, each in enumerate(readings)
    )
    assert tuple(again.channels) == ("front", "back", "sun")  # not as sorted
    isotropic = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
    start = Model(isotropic, {**kinds, "back": lgvi.AttitudeSensor(SIGMAS)})

    def alignment(model):
        return model.sensors["back"].alignment

    estimate = identify(start, again, free=lambda model: (model.body, alignment(model)))
    assert estimate.converged
    assert estimate.messages == ()
    assert tuple(estimate.residuals) == tuple(estimate.predicted) == ("front", "back", "sun")
    assert estimate.degrees_of_freedom == 120 * 7 - 2 * 6 - 5 - 3
    assert estimate.chi_square / estimate.degrees_of_freedom == pytest.approx(1, abs=0.15)
    assert np.all(abs(errors_of(estimate, alignment, tilt)) < 4)
    assert "back.alignment[0]" in str(estimate)


class WithoutAxes(SunSensor):
    axes = ("x", "y", "z")


class TwoAtOnce(SunSensor):
    def add_noise(self, predicted, noise):
        return jnp.stack([predicted, predicted])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (WithoutAxes, r"residual of `WithoutAxes` must have shape \(3,\), .* is \(1,\)"),
        (TwoAtOnce, r"reading of `TwoAtOnce` with noise .*, \(1,\), but its shape is \(2, 1\)"),
    ],
)
def test_shapes_are_those_that_the_sensor_says(kind, message):
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    model = Model(body, kind(jnp.asarray(0.01), lgvi.Huber(2.0)))
    recorded = Recordings.from_arrays(np.arange(9.0), sun=np.zeros((9, 1)), sensors=SunSensor)
    states = InitialStates.from_rates(jnp.ones(3))
    with pytest.raises(ValueError, match=message):
        simulate_recordings(model, recorded, states)
    with pytest.raises(ValueError, match=message):
        identify(model, recorded, start=states)


def test_a_sensor_that_lacks_an_attribute_is_named():
    class Nameless(lgvi.AbstractSensor):
        channel = "nothing"

    class Shapeless(Magnetometer):
        shapes = (3,)  # pyright: ignore[reportAssignmentType]

    with pytest.raises(TypeError, match=r"`shapes` of `Shapeless` must be a tuple of shapes"):
        Recordings.from_arrays(np.arange(9.0), sensors=Shapeless)
    with pytest.raises(TypeError, match="`Nameless` must have a class attribute `unit`"):
        Recordings.from_arrays(np.arange(9.0), nothing=np.zeros((9, 3)), sensors=Nameless)


class WithoutEclipse(Magnetometer):
    @staticmethod
    def from_columns(columns):
        return columns[1:]


class Lost(Magnetometer):
    @staticmethod
    def from_columns(columns):
        return np.where(columns == 1, np.nan, columns)


def test_every_row_gives_a_finite_reading():
    field = np.zeros((9, 3))
    field[3] = 1
    with pytest.raises(TypeError, match=r"`WithoutEclipse.from_columns` must .* 9 readings"):
        Recordings.from_arrays(np.arange(9.0), magnetic_field=field, sensors=WithoutEclipse)
    with pytest.raises(ValueError, match=r"`magnetic_field` must give a finite .*, in sample 3"):
        Recordings.from_arrays(np.arange(9.0), magnetic_field=field, sensors=Lost)


@pytest.mark.parametrize(
    "channel", ["t", "name", "sensors", "file", "folder", "trajectory", "body_torque"]
)
def test_a_channel_has_a_name_of_its_own(channel):
    with pytest.raises(ValueError, match=f"must not have a channel named `{channel}`"):
        Model(lgvi.PhysicalRigidBody.from_inertia(J), {channel: GYROSCOPE})
    with pytest.raises(ValueError, match=f"must not have a channel named `{channel}`"):
        Recordings.from_arrays(np.arange(9.0), sensors={channel: Magnetometer})


class Accelerometer(lgvi.AbstractSensor):
    r"""The acceleration $\dot\omega\times r + \omega\times(\omega\times r)$ beside the centre."""

    channel, unit, axes = "acceleration", "m/s²", ("x", "y", "z")
    shapes, depends_on_attitude = ((3,),), False

    sigma: Array
    time_offset: float | None
    place: Array

    def predict(self, state):
        turning = jnp.cross(state.angular_acceleration, self.place)
        return turning + jnp.cross(state.omega, jnp.cross(state.omega, self.place))

    compute_residual = Magnetometer.compute_residual
    add_noise = Magnetometer.add_noise
    guess_state = Magnetometer.guess_state
    from_columns = staticmethod(Magnetometer.from_columns)
    as_curves = staticmethod(Magnetometer.as_curves)


def accelerometer(time_offset=None):
    return Accelerometer(jnp.asarray(0.1), time_offset, jnp.array([0.1, -0.2, 0.3]))


def test_sensors_read_the_angular_acceleration_under_all_that_acts():
    t, end = np.arange(40) * 0.02, 0.78
    place, damping = np.array([0.1, -0.2, 0.3]), 1e-3
    push, spin_up = np.array([1e-3, 2e-3, -1e-3]), np.array([0.0, 1e-3, 2e-3])
    offsets = {"prompt": None, "early": -0.01, "late": 0.01}
    sensors = {channel: accelerometer(offset) for channel, offset in offsets.items()}
    readings: dict[str, Any] = dict.fromkeys(offsets, np.zeros((40, 3)))
    layout = Recordings.from_arrays(
        t,
        **readings,
        body_torque=np.outer(t, push),
        rotor_momentum=np.outer(t, spin_up),
        sensors=sensors,
    )
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    model = Model(body, sensors, lgvi.LinearDamping(damping * jnp.eye(3)))
    omega = np.array([1.0, -2.0, 0.5])
    states = InitialStates.from_rates(omega)
    method = lgvi.MoserVeselovIntegrator(2e-4)
    found = simulate_recordings(model, layout, states, method).channels

    def torque(t, R, omega):
        # Beyond the window the recorded torque stays as it is; the rotors are still sped up.
        return np.multiply.outer(np.clip(t, 0, end), push) - damping * omega

    def motion(R0, pi0, times):
        return euler_equations(R0, pi0, J, times, torque, lambda t: t * spin_up)

    for channel, offset in offsets.items():
        at = t + (offset or 0.0)
        R, pi = np.eye(3), J @ omega
        if offset:
            R, pi = (x[-1] for x in motion(R, pi, [0.0, at[0]]))
        _, pi = motion(R, pi, at)
        rate = np.linalg.solve(J, (pi - np.outer(at, spin_up)).T).T
        pi_dot = np.cross(pi, rate) + torque(at, R, rate)
        acceleration = np.linalg.solve(J, (pi_dot - spin_up).T).T
        expected = np.cross(acceleration, place) + np.cross(rate, np.cross(rate, place))
        np.testing.assert_allclose(found[channel].values, expected, atol=1e-5 * abs(expected).max())


def test_a_law_may_give_a_list_and_a_channel_may_have_no_readings():
    def law(t, R) -> Any:
        return [1e-3, 0.0, 2e-3]

    layout = Recordings.from_arrays(
        np.arange(5.0) * 0.01,
        acceleration=np.zeros((5, 3)),
        angular_velocity=np.zeros((5, 3)),
        sensors=Accelerometer,
    ).drop_samples("angular_velocity", np.ones(5, bool))
    model = Model(lgvi.PhysicalRigidBody.from_inertia(J), [GYROSCOPE, accelerometer()], law)
    states = InitialStates.from_attitudes(jnp.eye(3))
    made = simulate_recordings(model, layout, states, lgvi.MoserVeselovIntegrator(0.01))
    expected = np.cross(np.linalg.solve(J, [1e-3, 0.0, 2e-3]), accelerometer().place)
    np.testing.assert_allclose(made.channels["acceleration"].values[0], expected, rtol=1e-12)
    assert made.channels["angular_velocity"].values.shape == (0, 3)


@pytest.mark.slow
def test_steps_are_short_enough_where_no_sensor_tells_a_rate():
    t, push, omega = np.arange(5) * 0.2, np.array([0.02, -0.01, 0.015]), np.array([0.1, 0.2, -0.1])
    model = Model(
        lgvi.PhysicalRigidBody.from_inertia(J), magnetometer(BIAS), lgvi.ConstantTorque(push)
    )
    states = InitialStates.from_rates(omega)
    made = simulate_recordings(model, t, states)
    R, pi = euler_equations(np.eye(3), J @ omega, J, t, lambda t, R, omega: push)
    assert np.linalg.norm(np.linalg.solve(J, pi[-1])) > 6  # rad/s
    expected = np.swapaxes(R, 1, 2) @ np.asarray(model.sensors["magnetic_field"].field) + BIAS
    np.testing.assert_allclose(made.channels["magnetic_field"].values, expected, atol=1e-3)
    np.testing.assert_allclose(
        largest_rates(model, made, states), np.linalg.norm(omega), rtol=1e-12
    )


def test_attitudes_are_tried_only_where_none_was_read():
    t, both = np.arange(5.0), [GYROSCOPE, magnetometer(BIAS), lgvi.AttitudeSensor(1e-3)]
    R = np.stack([rotation(i, 121) for i in range(3)])
    recordings = Recordings.concatenate(
        Recordings.from_arrays(
            t,
            name=str(i),
            attitude=np.tile(R[i], (5, 1, 1)),
            magnetic_field=np.ones((5, 3)),
            angular_velocity=np.zeros((5, 3)),
            sensors=Magnetometer,
        )
        for i in range(3)
    )
    recordings = recordings.drop_samples("attitude", np.repeat([False, True, True], 5))
    recordings = recordings.drop_samples("magnetic_field", np.repeat([False, False, True], 5))
    model = Model(lgvi.PhysicalRigidBody.from_inertia(J), both)
    windows = whole_trajectories(recordings)
    _, trials = guess_with_trials(model, recordings, windows, np.ones(3))
    np.testing.assert_array_equal(trials.unknown, [False, True, False])
    assert not np.any(trials.axis)
    turn = np.diag([1.0, -1.0, -1.0])  # half a turn about x
    chosen = trials.choose(
        lambda states: np.sum((np.asarray(states.R) - turn) ** 2, axis=(1, 2)),
        InitialStates(R, np.zeros((3, 3))),
    )
    np.testing.assert_allclose(chosen.R, [R[0], turn, R[2]], atol=1e-15)


def test_a_sensor_says_where_it_is_not_given_the_angular_acceleration():
    with pytest.raises(ValueError, match="must be made with `compute_angular_acceleration`"):
        accelerometer().predict(lgvi.MotionState(0.0, jnp.eye(3), jnp.ones(3)))
