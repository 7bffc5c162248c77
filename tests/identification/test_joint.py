"""Several configurations in one fit, priors, and leaves that each trajectory has of its own."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import Model, Recordings, identify, identify_jointly, simulate_recordings

from ..systems import inertia, rng, rotation
from .recorded import (
    ISOTROPIC,
    MODEL,
    MOMENTS,
    SIGMA_R,
    SIGMA_W,
    J,
    errors_of,
    ratios,
    trajectories,
    trajectory,
)

OBJECT = inertia([0.8e-3, 1.1e-3, 1.5e-3], rotation(190))
AXES = np.linalg.eigh(J)[1]
WHEEL, AXIS = 4e-5, np.array([0.0, 0.6, 0.8])


def spin(t):
    """Speed of a flywheel, rad/s."""
    return (120 - 20 * t) * AXIS


def thrown(key, monkeypatch, body):
    """Three throws with a flywheel of a body with some inertia."""
    monkeypatch.setattr("tests.identification.recorded.J", body)
    options: dict[str, Any] = {"rates": True, "rotor": lambda t: WHEEL * spin(t)}
    return trajectories(3, key=key, rotor_momentum=spin, **options)


def sensors():
    return lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)


def bare(p):  # with a body of the kind of the others, so that one program serves all
    return Model(lgvi.RigidBody(p["device"].inertia), sensors(), rotor_inertia=p["wheel"])


def proven(p):
    body = lgvi.RigidBody(p["device"].inertia + OBJECT)
    return Model(body, sensors(), rotor_inertia=p["wheel"])


def with_object(p):
    body = lgvi.RigidBody(p["device"].inertia + p["object"].inertia)
    return Model(body, sensors(), rotor_inertia=p["wheel"])


@pytest.fixture
def device(monkeypatch):
    """Parameters to start from, and a device bare, with a known body, and with an unknown one."""
    parameters = {"device": ISOTROPIC, "wheel": jnp.asarray(1e-5), "object": ISOTROPIC}
    parts = {
        "bare": (bare, thrown(191, monkeypatch, J)),
        "proven": (proven, thrown(192, monkeypatch, J + OBJECT)),
        "with object": (with_object, thrown(193, monkeypatch, J + OBJECT)),
    }
    return parameters, parts


@pytest.mark.slow
def test_what_is_shared_is_found_with_its_error_passed_on(device):
    parameters, parts = device
    estimate = identify_jointly(parameters, parts)
    assert estimate.converged
    assert estimate.messages == ()
    assert estimate.unobservable == ()
    for quantity, truth in (
        (lambda p: p["wheel"], WHEEL),
        (lambda p: p["device"].inertia, J),
        (lambda p: p["object"].inertia, OBJECT),
    ):
        error = np.asarray(quantity(estimate.parameters)) - truth
        assert np.all(abs(error) < 4 * estimate.standard_error(quantity, "independent"))
    assert list(estimate.parts) == ["bare", "proven", "with object"]
    model = estimate.parts["with object"].model
    together = estimate.parameters["device"].inertia + estimate.parameters["object"].inertia
    np.testing.assert_allclose(model.body.inertia, together, rtol=1e-9)

    report = str(estimate)
    assert "object principal moment, largest" in report
    assert "proven: attitude: residual" in report
    assert max(map(len, report.splitlines())) <= 100

    # With a flywheel that is known the object is known better, by what the covariance says.
    def wheel(p):
        return p["wheel"]

    def both(p):
        return p["wheel"], p["object"].inertia[0, 0]

    covariance = estimate.covariance(both, "independent")
    exact = (wheel, estimate.parameters["wheel"], 1e-9)
    known = identify_jointly(estimate.parameters, parts, prior=[exact])
    left = covariance[1, 1] - covariance[0, 1] ** 2 / covariance[0, 0]
    assert left < 0.9 * covariance[1, 1]
    assert known.covariance(both, "independent")[1, 1] == pytest.approx(left, rel=1e-3)


def test_one_part_whose_model_is_the_parameters_is_what_identify_fits(tosses, estimate):
    joint = identify_jointly(
        MODEL, {"tosses": (lambda model: model, tosses)}, free=lambda model: model.body
    )
    np.testing.assert_allclose(ratios(joint.parameters), ratios(estimate.model), rtol=1e-7)
    for kind in ("independent", "correlated"):
        errors = [each.standard_error(ratios, kind) for each in (joint, estimate)]
        np.testing.assert_allclose(*errors, rtol=1e-5)
    assert joint.chi_square == pytest.approx(estimate.chi_square, rel=1e-9)
    assert joint.degrees_of_freedom == estimate.degrees_of_freedom
    assert "overall scale of the inertia" in joint.unobservable[0]


@pytest.mark.slow
def test_leaves_can_be_tied_by_a_function_of_fewer_parameters(tosses):
    """A body whose axes are known, and one that is axisymmetric."""

    def known_axes(p):
        second = jnp.exp(p)  # of mass, so that the moments are those of a body
        return Model(
            lgvi.RigidBody(AXES @ jnp.diag(jnp.sum(second) - second) @ AXES.T),
            lgvi.AttitudeSensor(SIGMA_R),
        )

    estimate = identify_jointly(jnp.zeros(3), {"": (known_axes, tosses)})
    assert estimate.converged

    def parts(p):
        second = jnp.exp(p)
        return (jnp.sum(second) - second) / (2 * jnp.sum(second))

    error = np.asarray(parts(estimate.parameters)) - MOMENTS / MOMENTS.sum()
    assert np.all(abs(error) < 4 * estimate.standard_error(parts, "independent"))
    free = identify(MODEL, tosses)
    known = estimate.standard_error(parts, "independent")
    assert np.all(known <= free.standard_error(ratios, "independent") * 1.01)

    # The body that knows its axes is the same.
    body = lgvi.KnownAxesRigidBody.from_principal_moments(np.full(3, 1.0), AXES)
    of_body = identify(Model(body, lgvi.AttitudeSensor(SIGMA_R)), tosses)
    assert of_body.chi_square == pytest.approx(estimate.chi_square, rel=1e-6)
    np.testing.assert_allclose(ratios(of_body.model), parts(estimate.parameters), rtol=1e-6)
    np.testing.assert_allclose(of_body.standard_error(ratios, "independent"), known, rtol=1e-3)
    assert "overall scale of the inertia" in of_body.unobservable[0]
    assert len(of_body.unobservable) == 1


def test_a_function_may_make_its_sensors(tosses):
    """Also of arrays, whose values are checked while the function is traced."""
    sigma = jnp.full(3, SIGMA_R)

    def of_ratio(p):
        moments = jnp.stack([MOMENTS[0] * p, MOMENTS[1], MOMENTS[2]])
        return Model(
            lgvi.RigidBody.from_principal_moments(moments, AXES), lgvi.AttitudeSensor(sigma)
        )

    estimate = identify_jointly(jnp.asarray(1.2), {"": (of_ratio, tosses)})
    assert estimate.converged
    error = estimate.standard_error(lambda p: p, "independent")
    assert abs(estimate.parameters - 1) < 4 * error


def test_two_leaves_can_share_one_value(tosses):
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(SIGMA_R))
    shared = eqx.nn.Shared(model, lambda m: m.rotor_inertia, lambda m: m.time_scale)
    parts = {"": (lambda s: s(), tosses)}
    with pytest.raises(ValueError, match="must choose a floating-point leaf"):
        identify_jointly(shared, parts, free=lambda s: s.pytree.rotor_inertia)
    estimate = identify_jointly(shared, parts, free=lambda s: s.pytree.body)
    assert estimate.converged


def biased(bias):
    return Recordings.concatenate(
        [trajectory(195 + i, rates=True, bias=each) for i, each in enumerate(bias)]
    )


def bias_of(model):
    return model.sensors["angular_velocity"].bias


def test_each_trajectory_has_a_bias_of_its_own():
    bias = 0.1 * rng(194).normal(size=(4, 3))
    recorded = biased(bias)
    model = Model(ISOTROPIC, sensors())
    estimate = identify(model, recorded, own=bias_of)
    assert estimate.converged
    assert estimate.messages == ()
    found = np.asarray(bias_of(estimate.own))
    np.testing.assert_allclose(found, bias, atol=5 * SIGMA_W / np.sqrt(60))
    assert np.all(abs(errors_of(estimate, ratios, MOMENTS / MOMENTS.sum())) < 5)
    # Readings, less nine numbers of each trajectory, and five ratios of the inertia.
    assert estimate.degrees_of_freedom == 4 * 60 * 6 - 4 * 9 - 5


@pytest.mark.slow
def test_own_leaves_change_no_residual_of_the_estimate():
    """The scale of the inertia cannot be told where each trajectory has its own rotor inertia."""
    recorded = trajectories(2, key=24, rotor=lambda t: WHEEL * spin(t), rotor_momentum=spin)
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(SIGMA_R), rotor_inertia=3e-5)
    integrator = lgvi.MoserVeselovIntegrator(0.03, order=2)
    estimate = identify(model, recorded, integrator, own=lambda m: m.rotor_inertia)
    assert "overall scale of the inertia" in estimate.unobservable[0]
    for i, each in enumerate(np.asarray(estimate.own.rotor_inertia)):
        alone = eqx.tree_at(lambda m: m.rotor_inertia, estimate.model, jnp.asarray(each))
        states = jax.tree.map(lambda x, i=i: x[i : i + 1], estimate.states)
        seen = simulate_recordings(alone, recorded.select([recorded.names[i]]), states, integrator)
        predicted = estimate.predicted["attitude"].reshape(2, -1, 3, 3)[i]
        np.testing.assert_allclose(seen.channels["attitude"].values, predicted, atol=1e-9)


def test_an_own_leaf_that_is_not_observable_is_told(tosses):
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(SIGMA_R), rotor_inertia=1.0)
    estimate = identify(model, tosses, own=lambda m: m.rotor_inertia)
    assert "`rotor_inertia` is not observable in 3 of 3 trajectories" in estimate.messages[-1]
    estimate = identify(Model(ISOTROPIC, sensors()), biased(np.zeros((2, 3))), own=bias_of)
    assert estimate.messages == ()


@pytest.mark.slow
def test_only_some_parts_may_have_own_leaves(tosses):
    """The names of parameters are told, and numbers in dictionaries are free."""
    bias = np.array([[0.1, 0.0, 0.0], [0.0, -0.1, 0.0]])

    def scaled(p):
        return lgvi.RigidBody(1e-3 * jnp.diag(jnp.stack([jnp.asarray(1.0), p["y"], p["z"]])))

    parts = {
        "attitudes": (lambda p: Model(scaled(p), lgvi.AttitudeSensor(SIGMA_R)), tosses),
        "both": (lambda p: Model(scaled(p), sensors()), biased(bias)),
    }
    options: dict[str, Any] = {"iterations": 3}
    estimate = identify_jointly(
        {"y": 1.2, "z": 1.4},
        parts,
        own=lambda m: bias_of(m) if "angular_velocity" in m.sensors else (),
        **options,
    )
    assert estimate.free.names == ("y", "z")
    assert bias_of(estimate.parts["both"].own).shape == (2, 3)
    assert jax.tree.leaves(estimate.parts["attitudes"].own) == []
    with pytest.raises(ValueError, match=r"In the part 'attitudes': Argument `own` must take"):
        identify_jointly({"y": 1.2, "z": 1.4}, parts, own=bias_of)
    with pytest.raises(ValueError, match=r"`own` must choose a leaf in one part"):
        identify_jointly({"y": 1.2, "z": 1.4}, parts, own=lambda m: ())


@pytest.mark.slow
def test_segments_share_the_bias_of_their_trajectory():
    recorded = biased(0.1 * rng(194).normal(size=(4, 3)))
    whole = identify(Model(ISOTROPIC, sensors()), recorded, own=bias_of)
    cut = identify(Model(ISOTROPIC, sensors()), recorded, own=bias_of, segment=0.6)
    assert cut.chi_square == pytest.approx(whole.chi_square, rel=1e-4)
    np.testing.assert_allclose(bias_of(cut.own), bias_of(whole.own), atol=0.01 * SIGMA_W)


def test_own_leaves_are_not_those_that_are_shared(tosses):
    model = Model(ISOTROPIC, sensors())
    recorded = biased(np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"`own` must not choose `angular_velocity.bias`, which"):
        identify(model, recorded, own=bias_of, free=lambda m: (m.body, bias_of(m)))
    with pytest.raises(ValueError, match="`own` must not choose leaves of the body"):
        identify(model, recorded, own=lambda m: m.body, free=bias_of)
    with pytest.raises(ValueError, match=r"`own` must not choose `attitude.sigma`"):
        identify(MODEL, tosses, own=lambda m: m.sensors["attitude"].sigma)


def of_sigma(p):
    return Model(ISOTROPIC, lgvi.AttitudeSensor(p))


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([], r"`parts` must be a mapping"),
        ({}, r"`parts` must be a mapping .* but is \{\}"),
        ({"a": MODEL}, r"`parts` must have a pair .* for 'a'"),
        ({3: (bare, None)}, r"`parts` must have names that are strings"),
        ({"a": (lambda p: p, "tosses")}, r"that of 'a' gives"),
        (
            {"a": (lambda p: MODEL, "tosses")},
            r"models that depend on what is free, but that of 'a'",
        ),
        ({"a": (of_sigma, "tosses")}, r"The `sigma` of `attitude` must not depend"),
        ({"a": (lambda p: Model(ISOTROPIC, sensors(), time_scale=p), "tosses")}, "In the part 'a'"),
    ],
)
def test_wrong_parts_are_told(tosses, parts, words):
    if isinstance(parts, dict):
        filled = {
            name: (part[0], tosses) if isinstance(part, tuple) and part[1] == "tosses" else part
            for name, part in parts.items()
        }
    else:
        filled = parts
    with pytest.raises((TypeError, ValueError), match=words):
        identify_jointly(jnp.asarray(1.0), filled)


def test_starts_belong_to_parts(tosses, estimate):
    parts = {"a": (lambda body: Model(body, list(MODEL.sensors.values())), tosses)}
    with pytest.raises(ValueError, match=r"`starts` must have names of parts, but has 'b'"):
        identify_jointly(ISOTROPIC, parts, starts={"b": estimate.states})
    wrong: Any = 3
    with pytest.raises(TypeError, match="`starts` must be a mapping"):
        identify_jointly(ISOTROPIC, parts, starts=wrong)
