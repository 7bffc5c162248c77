"""Torques on spacecraft: of magnets, of sunlight and of thin air."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import rng, rotation

ANY: Any = lgvi  # whose arguments a type checker does not know
FIELD, DIPOLE = np.array([2e-5, -1e-5, 3e-5]), np.array([0.1, -0.3, 0.2])
VELOCITY = np.array([500.0, -7000.0, 2500.0])
SUN = np.array([3.0, 1.0, -2.0])  # of any length
TIMES = np.linspace(0, 10, 6)
SAMPLES = rng(5).normal(size=(6, 3))


def sphere(count: int, radius: float, centre: np.ndarray) -> lgvi.Facets:
    """Faces of equal area about a sphere, on a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    around = np.sqrt(1 - z**2)
    normals = np.column_stack([around * np.cos(angle), around * np.sin(angle), z])
    areas = np.full(count, 4 * np.pi * radius**2 / count)
    return lgvi.Facets(areas, 2.5 * normals, centre + radius * normals)


@pytest.mark.parametrize("t", [0.0, 3.3])
def test_a_magnet_turns_towards_the_field(t):
    R = rotation(1)
    law = lgvi.MagneticTorque(DIPOLE, lambda t: jnp.asarray(FIELD) * (1 + t))
    field = R.T @ FIELD * (1 + t)
    np.testing.assert_allclose(law(t, R), np.cross(DIPOLE, field), rtol=1e-13)
    energy = law.potential_energy(t, R)
    np.testing.assert_allclose(energy, -DIPOLE @ field, rtol=1e-13)
    torque = lgvi.PotentialTorque(lambda R: law.potential_energy(t, R))(t, R)
    np.testing.assert_allclose(law(t, R), torque, rtol=1e-12)


def test_recorded_commands_and_a_residual_dipole_are_a_sum():
    commands, R = lgvi.SampledVector(TIMES, SAMPLES), rotation(2)
    law = lgvi.MagneticTorque(DIPOLE, FIELD) + 0.9 * lgvi.MagneticTorque(commands, FIELD)
    at = np.array([np.interp(4.2, TIMES, column) for column in SAMPLES.T])
    np.testing.assert_allclose(law(4.2, R), np.cross(DIPOLE + 0.9 * at, R.T @ FIELD), rtol=1e-13)


def photons(normal: np.ndarray, sun: np.ndarray, mirrored: float, diffuse: float) -> np.ndarray:
    """Mean momentum that a photon of unit momentum gives to a face, by drawing photons."""
    random = np.random.default_rng(0)
    momentum = -sun / np.linalg.norm(sun)
    back = momentum - 2 * (momentum @ normal) * normal
    # By Lambert's law: points on a disc about the normal, lifted onto the half sphere.
    radius, angle = np.sqrt(random.uniform(size=400_000)), random.uniform(0, 2 * np.pi, 400_000)
    across = np.linalg.svd(normal[None])[2][1:]
    leaving = (
        (radius * np.cos(angle))[:, None] * across[0]
        + (radius * np.sin(angle))[:, None] * across[1]
        + np.sqrt(1 - radius**2)[:, None] * normal
    )
    return momentum - mirrored * back - diffuse * leaving.mean(axis=0)


def test_sunlight_gives_a_face_the_momentum_of_its_photons():
    normal, centre, R = np.array([0.6, 0.0, 0.8]), np.array([0.2, -0.5, 0.1]), rotation(3)
    sun = R @ np.array([0.5, 0.3, 0.9])
    law = lgvi.SolarPressure(
        lgvi.Facets(np.array([0.7]), normal[None], centre[None]), sun, 0.3, 0.5, 1e-5
    )
    s = R.T @ sun / np.linalg.norm(sun)
    force = 1e-5 * 0.7 * (normal @ s) * photons(normal, s, 0.3, 0.5)
    np.testing.assert_allclose(law(0.0, R), np.cross(centre, force), rtol=2e-3)


def test_without_a_velocity_there_is_no_drag():
    law = lgvi.FreeMolecularDrag(lgvi.Facets.of_box(np.array([0.1, 0.2, 0.0])), np.zeros(3), 1.0)
    assert not np.any(law(0.0, np.eye(3)))
    slope = jax.jacfwd(lambda v: lgvi.FreeMolecularDrag(law.facets, v, 1.0)(0.0, np.eye(3)))
    assert np.all(np.isfinite(slope(jnp.zeros(3))))


