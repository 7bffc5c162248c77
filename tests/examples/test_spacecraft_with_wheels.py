"""The plan says what the wheels show, and the identified spacecraft keeps what it promised."""

import re

import numpy as np
import pytest
import spacecraft_with_wheels


def standard_errors(text, of):
    return np.array(re.findall(rf"^{of}.*? +\S+ +(\S+)  ", text, re.MULTILINE), float)


@pytest.mark.slow
def test_wheels_show_the_scale_and_the_fit_finds_the_truth(output, tmp_path):
    picture = tmp_path / "wheels.png"
    text = output(spacecraft_with_wheels, "--rate", 10, "--plot", picture)  # a low rate is quick
    at_rest, manoeuvre, found = re.split("plan: wheel manoeuvre|identified from", text)
    assert "not observable: overall scale of the inertia" in at_rest
    assert "not observable" not in manoeuvre + found
    promised = standard_errors(manoeuvre, "principal moment, ")
    assert promised.shape == (3,)
    assert np.all(promised < 0.01 * spacecraft_with_wheels.MOMENTS)  # kg m²
    # What was promised is kept, up to the noise of 900 readings or more.
    np.testing.assert_allclose(standard_errors(found, "principal moment, "), promised, rtol=0.1)
    assert "converged after" in found

    rows = re.findall(r"^(J..|bias .) +(\S+) +(\S+) +([-+]\d+\.\d+)$", found, re.MULTILINE)
    assert len(rows) == 9
    true, identified, errors = np.array([row[1:] for row in rows], float).T
    assert np.all(abs(errors) < 4)
    np.testing.assert_allclose(true[-3:], spacecraft_with_wheels.BIAS)
    np.testing.assert_allclose(identified[:6], true[:6], atol=0.05)
    assert picture.stat().st_size > 10_000


def test_a_star_tracker_reads_at_its_own_rate():
    plan = spacecraft_with_wheels.layout(100, star_tracker=True, manoeuvre=True)
    sensors = spacecraft_with_wheels.sensors_with(np.zeros(3), 100, star_tracker=True)
    assert plan.rotor_momentum is not None
    assert plan.channels["attitude"].t.size == 61
    assert plan.channels["angular_velocity"].t.size == 3001
    assert len(sensors) == 2
    # All three wheels turn both ways, and are recorded to the end.
    assert np.ptp(plan.rotor_momentum.value, axis=(0, 1)).min() > 0.1
    assert plan.rotor_momentum.t[0, -1] == plan.channels["angular_velocity"].t[0, -1]


def test_bad_arguments_are_refused(tmp_path, refusal):
    assert "--rate must be at least 1" in refusal(spacecraft_with_wheels, "--rate", 0)
    picture = tmp_path / "absent" / "x.png"
    assert "there is no folder" in refusal(spacecraft_with_wheels, "--plot", picture)
