"""The two programs: against the integrator, and against differences."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi import MoserVeselovIntegrator
from lgvi.identification import Model
from lgvi.identification.model.free_leaves import ravel
from lgvi.identification.segments.chain import Directions, Places, Rows, derive
from lgvi.identification.segments.programs import Advanced, Programs, Segment

STEPS, SEGMENTS = 6, 3
INERTIA = np.array([[1.0, 0.1, 0.0], [0.1, 2.0, 0.2], [0.0, 0.2, 2.8]])
OFFSET = np.array([0.1, 0.2, -0.3])
BODY = lgvi.PhysicalRigidBody.from_inertia(INERTIA)
ATTITUDE = lgvi.AttitudeSensor(0.1, alignment=np.array([0.1, 0.2, -0.1]))
DRONE = lgvi.Multirotor(
    arms=0.1 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]),
    axes=np.array([0.0, 0, 1]), thrust=0.1, drag=1e-3, lag=0.05, spin=(1, -1, 1, -1), inertia=1e-3,
)  # fmt: skip


class Case(NamedTuple):
    """A model, and what is recorded."""

    model: Model
    order: int
    inputs: dict[str, int]  # columns of recorded torques and rotors


CASES = {
    "free": Case(
        Model(
            BODY,
            [ATTITUDE, lgvi.PositionSensor(OFFSET, 0.1, gravity=np.array([0, 0, -9.81]), drag=0.1)],
        ),
        6,
        {},
    ),
    "weight": Case(Model(BODY, [ATTITUDE], torque=lgvi.UniformGravity(1.0, OFFSET)), 4, {}),
    "drone": Case(
        Model(
            BODY,
            [lgvi.Gyroscope(0.1, bias=0.1 * OFFSET), lgvi.Accelerometer(OFFSET, 1.0)],
            torque=lgvi.LinearDamping(0.1 * np.eye(3)) + lgvi.ConstantTorque(OFFSET),
            rotors=DRONE,
            time_scale=1.1,
        ),
        2,
        {"rotor_speed": 4},
    ),
    "flywheel": Case(
        Model(BODY, [lgvi.Gyroscope(0.1)], rotor_inertia=OFFSET),
        2,
        {"rotor_momentum": 1, "body_torque": 3},
    ),
}
GRAVITY, WIND = np.array([0.0, 0.5, -9.81]), np.array([1.0, 2.0, -0.5])
CENTRE = lgvi.PositionSensor(OFFSET, 0.1), lgvi.VelocitySensor(0.1, -OFFSET)
CASES |= {
    "thrown": Case(
        Model(
            BODY,
            [*CENTRE, lgvi.Accelerometer(OFFSET, 1.0)],
            torque=lgvi.Thruster(OFFSET, np.array([1.0, 2.0, 3.0]), frame="space"),
            mass=0.7,
            force=lgvi.AirDrag(np.array([0.1, 0.3, 0.2]), 0.05 * np.eye(3), WIND),
            gravity=GRAVITY,
            time_scale=1.1,
        ),
        2,
        {},
    ),
    "ballistic": Case(Model(BODY, CENTRE, gravity=GRAVITY), 6, {}),
    "flying drone": Case(
        Model(
            BODY,
            [lgvi.Accelerometer(OFFSET, 1.0), lgvi.VelocitySensor(0.1, OFFSET, "body")],
            rotors=eqx.tree_at(
                lambda rotors: (rotors.centre, rotors.in_plane_drag),
                DRONE,
                (OFFSET, jnp.array(0.1)),
            ),
            mass=0.7,
            gravity=GRAVITY,
            time_scale=1.1,
        ),
        2,
        {"rotor_speed": 4},
    ),
}


def segments_of(case: Case, number: int) -> Segment:
    random, shape = np.random.default_rng(0), (number, STEPS + 1)
    readings, mask = {}, {}
    for channel, sensor in case.model.sensors.items():
        if (3, 3) in sensor.shapes:
            rotations = Rotation.from_quat(random.normal(size=(number * (STEPS + 1), 4)))
            readings[channel] = rotations.as_matrix().reshape(*shape, 3, 3)
        else:
            readings[channel] = random.normal(size=(*shape, *sensor.shapes[0]))
        mask[channel] = random.random(shape) < 0.7
    dt = 0.02 + 0.02 * random.random((number, STEPS))
    inputs = {name: 2 + random.normal(size=(*shape, n)) for name, n in case.inputs.items()}
    slopes = {name: np.diff(x, axis=1) / dt[..., None] for name, x in inputs.items()}
    rates = {name: np.concatenate([x[:, :1], x], axis=1) for name, x in slopes.items()}
    return Segment(random.random(number), dt, readings, mask, inputs, rates)


def states_of(number: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(2)
    R = Rotation.from_quat(random.normal(size=(number, 4))).as_matrix()
    return R, random.normal(size=(number, 3))


def programs_of(case: Case, lanes: int) -> Programs:
    method = MoserVeselovIntegrator(1.0, order=case.order, throw=False)
    return Programs(case.model, method, optimised=False, lanes=lanes)


def leaves_of(model: Model) -> np.ndarray:
    return ravel(eqx.filter(model, eqx.is_inexact_array))


@pytest.mark.parametrize("name", CASES)
def test_a_segment_moves_as_the_integrator_does(name):
    case = CASES[name]
    segments, (R, omega) = segments_of(case, 1), states_of(1)
    leaves = leaves_of(case.model)[None]
    found = programs_of(case, 1).advance(leaves, R, omega, segments)
    model, scale = case.model, float(case.model.time_scale)
    drone: Any = model.rotors
    h, options = scale * segments.dt[0], {}
    torque: Any = model.torque
    centre = {name: getattr(model, name) for name in ("mass", "force", "gravity", "x0", "v0")}
    body: Any = model.body
    rho, first = np.zeros((STEPS + 1, 3)), omega[0]
    if "rotor_speed" in case.inputs:
        speeds = DRONE.follow(segments.inputs["rotor_speed"][0], h)
        t = scale * segments.start[0] + np.append(0, np.cumsum(h))
        of_rotors = lgvi.SampledTorque(t, jax.vmap(drone.torque)(speeds))
        torque = of_rotors if torque is None else torque + of_rotors
        rho = np.asarray(jax.vmap(DRONE.momentum)(speeds))
        options = {"t0": t[0]}
        if model.mass is not None:
            centre["force"] = force_of_rotors(t, speeds, 0.1)
    if "rotor_momentum" in case.inputs:
        rho = np.asarray(model.rotor_inertia) * segments.inputs["rotor_momentum"][0]
        options = {"body_torques": segments.inputs["body_torque"][0]}
    if rho.any():
        body = lgvi.Gyrostat(body.inertia, (rho[:-1] + rho[1:]) / 2)
    integrator = MoserVeselovIntegrator(h, order=case.order)
    pi = np.asarray(body.inertia) @ first + rho[0]
    path = integrator.simulate(body, R[0], pi, torque=torque, **options, **centre)
    np.testing.assert_allclose(found.R[0], path.R[-1], atol=1e-13)
    omega_end = np.linalg.solve(body.inertia, path.pi[-1] - rho[-1])
    np.testing.assert_allclose(found.omega[0], omega_end, atol=1e-12)
    if model.gravity is not None:
        states: Any = path
        end = np.append(states.x[-1], states.v[-1])
        places = Places.of_model(model)
        centre = np.concatenate([places.part("x0"), places.part("v0")])
        at = np.searchsorted(places.states, centre)
        np.testing.assert_allclose(found.own[0][at], end, atol=1e-12)
    assert found.usable.all()


def force_of_rotors(t: np.ndarray, speeds: jax.Array, in_plane_drag: float) -> Any:
    """Thrust along z, and drag across, of speeds at times of nodes."""
    thrust = DRONE.thrust * jnp.sum(speeds**2, axis=1)
    drag = in_plane_drag * jnp.sum(speeds, axis=1)

    def force(t_now, R, omega, v):
        thrust_now, drag_now = (jnp.interp(t_now, t, x) for x in (thrust, drag))
        across = (R.T @ v) * np.array([1.0, 1.0, 0.0])
        return thrust_now * np.array([0.0, 0.0, 1.0]) - drag_now * across

    return force


def rows_of(case: Case, places: Places) -> tuple[Rows, Advanced]:
    """Derivatives by the state and by all leaves."""
    segments, (R, omega) = segments_of(case, SEGMENTS), states_of(SEGMENTS)
    programs = programs_of(case, SEGMENTS)
    leaves = np.tile(leaves_of(case.model), (SEGMENTS, 1))
    directions = Directions.of_leaves(np.eye(6 + places.number)[6:])
    advanced = programs.advance(leaves, R, omega, segments)
    (local,) = programs.differentiate(leaves, R, segments, advanced.motion)
    parts = programs.fractions(segments)
    return derive(local, segments, leaves, places, directions, parts), advanced


@pytest.mark.parametrize("name", CASES)
def test_rows_are_differences(name):
    case = CASES[name]
    places = Places.of_model(case.model)
    rows, advanced = rows_of(case, places)
    random, size = np.random.default_rng(3), 1e-5
    ways = random.normal(size=(SEGMENTS, 6 + places.number))
    (R, omega), leaves, ends = states_of(SEGMENTS), leaves_of(case.model), []
    for sign in (-1, 1):
        step = sign * size * ways
        turned = R @ Rotation.from_rotvec(step[:, :3]).as_matrix()
        given = leaves + step[:, 6:], turned, omega + step[:, 3:6], segments_of(case, SEGMENTS)
        ends.append(programs_of(case, SEGMENTS).advance(*given))
    before, after = ends
    for channel, of_channel in rows.residuals.items():
        slope = (after.residuals[channel] - before.residuals[channel]) / (2 * size)
        expected = np.einsum("snij,sj->sni", of_channel, ways)
        np.testing.assert_allclose(slope, expected, atol=1e-6 * float(np.max(abs(slope))))
    turn = np.swapaxes(before.R, 1, 2) @ after.R
    turn = Rotation.from_matrix(turn).as_rotvec() / (2 * size)
    slopes = [
        (b - a) / (2 * size) for a, b in ((before.omega, after.omega), (before.own, after.own))
    ]
    slope, expected = np.hstack([turn, *slopes]), np.einsum("sij,sj->si", rows.end, ways)
    np.testing.assert_allclose(slope, expected, atol=1e-7 * float(np.max(abs(slope))))
    assert advanced.usable.all()


@pytest.mark.parametrize("name", ["free", "flying drone"])
def test_single_precision_gives_the_same_rows(name):
    case = CASES[name]
    places = Places.of_model(case.model)
    exact, _ = rows_of(case, places)
    with jax.enable_x64(False):
        model = jax.tree.map(
            lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x, case.model
        )
        rows, _ = rows_of(case._replace(model=model), places)
    for channel, of_channel in exact.residuals.items():
        largest = float(np.max(abs(of_channel)))
        np.testing.assert_allclose(rows.residuals[channel], of_channel, atol=1e-4 * largest)


def test_a_drift_that_cannot_be_solved_is_not_usable():
    case = CASES["free"]
    segments, (R, omega) = segments_of(case, 2), states_of(2)
    omega[1] *= 200
    leaves = np.tile(leaves_of(case.model), (2, 1))
    found = programs_of(case, 2).advance(leaves, R, omega, segments)
    np.testing.assert_array_equal(found.usable, [True, False])
    np.testing.assert_array_equal(np.isfinite(found.cost), [True, False])