def test_a_face_that_looks_away_feels_nothing():
    facets = ANY.Facets([0.7], [[0.0, 0.0, 1.0]], [[1.0, 2.0, 3.0]])
    away = np.array([0.3, 0.1, -1.0])
    assert not np.any(lgvi.SolarPressure(facets, away, 0.5)(0.0, np.eye(3)))
    assert not np.any(lgvi.FreeMolecularDrag(facets, 7e3 * away, 1e-12)(0.0, np.eye(3)))


@pytest.mark.parametrize("mirrored", [0.0, 1.0])
def test_sunlight_pushes_a_sphere_by_its_shadow(mirrored):
    """A black sphere and a mirror feel the pressure on their cross-section."""
    centre, R = np.array([0.1, 0.3, -0.2]), rotation(4)
    law = lgvi.SolarPressure(sphere(20_000, 0.5, centre), SUN, mirrored)
    force = -4.56e-6 * np.pi * 0.5**2 * R.T @ SUN / np.linalg.norm(SUN)
    np.testing.assert_allclose(law(0.0, R), np.cross(centre, force), rtol=2e-3)


def test_thin_air_pushes_a_sphere_by_its_shadow():
    centre, R = np.array([0.1, 0.3, -0.2]), rotation(5)
    law = lgvi.FreeMolecularDrag(sphere(20_000, 0.5, centre), VELOCITY, 1e-12, 2.0)
    v = R.T @ VELOCITY
    force = -1e-12 * np.linalg.norm(v) * v * np.pi * 0.5**2  # all momentum of the air swept
    np.testing.assert_allclose(law(0.0, R), np.cross(centre, force), rtol=2e-3)


def test_a_box_has_the_shadow_of_a_box():
    edges, centre, R = np.array([0.1, 0.2, 0.3]), np.array([0.02, -0.01, 0.03]), rotation(6)
    facets = lgvi.Facets.of_box(edges, centre)
    np.testing.assert_allclose(jnp.sum(facets.areas), 2 * (0.02 + 0.03 + 0.06), rtol=1e-12)
    flux = facets.areas[:, None] * facets.normals
    np.testing.assert_allclose(jnp.sum(flux, axis=0), 0, atol=1e-15)  # closed
    volume = np.sum(flux * (np.asarray(facets.centres) - centre)) / 3
    np.testing.assert_allclose(volume, 0.1 * 0.2 * 0.3, rtol=1e-12)
    v = R.T @ VELOCITY
    areas = np.array([0.06, 0.03, 0.02]) * abs(v)  # swept by the faces in front
    middles = centre + np.diag(np.sign(v) * edges / 2)
    torque = -1.1 * 1e-12 * sum(np.cross(a * c, v) for a, c in zip(areas, middles, strict=True))
    law = lgvi.FreeMolecularDrag(facets, VELOCITY, 1e-12)
    np.testing.assert_allclose(law(0.0, R), torque, rtol=1e-12)


FACETS = lgvi.Facets.of_box([0.1, 0.1, 0.3], [0.0, 0.0, 0.05])
SAMPLED = lgvi.SampledVector(TIMES, VELOCITY + 100 * SAMPLES)
LAWS = (
    lgvi.MagneticTorque(DIPOLE, FIELD),
    lgvi.SolarPressure(FACETS, SUN, 0.2 * jnp.ones(6), 0.3),
    lgvi.FreeMolecularDrag(FACETS, VELOCITY, 1e-11),
)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_leaves_have_exact_derivatives_in_both_precisions(dtype):
    body = lgvi.RigidBody.from_principal_moments(jnp.array([0.03, 0.03, 0.01], dtype))
    law = jax.tree.map(lambda x: jnp.asarray(x, dtype), sum(LAWS))
    integrator = lgvi.MoserVeselovIntegrator(dt=jnp.asarray(1.0, dtype))
    R0, pi0 = jnp.asarray(rotation(7), dtype), jnp.array([1e-4, 2e-4, 1e-4], dtype)

    def angle(factor):
        scaled = jax.tree.map(lambda x: x * factor, law)
        return integrator.simulate(body, R0, pi0, steps=20, torque=scaled).R[-1, 0, 1]

    one, step = jnp.ones((), dtype), 1e-5
    slope = jax.grad(angle)(one)
    assert slope.dtype == dtype
    if dtype == jnp.float64:
        change = (angle(one + step) - angle(one - step)) / (2 * step)
        np.testing.assert_allclose(slope, change, rtol=1e-6)
    else:
        assert np.isfinite(slope)


