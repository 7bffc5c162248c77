"""Processes that fit together, each with recordings of its own, on one machine."""

import signal
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from lgvi.identification import identify
from lgvi.identification.running.processes import SINGLE_PROCESS, ProcessGroup

from ...processes import end_together, run_together
from ..recorded import MODEL, trajectories
from . import hosts

MODULE = hosts.__name__


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
    of_processes = run_together(count, MODULE, f"fit_together({reverse})")
    for words in (each["refused"] for each in of_processes):
        assert words[0].startswith("All processes of a fit must pass the same model and options")
        assert words[0].endswith("but they differ in `iterations`.")
        assert (
            f"cannot be simulated in 9 of {9 * count} trajectories ('toss 0', 'toss 1'" in words[1]
        )
    for name, expected in alone.items():
        own, first = [each[name].pop("own") for each in of_processes], of_processes[0][name]
        reports = [each[name].pop("report") for each in of_processes]
        assert_alike(first, expected)
        assert all(each[name] == first for each in of_processes)
        recordings = hosts.recorded()[name][1]
        assert sum(own) == len(recordings.channels["attitude"].times)
        assert f"trajectories: {len(recordings)}, degrees" in reports[0]
        assert "what the model may leave out is not tried where processes fit" in reports[0]


@pytest.mark.slow
def test_two_processes_have_the_estimate_of_one(alone):
    assert_all_have_the_estimate_of_one(2, alone)


def test_a_mesh_has_devices_of_this_process_or_of_all(monkeypatch):
    devices = np.array([SimpleNamespace(process_index=i) for i in (0, 2)])
    monkeypatch.setattr(jax, "process_count", lambda: 3)
    with pytest.raises(
        ValueError, match=r"or of all 3 processes, but has those of the processes 0, 2"
    ):
        ProcessGroup.of(SimpleNamespace(devices=devices))
    assert ProcessGroup.of(SimpleNamespace(devices=devices[:1])) == SINGLE_PROCESS


@pytest.mark.slow
def test_four_processes_in_another_order_have_the_estimate_of_one(alone):
    assert_all_have_the_estimate_of_one(4, alone, reverse=True)


@pytest.mark.slow
def test_a_process_that_dies_ends_the_others_and_the_fit_goes_on_from_files(tmp_path):
    ended = end_together(2, MODULE, f"fit_with_file({str(tmp_path)!r}, killed=True)")
    assert ended[1][0] == -signal.SIGKILL
    code, _, errors = ended[0]
    assert code != 0
    lost = "Another process of the fit has ended, or the exchange with it failed."
    assert f"ConnectionError: {lost} The fit was stopped" in errors
    assert "iterations, at chi_square=" in errors
    assert sorted(each.name for each in tmp_path.iterdir()) == ["fit.0.npz", "fit.1.npz"]
    resumed = run_together(2, MODULE, f"fit_with_file({str(tmp_path)!r}, killed=False)")
    for each in tmp_path.iterdir():
        each.unlink()
    whole = run_together(2, MODULE, f"fit_with_file({str(tmp_path)!r}, killed=False)")
    for found, expected in zip(resumed, whole, strict=True):
        iterations = found.pop("iterations"), expected.pop("iterations")
        assert iterations[1] - iterations[0] == hosts.KILLED_IN - 1
        assert found == expected


@pytest.mark.slow
def test_the_script_of_the_page_fits_files_on_two_devices_of_each_process(tmp_path):
    recordings = trajectories(4)
    for number, each in enumerate(recordings):
        (t, R), name = each["attitude"], recordings.names[number]
        folder = tmp_path / "flights" / str(number % 2)
        folder.mkdir(parents=True, exist_ok=True)
        q = Rotation.from_matrix(R).as_quat(scalar_first=True)
        columns = {"t": t, **dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))}
        parquet.write_table(pyarrow.table(columns), folder / f"{name}.parquet")
    flags = "--xla_force_host_platform_device_count=2"
    of_processes = run_together(2, MODULE, f"fit_page({str(tmp_path)!r})", flags=flags)
    expected = identify(MODEL, recordings)
    for found in of_processes:
        np.testing.assert_allclose(found["theta"], expected.free.theta, atol=1e-7)
        assert found["trajectories"] == 4
    assert [each["devices"] for each in of_processes] == [4, 4]
    assert sorted(each.name for each in tmp_path.glob("*.npz")) == ["fit.0.npz", "fit.1.npz"]
