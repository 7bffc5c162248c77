"""The example finds what its drone is, reads logs, and refuses bad ones."""

import re

import drone_inertia
import numpy as np
import pytest

from .pages import assert_page_shows


@pytest.mark.slow
def test_a_drone_is_identified_from_commands(output, tmp_path):
    picture = tmp_path / "drone.png"
    text = output(drone_inertia, "--plot", picture)
    assert_page_shows("drone_inertia", text)
    assert text.splitlines()[3] == "verdict: the model holds"
    rows = re.findall(r"\) +(\S+) +(\S+)  ([-+]\d+\.\d+)$", text, re.MULTILINE)
    assert len(rows) == 6
    true, found, errors = np.array(rows, float).T
    assert np.all(abs(errors) < 4)
    np.testing.assert_allclose(found, true, rtol=2e-3)
    assert picture.stat().st_size > 10_000


def test_bad_logs_and_arguments_are_refused(tmp_path, refusal):
    log = tmp_path / "log.csv"
    log.write_text("t,wx,wy,wz,m1,m2,m3\n0,1,2,3,4,5,6\n", encoding="utf-8")
    assert "column `m4`" in refusal(drone_inertia, "--data", log)
    assert "must be positive" in refusal(drone_inertia, "--arm", 0)
