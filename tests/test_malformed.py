"""Every public function and class, with each argument malformed in many ways.

A call works, or raises an error that names the argument.
"""

import re
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
import lgvi.names
from lgvi import so3
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    initial_states,
    negative_log_likelihood,
    simulate_recordings,
)
from lgvi.modules.forces.law import ForceSum, ScaledForce
from lgvi.modules.torques.law import ScaledTorque, TorqueSum

from .public import public_names
from .systems import GENERIC, PI0

EYE, VECTOR = np.eye(3), np.array([0.1, 0.2, 0.3])
BODY = lgvi.RigidBody(GENERIC)
SPHERE = lgvi.MassProperties.sphere(1.0, 0.1)
STEP = lgvi.MoserVeselovIntegrator(0.1)
TIMES = 0.05 * np.arange(30)
RATES = np.tile(VECTOR, (30, 1))
FACETS = lgvi.Facets(VECTOR, EYE, EYE)
ATTITUDES = Rotation.from_rotvec(TIMES[:, None] * VECTOR).as_matrix()
RECORDINGS = Recordings.from_arrays(TIMES, attitude=ATTITUDES, angular_velocity=RATES)
SENSORS = lgvi.AttitudeSensor(1e-3), lgvi.Gyroscope(1e-3)
MODEL = Model(lgvi.PhysicalRigidBody.from_inertia(GENERIC), SENSORS)
STATES = InitialStates(EYE[None], VECTOR[None])


def no_torque(t, R):
    return jnp.zeros(3)


def no_force(t, R, omega, v):
    return jnp.zeros(3)


