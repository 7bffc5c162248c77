"""Pictures of bodies and motions hold what they say."""

import json
import re
from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.plotting import animate, plot_body, plot_invariants, plot_polhode
from lgvi.plotting.shapes import equivalent_box

from ..systems import inertia, rotation

BODY = lgvi.RigidBody(inertia([1.0, 2.0, 2.5], rotation(230)))
IMPOSSIBLE = lgvi.RigidBody(np.diag([1.0, 1.0, 2.1]))


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def trajectory():
    pi0 = jnp.array([0.3, 1.0, 0.2])
    return lgvi.MoserVeselovIntegrator(0.1).simulate(BODY, jnp.eye(3), pi0, steps=20)


def test_the_box_of_a_body_has_its_inertia():
    lengths, axes = equivalent_box(BODY, mass=3.0)
    moments = 3.0 / 12 * (np.sum(lengths**2) - lengths**2)
    np.testing.assert_allclose(axes @ np.diag(moments) @ axes.T, BODY.inertia, atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    relative, _ = equivalent_box(BODY)
    np.testing.assert_allclose(relative, lengths / np.max(lengths), rtol=1e-12)
    (axis,) = plot_body(BODY, mass=3.0).axes
    assert axis.get_xlabel() == "x (m)"
    with pytest.raises(ValueError, match="`body` must have an inertia that a body can have"):
        plot_body(IMPOSSIBLE)
    with pytest.raises(ValueError, match="`mass` must be above 0 kg, but is -1"):
        plot_body(BODY, mass=-1)


def test_the_polhode_and_the_errors_are_those_of_the_motion(trajectory):
    momentum: Any = plot_polhode(BODY, trajectory).axes[0].lines[0]
    drawn = np.stack(momentum.get_data_3d(), axis=1)
    np.testing.assert_allclose(drawn, trajectory.pi, rtol=1e-6)
    with pytest.raises(ValueError, match="`ax` must be axes with `projection="):
        plot_polhode(BODY, trajectory, ax=plt.figure().add_subplot())
    figure, given = plt.subplots()
    assert plot_invariants(BODY, trajectory, ax=given) is figure
    assert given.get_xlabel() == "time (s)"
    assert len(given.lines) == 3
    assert all(np.max(np.asarray(line.get_ydata())) < 1e-5 for line in given.lines)
    np.testing.assert_allclose(np.asarray(given.lines[0].get_xdata()), 0.1 * np.arange(21))


def test_moving_pictures_have_the_frames_that_are_asked_for(trajectory, tmp_path):
    film = animate(BODY, trajectory, tmp_path / "tumble.gif", frames=3)
    with Image.open(film) as opened:
        opened.seek(2)
        with pytest.raises(EOFError):
            opened.seek(3)
    page = animate(BODY, trajectory, tmp_path / "tumble.html", frames=5).read_text("utf-8")
    assert "http" not in page  # it stands by itself
    found = re.search(r'<script type="application/json">(.*?)</script>', page)
    assert found is not None
    scene = json.loads(found[1])
    assert scene["plays"]
    assert scene["speed"] == pytest.approx(0.5 * 25)  # s of the motion in a second
    (body,), (motion,) = scene["bodies"], scene["motions"]
    assert motion["times"] == [0.0, 0.5, 1.0, 1.5, 2.0]
    lengths, axes = equivalent_box(BODY)
    np.testing.assert_allclose(body["lengths"], lengths, atol=1e-5)
    (shown,) = motion["shown"]
    R = Rotation.from_quat(shown["attitudes"], scalar_first=True).as_matrix()
    np.testing.assert_allclose(R, trajectory.R @ axes, atol=1e-4)
    assert motion["at"] == [0, 5, 10, 15, 20]  # the curve goes through all stored states
    for wrong in ({"file": tmp_path / "a.avi"}, {"frames": 0}, {"fps": 0}):
        given = {"file": film, **wrong}
        with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must"):
            animate(BODY, trajectory, **given)
