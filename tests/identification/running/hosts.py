"""Fits by several processes, each with recordings of its own."""

import os
import signal
from typing import Any

import jax
import numpy as np
import pytest

import lgvi
from lgvi.identification import Estimate, InitialStates, Model, Recordings, identify
from lgvi.identification.solver.checkpoint import Checkpoint

from ...processes import ROOT
from ..recorded import ISOTROPIC, MODEL, trajectories

ROBUST = Model(ISOTROPIC, lgvi.AttitudeSensor(1e-3, loss=lgvi.Huber(2.0)))
SIZE = (lambda model: model.body.inertia[0, 0], 1e-3, 1e-4)
KILLED_IN = 2  # iteration of a minimisation


def whole_trajectories(recordings: Recordings, mesh: Any = None) -> Estimate:
    return identify(MODEL, recordings, mesh=mesh)


def segments(recordings: Recordings, mesh: Any = None) -> Estimate:
    return identify(ROBUST, recordings, segment=0.6, prior=[SIZE], mesh=mesh)


def recorded() -> dict[str, tuple[Any, Recordings]]:
    """Fits, and what is recorded for each: trajectories of two lengths, many and few."""
    return {
        "many": (whole_trajectories, trajectories(18, samples=30)),
        "few": (
            segments,
            Recordings.concatenate(
                [trajectories(2), trajectories(3, key=1, samples=20, interval=0.02)]
            ),
        ),
    }


def numbers(estimate: Estimate) -> dict[str, Any]:
    """What is the same for all processes."""
    return {
        "theta": estimate.free.theta.tolist(),
        "covariance": {
            kind: np.diag(estimate.covariance(errors=kind)).tolist()
            for kind in ("independent", "clustered", "correlated")
        },
        "chi_square": estimate.chi_square,
        "degrees_of_freedom": estimate.degrees_of_freedom,
        "trajectories": estimate.trajectories,
        "errors": estimate.errors,
        "step_bias": estimate.step_bias,
        "converged": estimate.converged,
    }


def fit_together(reverse: bool) -> dict[str, Any]:
    """The fits by this process and the others; in reverse the last has what comes first."""
    process, count = jax.process_index(), jax.process_count()
    mesh = jax.make_mesh((count,), ("windows",))
    found = {}
    for name, (fit, recordings) in recorded().items():
        # Long trajectories and short ones are of different processes.
        parts = np.array_split(np.array(recordings.names), count)
        own = parts[-1 - process if reverse else process].tolist()
        estimate = fit(recordings.select(own), mesh)
        found[name] = numbers(estimate)
        found[name]["own"] = len(estimate.residuals["attitude"])
        found[name]["report"] = str(estimate)
    found["refused"] = refused(mesh)
    return found


def refused(mesh: Any) -> list[str]:
    """What processes are told, of which the last passes something that is wrong."""
    is_last = jax.process_index() == jax.process_count() - 1
    recordings = trajectories(9, samples=30)
    omega = np.full((9, 3), 1e9 if is_last else 1.0)
    start = InitialStates.from_rates(omega)
    with pytest.raises(ValueError, match="iterations") as differ:
        identify(MODEL, recordings, mesh=mesh, iterations=10 + is_last)
    with pytest.raises(RuntimeError, match="cannot be simulated") as too_fast:
        identify(MODEL, recordings, mesh=mesh, start=start)
    return [str(differ.value), str(too_fast.value)]


def fit_with_file(folder: str, killed: bool) -> dict[str, Any]:
    """A fit that writes what it has reached; the last process may be killed before it writes."""
    process, count = jax.process_index(), jax.process_count()
    keep: Any = Checkpoint.keep

    def kept(self, point):
        if killed and process == count - 1 and point.iteration == KILLED_IN:
            os.kill(os.getpid(), signal.SIGKILL)
        iterations.append(point.iteration)
        keep(self, point)

    iterations: list[int] = []
    recordings = trajectories(2 * count, samples=30)
    own = np.array_split(np.array(recordings.names), count)[process].tolist()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoint, "keep", kept)
        estimate = identify(
            MODEL,
            recordings.select(own),
            mesh=jax.make_mesh((count,), ("windows",)),
            checkpoint=f"{folder}/fit.npz",
        )
    return {**numbers(estimate), "iterations": len(iterations)}


def fit_page(folder: str) -> dict[str, Any]:
    """The fit by the script of the page on hosts, in a folder with the files that it reads."""
    page = (ROOT / "docs" / "scale.md").read_text(encoding="utf-8")
    script = page.split("```py\n")[1].split("```")[0]
    begin, given = "jax.distributed.initialize()", {}
    assert begin in script
    os.chdir(folder)
    exec(script.replace(begin, "pass"), given)
    return {**numbers(given["estimate"]), "devices": given["mesh"].size}
