"""How often the intervals of a joint fit hold: a device with a flywheel, bare and with bodies.

On request: `python -m pytest -n 0 -q -s -o python_files="proof_joint.py" tests/benchmarks`.
The device flies alone, with a body that is known, and with five that are not; the flywheel's
inertia comes out of the body that is known. Motion by the order 2 of the integrator with steps of a
twentieth of the interval, noise by NumPy.
"""

import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identify_jointly,
    simulate_recordings,
)

from ..systems import inertia, rng, rotation

REPETITIONS, THROWS, SAMPLES, INTERVAL, SIGMA = 100, 4, 100, 0.005, 5e-3
DEVICE = inertia([2.1e-4, 3.0e-4, 3.6e-4], rotation(300))
PROOF = inertia([1.5e-4, 2.5e-4, 3.2e-4], rotation(301))
MOMENTS = 1e-4 * np.array(
    [[1.0, 1.6, 2.0], [2.0, 2.5, 3.0], [0.6, 0.9, 1.2], [3.0, 3.5, 5.0], [1.0, 1.2, 1.4]]
)
OBJECTS = [inertia(each, rotation(302 + i)) for i, each in enumerate(MOMENTS)]
WHEEL, BIAS = 2e-5, np.array([0.01, -0.02, 0.03])


def model_of(J, p):
    gyroscope = lgvi.Gyroscope(SIGMA, bias=p["bias"])
    return Model(lgvi.RigidBody(J), gyroscope, rotor_inertia=p["wheel"])


def bare(p):
    return model_of(p["device"].inertia, p)


def proven(p):
    return model_of(p["device"].inertia + PROOF, p)


def with_object(k):
    return lambda p: model_of(p["device"].inertia + p["objects"][k].inertia, p)


def parameters(device, objects, wheel, bias):
    return {
        "device": lgvi.PhysicalRigidBody.from_inertia(device),
        "objects": [lgvi.PhysicalRigidBody.from_inertia(J) for J in objects],
        "wheel": jnp.asarray(wheel),
        "bias": jnp.asarray(bias),
    }


TRUTH = parameters(DEVICE, OBJECTS, WHEEL, BIAS)
FUNCTIONS = {
    "bare": bare,
    "proven": proven,
    **{f"object {k}": with_object(k) for k in range(len(OBJECTS))},
}


def fly(model, random):
    """Throws without noise; the flywheel runs down."""
    t = np.arange(SAMPLES) * INTERVAL
    throws = []
    for i in range(THROWS):
        speed = random.uniform(150, 350) * np.exp(-t / random.uniform(0.4, 1.0))
        rotor = np.outer(speed, [0, 0, 1])
        nothing = np.zeros((SAMPLES, 3))
        throws.append(
            Recordings.from_arrays(t, angular_velocity=nothing, rotor_momentum=rotor, name=str(i))
        )
    omega = random.normal(size=(THROWS, 3))
    omega *= random.uniform(8, 14, (THROWS, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    states = InitialStates.from_rates(omega)
    integrator = lgvi.MoserVeselovIntegrator(INTERVAL / 20)
    return simulate_recordings(model, Recordings.concatenate(throws), states, integrator)


def disturbed(exact, random):
    """With noise of the gyroscope."""
    throws = []
    for name, samples in zip(exact.names, exact, strict=True):
        t, rates = samples["angular_velocity"]
        rates = rates + SIGMA * random.normal(size=rates.shape)
        rotor = samples["rotor_momentum"]
        throws.append(
            Recordings.from_arrays(t, angular_velocity=rates, rotor_momentum=rotor, name=name)
        )
    return Recordings.concatenate(throws)


def numbers(p):
    moments = [jnp.linalg.eigvalsh(body.inertia) for body in (p["device"], *p["objects"])]
    return jnp.concatenate([*moments, p["wheel"][None]])


def test_the_intervals_of_a_joint_fit_hold():
    random = rng(310)
    exact = {name: fly(function(TRUTH), random) for name, function in FUNCTIONS.items()}
    start = parameters(3e-4 * np.eye(3), [2e-4 * np.eye(3)] * len(OBJECTS), 1e-5, np.zeros(3))
    truth = np.asarray(numbers(TRUTH))
    kinds = ("clustered", "independent")
    held: dict[str, list] = {kind: [] for kind in kinds}
    off = []
    for _ in range(REPETITIONS):
        parts = {
            name: (FUNCTIONS[name], disturbed(recorded, random)) for name, recorded in exact.items()
        }
        estimate = identify_jointly(start, parts)
        assert estimate.converged
        start = estimate.parameters
        for kind in kinds:
            lower, upper = estimate.interval(numbers, kind)
            held[kind].append((lower < truth) & (truth < upper))
        error = np.asarray(numbers(estimate.parameters)) - truth
        off.append(abs(error) / np.asarray(estimate.standard_error(numbers)))
    for kind in kinds:
        each = np.mean(held[kind], axis=0)
        print(f"{kind}: {100 * np.mean(each):.1f} %, of each number {np.round(100 * each)}")
    print(f"within two standard errors: {100 * np.mean(np.array(off) < 2):.1f} %")
    assert 0.92 < np.mean(held["clustered"]) < 0.98
    assert np.all(np.mean(held["clustered"], axis=0) > 0.88)
