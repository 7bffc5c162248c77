"""Processes that fit together, each with recordings of its own, on one machine."""

import json
import os
import signal
import socket
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from ..processes import ROOT
from . import hosts

START = """
import json, jax
jax.config.update("jax_enable_x64", True)
jax.distributed.initialize("127.0.0.1:{port}", {count}, {process}, heartbeat_timeout_seconds=10)
from tests.identification import hosts  # which makes arrays: JAX must know of the others before
print(json.dumps(hosts.{call}))
"""


def run_together(count: int, call: str) -> list[tuple[int, str, str]]:
    """What each process returns, and writes to its two streams."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", START.format(port=port, count=count, process=i, call=call)],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(count)
    ]
    ended = []
    for process in started:
        output, errors = process.communicate(timeout=300)
        ended.append((process.returncode, output, errors))
    return ended


def fit_together(count: int, call: str) -> list[dict[str, Any]]:
    """What all processes found."""
    ended = run_together(count, call)
    for code, _, errors in ended:
        assert code == 0, errors
    return [json.loads(output.splitlines()[-1]) for _, output, _ in ended]


def assert_alike(found: dict[str, Any], expected: dict[str, Any]) -> None:
    np.testing.assert_allclose(found["theta"], expected["theta"], atol=1e-9)
    for kind, variances in expected["covariance"].items():
        np.testing.assert_allclose(found["covariance"][kind], variances, rtol=1e-7)
    assert found["chi_square"] == pytest.approx(expected["chi_square"], rel=1e-9)
    for name in ("degrees_of_freedom", "trajectories", "errors", "converged"):
        assert found[name] == expected[name]


@pytest.fixture(scope="module")
def alone():
    """The numbers of the same fits by one process."""
    return {
        name: hosts.numbers(fit(recordings)) for name, (fit, recordings) in hosts.recorded().items()
    }


def assert_all_have_the_estimate_of_one(
    count: int, alone: dict[str, Any], *, reverse: bool = False
) -> None:
    of_processes = fit_together(count, f"fit_together({reverse})")
    for name, expected in alone.items():
        own, first = [each[name].pop("own") for each in of_processes], of_processes[0][name]
        reports = [each[name].pop("report") for each in of_processes]
        assert_alike(first, expected)
        assert all(each[name] == first for each in of_processes)
        recordings = hosts.recorded()[name][1]
        assert sum(own) == len(recordings.channels["attitude"].times)
        assert f"trajectories: {len(recordings)}, degrees" in reports[0]
        assert "what the model may leave out is not tried where processes fit" in reports[0]


def test_two_processes_have_the_estimate_of_one(alone):
    assert_all_have_the_estimate_of_one(2, alone)


@pytest.mark.slow
def test_four_processes_in_another_order_have_the_estimate_of_one(alone):
    assert_all_have_the_estimate_of_one(4, alone, reverse=True)


@pytest.mark.slow
def test_a_process_that_dies_ends_the_others_and_the_fit_goes_on_from_files(tmp_path):
    ended = run_together(2, f"fit_with_file({str(tmp_path)!r}, killed=True)")
    assert ended[1][0] == -signal.SIGKILL
    code, _, errors = ended[0]
    assert code != 0
    assert "ConnectionError: Another process of the fit has ended. The fit was stopped" in errors
    assert "iterations, at chi_square=" in errors
    assert sorted(each.name for each in tmp_path.iterdir()) == ["fit.0.npz", "fit.1.npz"]
    resumed = fit_together(2, f"fit_with_file({str(tmp_path)!r}, killed=False)")
    for each in tmp_path.iterdir():
        each.unlink()
    whole = fit_together(2, f"fit_with_file({str(tmp_path)!r}, killed=False)")
    for found, expected in zip(resumed, whole, strict=True):
        iterations = found.pop("iterations"), expected.pop("iterations")
        assert iterations[1] - iterations[0] == hosts.KILLED_IN - 1
        assert found == expected
