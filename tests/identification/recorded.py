"""Recordings of bodies with known parameters, from SciPy, with noise."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings
from lgvi.identification.fit.problem import Problem
from lgvi.identification.model.configuration import Configuration
from lgvi.identification.model.prior import as_priors
from lgvi.identification.model.selection import body_of, select_free_leaves

from ..systems import euler_equations, inertia, rng, rotation

J = inertia([2.1e-3, 3.0e-3, 4.2e-3], rotation(100))
MOMENTS = np.array([2.1e-3, 3.0e-3, 4.2e-3])
SIGMA_R, SIGMA_W = 1e-3, 3e-3  # rad and rad/s
# What a fit of attitudes begins with where nothing is known of the body.
ISOTROPIC = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
MODEL = Model(ISOTROPIC, lgvi.AttitudeSensor(SIGMA_R))


def trajectory(
    key,
    samples=60,
    interval=0.03,
    attitudes=True,
    rates=False,
    bias=(0, 0, 0),
    alignment=(0, 0, 0),
    late=0.0,
    torque=None,
    rotor=None,
    noise=1.0,
    speed=(2, 5),
    **inputs,
):
    """One trajectory, its initial angular velocity drawn; `late` is a time offset of the rates.

    `inputs` are functions of time that are recorded.
    """
    random = rng(101, key)
    t = np.arange(samples) * interval
    omega = random.normal(size=3)
    omega *= random.uniform(*speed) / np.linalg.norm(omega)
    times = np.unique(np.concatenate([t, t + late]))
    momentum = (lambda t: np.zeros(3)) if rotor is None else rotor
    R, pi = euler_equations(
        Rotation.random(rng=random).as_matrix(), J @ omega + momentum(0.0), J, times, torque, rotor
    )
    omega = np.linalg.solve(J, (pi - np.stack([momentum(time) for time in times])).T).T
    values = {}
    if attitudes:
        error = Rotation.from_rotvec(noise * SIGMA_R * random.normal(size=(samples, 3)))
        attitude = Rotation.from_matrix(R[np.searchsorted(times, t)])
        values["attitude"] = attitude * Rotation.from_rotvec(alignment) * error
    if rates:
        error = noise * SIGMA_W * random.normal(size=(samples, 3))
        values["angular_velocity"] = omega[np.searchsorted(times, t + late)] + bias + error
    for kind, function in inputs.items():
        values[kind] = np.stack([function(time) for time in t])
    return Recordings.from_arrays(t, **values, name=f"toss {key}")


def trajectories(count, *, key=0, **options):
    return Recordings.concatenate([trajectory(10 * key + i, **options) for i in range(count)])


def problem_of(model, recordings, prior=(), free=body_of):
    """The problem that `identify` makes of a model and recordings, to be given to `fit`."""
    selected = select_free_leaves(model, free, ())
    configuration = Configuration("", recordings, model, None, selected.selected, None)
    return Problem(model, selected, [configuration], [None], as_priors(prior, model, selected))


def moments(model):
    return jnp.linalg.eigvalsh(model.body.inertia)


def ratios(model):
    return moments(model) / jnp.trace(model.body.inertia)


def errors_of(estimate, quantity, truth):
    """Errors in standard errors."""
    return (np.asarray(quantity(estimate.model)) - truth) / estimate.standard_error(quantity)
