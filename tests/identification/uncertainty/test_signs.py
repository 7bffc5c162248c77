"""Numbers that cannot be below zero: which they are, and what the verdict says of one that is."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.model.selection import select_free_leaves
from lgvi.identification.solver.elimination import BlockArrow, triangularise
from lgvi.identification.uncertainty.information import compute_information
from lgvi.identification.uncertainty.observability import ScaleDirection

from ...systems import inertia, rng, rotation

BODY = lgvi.PhysicalRigidBody.from_inertia(inertia([0.25, 0.35, 0.40], rotation(80)))
CAMERA = lgvi.AttitudeSensor(1e-3)
T = np.arange(60) / 40


def test_signs_are_known_of_what_cannot_be_below_zero_and_of_nothing_else():
    arms, thrust = np.eye(3)[:2], np.array([1e-6, 2e-6])
    rotors = lgvi.Multirotor(arms, np.eye(3)[2], thrust, 1e-8, 0.1, (1, -1), 1e-6)
    gyroscope = lgvi.Gyroscope(0.1, scale=np.eye(3))
    position = lgvi.PositionSensor(np.zeros(3), 0.1, np.array([0, 0, -9.81]), drag=0.0)
    law = lgvi.LinearDamping(np.eye(3)) + 2.0 * lgvi.QuadraticDamping(np.ones(3))
    model = Model(BODY, [CAMERA, gyroscope, position], law, rotors=rotors)

    def free(model):
        sensors = model.sensors
        return (
            model.body,
            model.torque,
            model.time_scale,
            model.rotor_inertia,
            *(model.rotors.arms, model.rotors.thrust, model.rotors.drag),
            *(model.rotors.lag, model.rotors.inertia),
            *(sensors["attitude"].alignment, sensors["angular_velocity"].scale),
            *(sensors["position"].gravity_scale, sensors["position"].drag),
        )

    chosen = select_free_leaves(model, free, ())
    signed = {name for name, words in zip(chosen.names, chosen.below_zero, strict=True) if words}
    damping = [name for name in chosen.names if ".matrix" in name]
    assert len(damping) == 12
    expected = {
        *(name for name in damping if not re.search(r"\[(.), (?!\1)", name)),
        *(f"angular_velocity.scale[{i}, {i}]" for i in range(3)),
        *("rotors.thrust[0]", "rotors.thrust[1]", "rotors.drag", "rotors.lag", "rotors.inertia"),
        *("position.gravity_scale", "position.drag", "time_scale"),
    }
    assert signed == expected


def test_a_leaf_that_is_scaled_with_the_inertia_stays_within_its_bounds():
    body = lgvi.PhysicalRigidBody.from_principal_moments([1e-3, 2e-3, 2.5e-3])
    model = Model(body, CAMERA, lgvi.LinearDamping(np.diag([4e-4, 5e-4, 9e-4])))

    def damping(model):
        return model.torque

    free = select_free_leaves(model, lambda m: (m.body, m.torque), [(damping, -1e-3, 1e-3)])
    rows = triangularise(rng(84).normal(size=(1, 40, 7 + len(free.theta))))
    known = compute_information(BlockArrow(rows), np.zeros(len(free.theta), bool))
    scale = ScaleDirection(free.scale_direction, ("torque.matrix",))
    _, scaled, _ = scale.to_unit_trace(model, free, known)
    leaves = ~free.of_body
    for limits, before in ((scaled.lower, free.lower), (scaled.upper, free.upper)):
        ratios = [
            theta[leaves] / x[leaves] for theta, x in ((scaled.theta, limits), (free.theta, before))
        ]
        np.testing.assert_allclose(*ratios, rtol=1e-12)
        np.testing.assert_array_equal(limits[~leaves], before[~leaves])
    np.testing.assert_allclose(scaled.theta[leaves], free.theta[leaves] / 5.5e-3, rtol=1e-9)


@pytest.mark.slow
def test_of_a_log_that_runs_backwards_the_verdict_names_the_damping():
    """Attitudes alone: the scale of inertia and damping is not observable, the sign is."""
    true = Model(BODY, CAMERA, lgvi.LinearDamping(jnp.diag(jnp.array([0.03, 0.02, 0.04]))))
    one = Recordings.from_arrays(T, attitude=np.broadcast_to(np.eye(3), (len(T), 3, 3)))
    states = InitialStates.from_rates(rng(81).normal(size=(6, 3)) * 4)
    log = simulate_recordings(
        true, Recordings.concatenate([one] * 6), states, key=jax.random.key(0)
    )
    backwards = Recordings.concatenate(
        [Recordings.from_arrays(T, attitude=each["attitude"][1][::-1]) for each in log]
    )

    def free(model):
        return model.body, model.torque

    forwards = identify(true, log, free=free)
    assert forwards.verdict == "the model holds"
    verdict = identify(true, backwards, free=free).verdict
    assert "`torque.matrix[0, 0]` is below zero by" in verdict
    assert "standard errors: the log may run backwards" in verdict
