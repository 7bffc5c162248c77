"""Fits whose trajectories are on several devices: each has its part, and tells others nothing."""

from typing import Any

import jax
import numpy as np
import pytest

from lgvi.identification import identify

from ...processes import run_module
from ..recorded import MODEL

ANY: Any = identify


@pytest.fixture(scope="module")
def found():
    found, errors = run_module("tests.identification.running.devices", JAX_PLATFORMS="cpu")
    assert "rematerialization" not in errors
    return found


@pytest.mark.slow
@pytest.mark.parametrize("fit", ["segments", "joint", "mesh of all"])
def test_estimate_errors_and_residuals_are_those_of_one_device(found, fit):
    assert max(found[fit]) < 1e-8


@pytest.mark.slow
def test_devices_tell_each_other_nothing_and_have_as_many_segments(found):
    assert found["program"]["told"] == []
    for parts in found["program"]["parts"]:
        assert len(parts) == 8
        assert len(set(parts)) == 1


def test_a_mesh_of_one_device_changes_nothing(tosses, estimate):
    found = identify(MODEL, tosses, mesh=jax.make_mesh((1,), ("bodies",)))
    np.testing.assert_allclose(found.free.theta, estimate.free.theta, atol=1e-9)


def test_what_is_no_mesh_is_refused(tosses):
    with pytest.raises(TypeError, match=r"`mesh` must be a `jax.sharding.Mesh`, .* but is 8"):
        ANY(MODEL, tosses, mesh=8)
