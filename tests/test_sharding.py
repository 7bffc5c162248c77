"""A batch on several devices: each has its part, and nothing of it goes to another."""

import pytest

from .processes import run_module


@pytest.fixture(scope="module")
def found():
    found, errors = run_module("tests.sharding", JAX_PLATFORMS="cpu")
    assert "rematerialization" not in errors
    return found


@pytest.mark.parametrize("motion", ["free", "pendulum"])
def test_trajectories_and_gradients_are_those_of_one_device(found, motion):
    assert found[motion]["difference"] < 1e-13


@pytest.mark.parametrize("motion", ["free", "pendulum"])
def test_devices_tell_each_other_only_whether_a_step_failed(found, motion):
    assert found[motion]["collectives"] == [["all-reduce", 1]]


@pytest.mark.parametrize("motion", ["free", "pendulum"])
def test_each_device_has_its_part_in_memory(found, motion):
    assert found[motion]["memory"] < 1.05 / 8


def test_a_program_for_each_device_tells_others_nothing(found):
    assert found["by_device"] == []


def test_a_failure_on_one_device_is_an_error(found):
    for case, error in found["errors"].items():
        assert "a step did not converge" in error, case


def test_outside_of_a_compiled_function_the_values_are_named(found):
    assert found["cause"] in found["eager_error"]
