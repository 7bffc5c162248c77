"""The example finds what its quadrotor is, predicts a flight, and refuses bad logs."""

import re

import numpy as np
import powered_flight
import pytest

from .pages import assert_page_shows


@pytest.mark.slow
def test_a_quadrotor_is_identified_in_wind_and_predicts_a_flight(output, tmp_path):
    picture = tmp_path / "flight.png"
    text = output(powered_flight, "--plot", picture)
    assert_page_shows("powered_flight", text)
    assert "verdict: the model holds" in text
    assert re.search(r"that (was|were) not fitted agrees? with", text)
    row = r"\) +(\S+) +(\S+) +(\S+) to +(\S+) +[-+]\d+\.\d+$"
    true, found, lower, upper = np.array(re.findall(row, text, re.MULTILINE), float).T
    assert len(true) == sum(map(len, powered_flight.TRUTH.values()))
    assert np.all((lower <= true) & (true <= upper))
    # Intervals tell something: of the moments, the mass, and the place of the IMU.
    np.testing.assert_allclose(found[:4], true[:4], rtol=5e-3)
    np.testing.assert_allclose(found[4:7], true[4:7], atol=1)  # mm
    assert picture.stat().st_size > 10_000


def test_bad_logs_and_arguments_are_refused(tmp_path, refusal):
    log = tmp_path / "log.csv"
    log.write_text("t,wx,wy,wz,ax,ay,az,x,y,z,m1,m2,m3\n", encoding="utf-8")
    assert "column `m4`" in refusal(powered_flight, "--data", log)
    assert "must be positive" in refusal(powered_flight, "--thrust", 0)
