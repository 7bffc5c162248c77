"""The example finds what its object is, writes a model of it, and refuses bad files."""

import re
from typing import Any

import mujoco
import numpy as np
import pytest
import weigh_by_flywheel

from .pages import assert_page_shows

MUJOCO: Any = mujoco


@pytest.mark.slow
def test_an_object_is_weighed(output, tmp_path):
    picture, model = tmp_path / "object.png", tmp_path / "object.xml"
    text = output(weigh_by_flywheel, "--plot", picture, "--model", model)
    assert_page_shows("weigh_by_flywheel", text)
    assert text.split("\n\n")[1] == "verdict: the model holds"
    row = r"\) +\w+ +(\S+) +(\S+) +(\S+) to +(\S+) +truth +(\S+)$"
    found, error, lower, upper, true = np.array(re.findall(row, text, re.M), float).T
    assert len(true) == 6
    assert np.all((lower < true) & (true < upper))
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


def test_files_are_read_as_their_columns_say(tmp_path, monkeypatch):
    def fly(start, parts):
        raise OverflowError(parts)

    monkeypatch.setattr(weigh_by_flywheel, "identify_jointly", fly)
    files = [tmp_path / f"{name}.csv" for name in ("alone", "proof", "object")]
    for k, file in enumerate(files):
        rows = [f"{i},{t},1,2,3,4,5,6,{100 * k + t}" for i in range(2) for t in range(3)]
        file.write_text("\n".join(["trajectory,t,wx,wy,wz,ax,ay,az,wheel", *rows]), "utf-8")
    arguments = ["weigh_by_flywheel.py", "--data", *map(str, files)]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(OverflowError) as stop:
        weigh_by_flywheel.main()
    (parts,) = stop.value.args
    for k, (_, recordings) in enumerate(parts.values()):
        assert len(recordings) == 2
        np.testing.assert_array_equal(
            recordings.rotor_momentum.values.ravel(), 2 * [100 * k + t for t in range(3)]
        )
        np.testing.assert_array_equal(recordings.channels["specific_force"].values[0], [4, 5, 6])