@pytest.mark.parametrize(
    "law",
    [
        lgvi.MagneticTorque(DIPOLE, SAMPLED),
        lgvi.MagneticTorque(SAMPLED, FIELD),
        lgvi.SolarPressure(FACETS, SAMPLED),
        lgvi.FreeMolecularDrag(FACETS, SAMPLED, 1e-12),
        lgvi.GravityGradient(4e14, SAMPLED, np.diag([3.0, 3.0, 1.0])),
    ],
    ids=["field", "dipole", "sun", "velocity", "position"],
)
def test_sampled_vectors_are_for_their_times_and_for_order_two(law):
    assert law.highest_order == 2
    assert "kinks at the samples" in law.reason_for_highest_order
    inside, beyond = (lambda: jnp.array([0.0, 10.0])), (lambda: jnp.array([0.0, 10.5]))
    before = law(3.0, np.eye(3))
    for throw in (True, False):
        np.testing.assert_array_equal(law.during(inside, throw)(3.0, np.eye(3)), before)
    with pytest.raises(RuntimeError, match=r"of a `SampledVector` must cover .* 10.5 s"):
        law.during(beyond, True)
    assert np.all(np.isnan(law.during(beyond, False)(3.0, np.eye(3))))


def test_a_simulation_does_not_leave_the_samples():
    body, field = lgvi.RigidBody.from_principal_moments([3.0, 3.0, 1.0]), 1e-9 * SAMPLES
    law = lgvi.MagneticTorque(DIPOLE, lgvi.SampledVector(TIMES, field))
    integrator = lgvi.MoserVeselovIntegrator(dt=0.5, throw=False)
    for steps, is_covered in ((20, True), (21, False)):
        motion = integrator.simulate(body, jnp.eye(3), jnp.zeros(3), steps=steps, torque=law)
        assert np.all(motion.solver_info.converged) == is_covered


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: ANY.MagneticTorque([1.0, 2.0], FIELD), ValueError, "`dipole` must have shape"),
        (lambda: ANY.MagneticTorque(DIPOLE, "north"), TypeError, "`field` must be"),
        (lambda: ANY.MagneticTorque(DIPOLE, lambda: 0), TypeError, "`field` must be a function"),
        (lambda: ANY.Facets(1.0, [[0, 0, 1]], [[0, 0, 1]]), ValueError, "`areas` must have shape"),
        (lambda: ANY.Facets([1.0], [[0, 1]], [[0, 0, 1]]), ValueError, "`normals` must have"),
        (lambda: ANY.Facets.of_box([1.0, 2.0]), ValueError, "`edges` must have shape"),
        (lambda: ANY.SolarPressure([1.0], SUN), TypeError, "`facets` must be `Facets`"),
        (lambda: ANY.SolarPressure(FACETS, SUN, [0.1, 0.2]), ValueError, "`mirrored` must have"),
        (lambda: ANY.SolarPressure(FACETS, 0 * SUN), ValueError, "`sun` must be finite and not"),
        (lambda: ANY.SampledVector([0.0, 2, 1], np.eye(3)), ValueError, "`t` must increase"),
        (lambda: ANY.FreeMolecularDrag(FACETS, VELOCITY, [1.0]), ValueError, "`density` must"),
        (lambda: ANY.SampledVector([0.0, 1.0], [[1.0, 2, 3]]), ValueError, "`values` must have"),
        (lambda: ANY.SampledVector(0.0, [[1.0, 2, 3]]), ValueError, "`t` must have shape"),
    ],
)
def test_wrong_arguments_are_named(make, error, words):
    with pytest.raises(error, match=words):
        make()
