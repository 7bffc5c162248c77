"""How modules show themselves."""

import jax
import jax.numpy as jnp
import numpy as np

import lgvi
from lgvi.identification import Model, Recordings

BODY = lgvi.RigidBody(np.diag([1.0, 2.0, 2.5]))


def test_few_numbers_are_shown_as_numbers():
    assert repr(lgvi.MoserVeselovIntegrator(dt=0.1)) == "MoserVeselovIntegrator(dt=0.1)"
    assert repr(BODY) == "RigidBody(inertia=[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.5]])"
    single = lgvi.ConstantTorque(jnp.array([0.1, 0.0, -0.2], jnp.float32))
    assert "[0.1, 0.0, -0.2]" in repr(single)
    model = repr(Model(BODY, lgvi.Gyroscope(1e-3)))
    assert "sigma=0.001" in model
    assert "RigidBody(inertia=[[1.0" in model


def test_many_numbers_and_traced_ones_are_shown_by_their_shape():
    steps = lgvi.MoserVeselovIntegrator(dt=np.full(100, 0.1, np.float32))
    assert repr(steps) == "MoserVeselovIntegrator(dt=f32[100])"
    shown = []
    jax.jit(lambda dt: shown.append(repr(lgvi.MoserVeselovIntegrator(dt))))(np.float32(0.1))
    assert shown == ["MoserVeselovIntegrator(dt=f32[])"]


def test_bodies_and_recordings_have_tables_in_notebooks():
    shown = BODY._repr_html_()
    assert shown.startswith("<b>RigidBody</b>, inertia (kg m²)<table>")
    assert shown.count("<tr>") == 4
    assert "<td>2.5</td>" in shown
    t = np.arange(4) * 0.1
    named = [
        Recordings.from_arrays(t, angular_velocity=np.zeros((4, 3)), name=name)
        for name in ("<a>", "b")
    ]
    recordings = Recordings.concatenate(named)
    assert repr(recordings) == "Recordings(2 trajectories; samples: 8 of angular velocity)"
    table = recordings._repr_html_()
    assert "<td>&lt;a&gt;</td><td>0.3</td><td>4</td>" in table
    many = Recordings.concatenate([named[1]] * 30)._repr_html_()
    assert many.count("<tr>") == 22


def test_a_traced_body_has_no_table():
    shown = []
    jax.jit(lambda J: shown.append(lgvi.RigidBody(J)._repr_html_()))(np.eye(3))
    assert shown[0].startswith("<pre>RigidBody(inertia=f")