# A function, and arguments with which it works.
CALLS: dict[str, tuple[Any, dict[str, Any]]] = {
    "solve_F": (lgvi.solve_F, {"pi": PI0, "J": GENERIC, "h": 0.1, "newton_iters": 8}),
    "solve_F_with_info": (
        lgvi.solve_F_with_info,
        {"pi": PI0, "J": GENERIC, "h": 0.1, "tolerance": 1e-9, "rotor_momentum": VECTOR},
    ),
    "rigid_body_step": (
        lgvi.rigid_body_step,
        {"R": EYE, "pi": PI0, "J": GENERIC, "torque_k": VECTOR, "torque_next": VECTOR, "dt": 0.1},
    ),
    "simulate_rigid_body": (
        lgvi.simulate_rigid_body,
        {"R0": EYE, "pi0": PI0, "J": GENERIC, "body_torques": np.zeros((4, 3)), "dt": 0.1},
    ),
    "RigidBody": (lgvi.RigidBody, {"inertia": GENERIC}),
    "RigidBody.from": (
        lgvi.RigidBody.from_principal_moments,
        {"moments": [1, 2, 2.5], "axes": EYE},
    ),
    "PhysicalRigidBody": (lgvi.PhysicalRigidBody, {"log_cholesky": np.zeros(6)}),
    "PhysicalRigidBody.from": (
        lgvi.PhysicalRigidBody.from_principal_moments,
        {"moments": [1, 2, 2.5], "axes": EYE},
    ),
    "PhysicalRigidBody.from_inertia": (
        lgvi.PhysicalRigidBody.from_inertia,
        {"inertia": GENERIC},
    ),
    "KnownAxesRigidBody": (
        lgvi.KnownAxesRigidBody,
        {"log_second_moments": np.zeros(3), "axes": EYE},
    ),
    "KnownAxesRigidBody.from": (
        lgvi.KnownAxesRigidBody.from_principal_moments,
        {"moments": [1, 2, 2.5], "axes": EYE},
    ),
    "KnownAxesRigidBody.axisymmetric": (
        lgvi.KnownAxesRigidBody.axisymmetric,
        {"moments": [1, 1.5], "axis": VECTOR},
    ),
    "freeze": (lgvi.freeze, {"model": STEP, "where": lambda integrator: integrator.dt}),
    "VaryingRigidBody": (lgvi.VaryingRigidBody, {"inertia": np.tile(GENERIC, (4, 1, 1))}),
    "DampedBody": (
        lgvi.DampedBody,
        {"inertia": GENERIC, "axis": VECTOR, "wheel_inertia": 0.1, "friction": 0.1},
    ),
    "DampedBody.simulate": (
        lgvi.DampedBody(GENERIC, VECTOR, 0.1, 0.1).simulate,
        {"R0": EYE, "pi0": PI0, "spin0": 0.0, "dt": 0.1, "steps": 2, "save_every": 1},
    ),
    "Gyrostat": (lgvi.Gyrostat, {"inertia": GENERIC, "rotor_momentum": VECTOR}),
    "MassProperties": (lgvi.MassProperties, {"mass": 1.0, "centre": VECTOR, "inertia": GENERIC}),
    "MassProperties.box": (lgvi.MassProperties.box, {"mass": 1.0, "sides": VECTOR}),
    "MassProperties.cylinder": (
        lgvi.MassProperties.cylinder,
        {"mass": 1.0, "radius": 0.1, "length": 0.2},
    ),
    "MassProperties.sphere": (lgvi.MassProperties.sphere, {"mass": 1.0, "radius": 0.1}),
    "MassProperties.rod": (lgvi.MassProperties.rod, {"mass": 1.0, "length": 0.1}),
    "MassProperties.from_pseudo_inertia": (
        lgvi.MassProperties.from_pseudo_inertia,
        {"P": np.eye(4)},
    ),
    "MassProperties.moved": (SPHERE.moved, {"by": VECTOR}),
    "MassProperties.rotated": (SPHERE.rotated, {"R": EYE}),
    "MassProperties.inertia_about": (SPHERE.inertia_about, {"point": VECTOR}),
    "MassProperties.from_urdf": (
        lgvi.MassProperties.from_urdf,
        {"text": SPHERE.to_urdf(), "link": None},
    ),
    "MassProperties.from_mjcf": (
        lgvi.MassProperties.from_mjcf,
        {"text": SPHERE.to_mjcf(), "body": None},
    ),
    "integrator": (
        lgvi.MoserVeselovIntegrator,
        {"dt": 0.1, "newton_iters": 8, "tolerance": 1e-9, "throw": True, "order": 2}
        | {"force_gradient": True},
    ),
    "step": (
        STEP.step,
        {"body": BODY, "R": EYE, "pi": PI0, "torque_k": VECTOR, "torque_next": VECTOR},
    ),
    "simulate": (
        STEP.simulate,
        {"body": BODY, "R0": EYE, "pi0": PI0, "steps": 2, "torque": None, "controller": None}
        | {"t0": 0.0, "save_every": 1},
    ),
    "simulate with forces": (
        partial(STEP.simulate, BODY, EYE, PI0, steps=2),
        {"force": no_force, "mass": 1.0, "gravity": VECTOR, "x0": VECTOR, "v0": VECTOR},
    ),
    "simulate with torques": (
        STEP.simulate,
        {"body": BODY, "R0": EYE, "pi0": PI0, "body_torques": np.zeros((4, 3))},
    ),
    "body.energy": (BODY.energy, {"pi": PI0}),
    "body.angular_velocity": (BODY.angular_velocity, {"pi": PI0}),
    "body.angular_momentum": (BODY.angular_momentum, {"omega": VECTOR}),
    "energy": (lgvi.energy, {"pi": PI0, "J": GENERIC}),
    "spatial_momentum": (lgvi.spatial_momentum, {"R": EYE, "pi": PI0}),
    "ortho_error": (lgvi.ortho_error, {"R": EYE}),
    "determinant_error": (lgvi.determinant_error, {"R": EYE}),
    "discrete_inertia": (lgvi.discrete_inertia, {"J": GENERIC}),
    "inertia_from_discrete": (lgvi.inertia_from_discrete, {"Jd": GENERIC}),
    "inertia_from_log_cholesky": (lgvi.inertia_from_log_cholesky, {"coordinates": np.zeros(6)}),
    "inertia_from_principal_moments": (
        lgvi.inertia_from_principal_moments,
        {"moments": [1, 2, 2.5], "axes": EYE},
    ),
    "log_cholesky_from_inertia": (lgvi.log_cholesky_from_inertia, {"J": GENERIC}),
    "ConstantTorque": (lgvi.ConstantTorque, {"torque": VECTOR, "frame": "body"}),
    "SampledTorque": (lgvi.SampledTorque, {"t": TIMES, "torque": RATES, "frame": "body"}),
    "GravityGradient": (lgvi.GravityGradient, {"mu": 1.0, "position": VECTOR}),
    "MagneticTorque": (lgvi.MagneticTorque, {"dipole": VECTOR, "field": VECTOR}),
    "Facets": (lgvi.Facets, {"areas": VECTOR, "normals": EYE, "centres": EYE}),
    "Facets.of_box": (lgvi.Facets.of_box, {"edges": VECTOR, "centre": VECTOR}),
    "SolarPressure": (
        lgvi.SolarPressure,
        {"facets": FACETS, "sun": VECTOR, "mirrored": 0.1, "diffuse": VECTOR, "pressure": 1.0},
    ),
    "FreeMolecularDrag": (
        lgvi.FreeMolecularDrag,
        {"facets": FACETS, "velocity": VECTOR, "density": 1.0, "drag_coefficient": 2.0},
    ),
    "Thruster": (lgvi.Thruster, {"place": VECTOR, "thrust": VECTOR, "frame": "body"}),
    "AppliedForce": (lgvi.AppliedForce, {"force": VECTOR, "frame": "body"}),
    "AirDrag": (lgvi.AirDrag, {"linear": VECTOR, "quadratic": 0.1, "wind": VECTOR}),
    "ScaledForce": (ScaledForce, {"factor": 2.0, "force": no_force}),
    "ForceSum": (ForceSum, {"terms": (no_force,)}),
    "SampledVector": (lgvi.SampledVector, {"t": TIMES, "values": RATES}),
    "UniformGravity": (lgvi.UniformGravity, {"mass": 1.0, "offset": VECTOR, "g": 9.8}),
    "PotentialTorque": (lgvi.PotentialTorque, {"potential": lambda R: R[0, 0]}),
    "LinearDamping": (lgvi.LinearDamping, {"matrix": GENERIC}),
    "QuadraticDamping": (lgvi.QuadraticDamping, {"matrix": GENERIC}),
    "ScaledTorque": (ScaledTorque, {"factor": 2.0, "torque": no_torque}),
    "TorqueSum": (TorqueSum, {"terms": (no_torque,)}),
    "AttitudeSensor": (
        lgvi.AttitudeSensor,
        {"sigma": 1e-3, "alignment": VECTOR, "time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "Gyroscope": (
        lgvi.Gyroscope,
        {"sigma": 1e-3, "bias": VECTOR, "scale": VECTOR, "alignment": VECTOR}
        | {"time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "Accelerometer": (
        lgvi.Accelerometer,
        {"position": VECTOR, "sigma": 1e-3, "gravity": VECTOR, "bias": VECTOR, "scale": VECTOR}
        | {"alignment": VECTOR, "time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "Magnetometer": (
        lgvi.Magnetometer,
        {"field": VECTOR, "sigma": 1e-3, "bias": VECTOR, "scale": VECTOR, "alignment": VECTOR}
        | {"time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "DirectionSensor": (
        lgvi.DirectionSensor,
        {"direction": VECTOR, "sigma": 1e-3, "frame": "body", "alignment": VECTOR}
        | {"time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "PositionSensor": (
        lgvi.PositionSensor,
        {"offset": VECTOR, "sigma": 1e-3, "gravity": VECTOR, "gravity_scale": 1.0}
        | {"length_scale": 1.0, "drag": 0.1, "position": VECTOR, "velocity": VECTOR}
        | {"time_offset": 0.0, "loss": lgvi.Huber()},
    ),
    "PositionSensor without gravity": (
        lgvi.PositionSensor,
        {"offset": VECTOR, "sigma": 1e-3, "gravity": None, "gravity_scale": 1.0}
        | {"length_scale": 1.0, "drag": None, "position": None, "velocity": None},
    ),
    "VelocitySensor": (
        lgvi.VelocitySensor,
        {"sigma": 1e-3, "offset": VECTOR, "frame": "body", "time_offset": 0.0}
        | {"loss": lgvi.Huber()},
    ),
    "Multirotor": (
        lgvi.Multirotor,
        {"arms": EYE, "axes": VECTOR, "thrust": 1.0, "drag": VECTOR, "lag": 0.1}
        | {"spin": (1, -1, 1), "inertia": 0.1, "behind": VECTOR, "centre": VECTOR}
        | {"in_plane_drag": 0.1},
    ),
    "Cauchy": (lgvi.Cauchy, {"threshold": 3.0}),
    "Huber": (lgvi.Huber, {"threshold": 3.0}),
    "Model": (
        Model,
        {"body": BODY, "sensors": SENSORS, "torque": no_torque, "time_scale": 1.0, "mass": 1.0}
        | {"force": no_force, "gravity": VECTOR},
    ),
    "Recordings.from_arrays": (
        Recordings.from_arrays,
        {"t": TIMES, "attitude": ATTITUDES, "angular_velocity": RATES, "body_torque": RATES},
    ),
    "Recordings.concatenate": (Recordings.concatenate, {"recordings": [RECORDINGS]}),
    "negative_log_likelihood": (
        negative_log_likelihood,
        {"recordings": RECORDINGS, "integrator": STEP},
    ),
    "initial_states": (initial_states, {"model": MODEL, "recordings": RECORDINGS}),
}
for name, arguments in {
    "hat": {"v": VECTOR},
    "vee": {"S": np.zeros((3, 3))},
    "exp": {"g": VECTOR},
    "log": {"R": EYE},
    "distance": {"R1": EYE, "R2": EYE},
    "is_rotation": {"R": EYE, "tolerance": 1e-3},
    "cayley": {"c": VECTOR},
    "cayley_inverse": {"R": EYE},
    "wxyz_to_matrix": {"wxyz": np.eye(4)[0]},
    "matrix_to_wxyz": {"R": EYE},
    "left_jacobian": {"g": VECTOR},
    "left_jacobian_inverse": {"g": VECTOR},
    "right_jacobian": {"g": VECTOR},
    "right_jacobian_inverse": {"g": VECTOR},
}.items():
    CALLS[f"so3.{name}"] = getattr(so3, name), arguments


@cache
def fitted():
    return identify(MODEL, RECORDINGS, STEP, iterations=2)


def profile(quantity, level):
    return fitted().profile(quantity, level)


# Those that compile much; most malformed arguments work.
SLOW_CALLS: dict[str, tuple[Any, dict[str, Any]]] = {
    "simulate_free_rigid_body": (
        lgvi.simulate_free_rigid_body,
        {"R0": EYE, "pi0": PI0, "J": GENERIC, "dt": 0.1, "steps": 3, "order": 2},
    ),
    "free_motion": (
        lgvi.free_motion,
        {"body": BODY, "R0": EYE, "pi0": PI0, "times": np.array([0.1, 0.2])},
    ),
    "simulate_recordings": (
        simulate_recordings,
        {"model": MODEL, "layout": RECORDINGS, "states": STATES, "integrator": STEP}
        | {"key": jax.random.key(0)},
    ),
    "identifiability": (
        identifiability,
        {"model": MODEL, "layout": RECORDINGS, "states": STATES, "integrator": STEP},
    ),
    "identify": (
        identify,
        {"model": MODEL, "recordings": RECORDINGS, "integrator": STEP, "free": lambda m: m.body}
        | {"bounds": (), "start": STATES, "segment": 1.0, "noise": "residuals"}
        | {"iterations": 2, "progress": False},
    ),
    "profile": (profile, {"quantity": lambda m: m.body.inertia[0, 0], "level": 0.9}),
}

MALFORMED = {
    "another shape": np.zeros(7),
    "no entry": np.zeros(0),
    "float": 2.0,
    "integer": 3,
    "integers": np.ones((3, 3), int),
    "half": np.ones(3, np.float16),
    "complex number": 1j,
    "complex array": np.ones((3, 3), complex),
    "string": "x",
    "None": None,
    "NaN": np.nan,
    "infinity": np.inf,
    "negative": -1.0,
    "list": [1.0, 1.0, 1.5],
    "ragged list": [[1, 2], [3]],
    "NumPy scalar": np.float32(2),
    "NumPy integer": np.int64(2),
    "boolean": True,
    "object": object(),
    "dictionary": {},
}


@pytest.mark.parametrize(
    "name", [*CALLS, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW_CALLS)]
)
@pytest.mark.filterwarnings("ignore")
def test_a_malformed_argument_is_named_or_works(name, unchecked):
    call, arguments = (CALLS | SLOW_CALLS)[name]
    unnamed = []
    with jax.numpy_dtype_promotion("standard"):  # as for a user: types may be mixed
        call(**arguments)
        for argument in arguments:
            for kind, value in MALFORMED.items():
                try:
                    call(**(arguments | {argument: value}))
                except (TypeError, ValueError, RuntimeError) as error:
                    # Where two arguments contradict each other, either may be named.
                    named = re.findall(r"`(\w+)[^`]*`", str(error))
                    if not set(named) & set(arguments):
                        unnamed.append(f"{argument} is {kind}: {error!r}")
    assert not unnamed, "\n".join(unnamed)


def test_every_public_name_is_tried():
    """Except for abstract classes and results."""
    calls = [call for call, _ in (CALLS | SLOW_CALLS).values()]
    tried = {getattr(call, "__qualname__", "").split(".")[0] for call in calls}
    results = {"SolverInfo", "Trajectory", "DampedTrajectory", "MotionState", "so3"}
    public = {name for name in public_names(lgvi.names) if not name.startswith("Abstract")}
    assert public - results <= tried
    assert {f"so3.{name}" for name in public_names(so3)} <= set(CALLS)
