"""Fits that are killed, and go on from a file."""

import signal
import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest

import lgvi
from lgvi.identification import Model, Recordings, identify, identify_jointly
from lgvi.identification.running.progress import Progress
from lgvi.identification.solver.checkpoint import Checkpoint

from ...processes import ROOT
from ..recorded import ISOTROPIC, MODEL, trajectories

ANY: Any = identify


class Killed(BaseException):
    pass


@pytest.fixture
def fits(tmp_path, monkeypatch):
    """A fit with a file, killed after it wrote some iterations; and the iterations that it made."""
    keep: Any = Checkpoint.keep
    iteration: Any = Progress.iteration
    made = []

    def counted(self, cost, theta):
        iteration(self, cost, theta)
        made.append(cost)

    monkeypatch.setattr(Progress, "iteration", counted)

    def run(fit, killed_after=np.inf):
        made.clear()

        def kept(self, point):
            keep(self, point)
            if len(made) == killed_after:
                raise Killed

        monkeypatch.setattr(Checkpoint, "keep", kept)
        return fit(tmp_path / "fit.npz"), len(made)

    return run


def robust(recordings, checkpoint):
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(1e-3, loss=lgvi.Huber(2.0)))
    return identify(model, recordings, segment=0.6, checkpoint=checkpoint)


def jointly(recordings, checkpoint):
    gyroscope = lgvi.Gyroscope(3e-3, bias=np.zeros(3))
    sensors = lgvi.AttitudeSensor(1e-3), gyroscope
    return identify_jointly(
        ISOTROPIC,
        {"a": (lambda body: Model(body, sensors), recordings)},
        own=lambda model: model.sensors["angular_velocity"].bias,
        checkpoint=checkpoint,
    )


@pytest.mark.parametrize(
    ("fit", "recorded"),
    [(robust, {}), pytest.param(jointly, {"rates": True}, marks=pytest.mark.slow)],
)
def test_a_fit_that_is_killed_goes_on_as_if_it_had_not_been(fits, fit, recorded, tmp_path):
    recordings = trajectories(3, **recorded)
    whole, iterations = fits(partial(fit, recordings))
    (tmp_path / "fit.npz").unlink()
    with pytest.raises(Killed):
        fits(partial(fit, recordings), killed_after=iterations // 2)
    resumed, rest = fits(partial(fit, recordings))
    assert rest == iterations - iterations // 2 + 1
    np.testing.assert_array_equal(resumed.free.theta, whole.free.theta)
    np.testing.assert_array_equal(resumed.covariance(), whole.covariance())
    assert resumed.iterations == whole.iterations
    assert [each.name for each in tmp_path.iterdir()] == ["fit.npz"]


@pytest.mark.slow
def test_a_process_that_is_killed_leaves_a_file_to_go_on_from(fits, tmp_path):
    """What it computed by optimised programs, and goes on here by others, differs by rounding."""
    script = f"""
import os, signal, jax
jax.config.update("jax_enable_x64", True)
from lgvi.identification.solver.checkpoint import Checkpoint
from tests.identification.solver.test_checkpoint import robust, trajectories
keep = Checkpoint.keep
def kept(self, point):
    keep(self, point)
    if point.iteration == 3:
        os.kill(os.getpid(), signal.SIGKILL)
Checkpoint.keep = kept
robust(trajectories(3), {str(tmp_path / "fit.npz")!r})
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    resumed, rest = fits(partial(robust, trajectories(3)))
    (tmp_path / "fit.npz").unlink()
    whole, iterations = fits(partial(robust, trajectories(3)))
    assert rest == iterations - 3
    np.testing.assert_allclose(resumed.free.theta, whole.free.theta, rtol=1e-6, atol=1e-9)


def with_prior(recordings, checkpoint, *, bounds=(), **sensor):
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(1e-3, **sensor))
    size = (lambda model: model.body.inertia[0, 0], 1e-3, 1e-4)
    return identify(model, recordings, prior=[size], bounds=bounds, checkpoint=checkpoint)


def test_a_file_of_another_fit_or_of_none_is_refused(tmp_path):
    file, tosses = tmp_path / "fit.npz", trajectories(3)
    names, (t, R) = tosses.names, trajectories(3, key=1)[1]["attitude"]
    other = Recordings.from_arrays(t, attitude=R, name=names[1])
    with_other = [tosses.select(names[:1]), other, tosses.select(names[2:])]
    done = with_prior(tosses, file)
    assert with_prior(tosses, file).chi_square == done.chi_square
    bound = [(lambda model: model.body, -20.0, 20.0)]
    for other in (
        lambda: with_prior(Recordings.concatenate(with_other), file),
        lambda: with_prior(tosses, file, bounds=bound),
        lambda: with_prior(tosses, file, loss=lgvi.Huber(2.0)),
        lambda: identify(MODEL, tosses, checkpoint=file),
        lambda: identify(MODEL, tosses, lgvi.MoserVeselovIntegrator(0.01), checkpoint=file),
    ):
        with pytest.raises(ValueError, match=r"of the same fit, but .*fit.npz is of one with"):
            other()
    for name, content in (("log.csv", b"t,x\n"), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=rf"a file that a fit wrote, but .*{name} is not"):
            identify(MODEL, tosses, checkpoint=tmp_path / name)
    with pytest.raises(ValueError, match=r"in a folder that exists, but is '.*nowhere/fit.npz'"):
        identify(MODEL, tosses, checkpoint=str(tmp_path / "nowhere" / "fit.npz"))
    with pytest.raises(TypeError, match="`checkpoint` must be the path of a file, but is 5"):
        ANY(MODEL, tosses, checkpoint=5)
