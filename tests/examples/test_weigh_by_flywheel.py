"""The example finds what its object is, writes a model of it, and refuses bad files."""

import re
from typing import Any

import mujoco
import numpy as np
import pytest
import weigh_by_flywheel

MUJOCO: Any = mujoco


@pytest.mark.slow
def test_an_object_is_weighed(output, tmp_path):
    picture, model = tmp_path / "object.png", tmp_path / "object.xml"
    text = output(weigh_by_flywheel, "--plot", picture, "--model", model)
    assert text.startswith("verdict: the model holds")
    rows = re.findall(r"\) +(\S+) +(\S+)  truth +(\S+), off by ([-+]\d+\.\d+) errors$", text, re.M)
    assert len(rows) == 6
    found, error, true, off = np.array(rows, float).T
    assert np.all(abs(off) < 4)
    assert np.all(error[:3] < 0.01 * true[:3])
    assert np.all(error[3:] < 0.1)
    assert picture.stat().st_size > 10_000
    weighed = MUJOCO.MjModel.from_xml_path(str(model))
    assert weighed.body_mass[1] == 0.18
    np.testing.assert_allclose(1e3 * weighed.body_ipos[1], found[3:], atol=1e-4)
    np.testing.assert_allclose(1e4 * np.sort(weighed.body_inertia[1]), found[:3], atol=1e-4)


def test_bad_files_are_refused(tmp_path, refusal):
    log = tmp_path / "log.csv"
    log.write_text("t,wx,wy,wz,ax,ay,az\n0,1,2,3,4,5,6\n", encoding="utf-8")
    assert "column `wheel`" in refusal(weigh_by_flywheel, "--data", log, log, log)
    assert "--plot needs the truth" in refusal(
        weigh_by_flywheel, "--data", log, log, log, "--plot", tmp_path / "errors.png"
    )
