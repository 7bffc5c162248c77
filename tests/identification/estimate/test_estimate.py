"""What an estimate writes, and what it becomes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings

T = np.arange(40) * 0.03
INERTIA = jnp.diag(jnp.array([1.0, 2.0, 2.8])) * 1e-3


def test_mass_properties_are_the_estimated_inertia_where_the_size_is_known():
    gyroscope, wheel = lgvi.Gyroscope(1e-3), jnp.array([0.0, 0.0, 1e-5])
    toss = Recordings.from_arrays(
        T, angular_velocity=np.zeros((40, 3)), rotor_momentum=np.full(40, 300.0)
    )
    states = InitialStates.from_rates([[3.0, 1.0, 2.0], [1.0, 4.0, -2.0]])
    model = Model(lgvi.RigidBody(INERTIA), gyroscope, rotor_inertia=wheel)
    recordings = simulate_recordings(
        model, Recordings.concatenate([toss, toss]), states, key=jax.random.key(0)
    )
    body = lgvi.PhysicalRigidBody.from_principal_moments([1e-3, 1e-3, 1e-3])
    estimate = identify(Model(body, gyroscope, rotor_inertia=wheel), recordings)
    properties = estimate.mass_properties(0.5, (0.0, 0.1, 0.0))
    assert float(properties.mass) == 0.5
    np.testing.assert_array_equal(properties.centre, [0.0, 0.1, 0.0])
    np.testing.assert_array_equal(properties.inertia, estimate.body.inertia)
    again = lgvi.MassProperties.from_urdf(properties.to_urdf())
    np.testing.assert_allclose(again.inertia, estimate.body.inertia, rtol=1e-12, atol=1e-12)
    for mass in (0.0, -1.0, np.inf):
        with pytest.raises(ValueError, match=r"Argument `mass` must be above 0 kg, but is"):
            estimate.mass_properties(mass)


def test_mass_properties_of_an_unknown_size_are_refused(estimate):
    with pytest.raises(ValueError, match=r"must determine the size of the inertia"):
        estimate.mass_properties(1.0)


def test_a_dictionary_has_what_the_file_has(estimate, tmp_path):
    file = tmp_path / "result.json"
    estimate.to_json(file)
    content = json.loads(file.read_text("utf-8"))
    assert content == json.loads(json.dumps(estimate.as_dict(), allow_nan=False))
    assert content["verdict"] == estimate.verdict
    assert content["value"][1:] == estimate.summary()["value"][1:].tolist()


def test_a_page_has_the_verdict_and_the_numbers(estimate, tmp_path):
    page = estimate.to_html(tmp_path / "report.html").read_text("utf-8")
    assert "The model holds" in page
    for name in estimate.summary()["name"]:
        assert name in page
