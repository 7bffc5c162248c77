"""Recordings in files, which a fit reads one after another, are as good as recordings in memory."""

import json
import pickle
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings, identify, initial_states
from lgvi.identification.fit.problem import Problem, SimulatedReadings
from lgvi.identification.model.configuration import Configuration
from lgvi.identification.model.selection import body_of, select_free_leaves
from lgvi.identification.segments.levels import choose_method, whole_level
from lgvi.identification.segments.segment import Sizes

from ..recorded import ISOTROPIC, SIGMA_R, SIGMA_W, trajectory

ANY: Any = Recordings
QUATERNION, RATE = ["qw", "qx", "qy", "qz"], ["wx", "wy", "wz"]
SENSORS = lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)


def write(folder, name, **columns):
    folder.mkdir(exist_ok=True)
    parquet.write_table(pyarrow.table(columns), folder / f"{name}.parquet")


def columns_of(t, R, omega):
    """Columns of a file; where the rate is not a number it is null."""
    q = Rotation.from_matrix(R).as_quat(scalar_first=True)
    rates = {
        name: pyarrow.array(each, from_pandas=True)
        for name, each in zip(RATE, omega.T, strict=True)
    }
    return {"t": t, **dict(zip(QUATERNION, q.T, strict=True)), **rates}


@pytest.fixture(scope="module")
def recordings():
    """Three trajectories of different lengths, with half as many rates."""
    found = []
    for i, samples in enumerate([60, 47, 60]):
        ((t, R), (_, omega)) = trajectory(i, rates=True, samples=samples)[0].values()
        rates = t[::2], omega[::2]
        found.append(
            Recordings.from_arrays(t, attitude=R, angular_velocity=rates, name=f"toss {i}")
        )
    return Recordings.concatenate(found)


@pytest.fixture(scope="module")
def folder(recordings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flights")
    for name, each in zip(recordings.names, recordings, strict=True):
        (t, R), (at, rates) = each.values()
        omega = np.full((len(t), 3), np.nan)
        omega[np.searchsorted(t, at)] = rates
        write(folder, name, **columns_of(t, R, omega))
    return folder


def opened(folder, **options):
    return Recordings.open(folder, attitude=QUATERNION, angular_velocity=RATE, **options)


def assert_same(found, expected):
    assert found.names == expected.names
    for channel, samples in expected.channels.items():
        for i in reversed(range(len(expected))):
            for mine, theirs in zip(found.channels[channel].of(i), samples.of(i), strict=True):
                np.testing.assert_allclose(mine, theirs, atol=1e-15)


def test_files_hold_what_was_recorded(recordings, folder):
    stored = opened(folder)
    assert (stored.are_stored, recordings.are_stored) == (True, False)
    assert str(stored) == "3 trajectories; samples: 167 of attitude, 84 of angular velocity"
    assert_same(stored, recordings)
    for channel, samples in recordings.channels.items():
        found = stored.channels[channel]
        np.testing.assert_array_equal(found.count, samples.count)
        np.testing.assert_array_equal(found.times, samples.times)
        np.testing.assert_allclose(found.values, samples.values, atol=1e-15)
        np.testing.assert_allclose(found.value, samples.value, atol=1e-15)


def test_some_trajectories_stay_in_their_files_and_other_parts_are_read(recordings, folder):
    stored, none = opened(folder), np.zeros(167, bool)
    for function, stays in (
        (lambda x: x.select(["toss 2", "toss 0"]), True),
        (lambda x: x.select(lambda samples: len(samples["attitude"][0]) < 50), True),
        (lambda x: x.drop("toss 1", "short"), True),
        (lambda x: x.drop("toss 0").drop("toss 1"), True),
        (lambda x: x.crop(0.1, 1.0), False),
        (lambda x: x.split(1.0), False),
        (lambda x: x.drop_samples("attitude", none | (np.arange(167) == 3)), False),
        (lambda x: type(x).concatenate([x, x]), False),
    ):
        found, expected = function(stored), function(recordings)
        assert found.are_stored is stays
        assert found.dropped == expected.dropped
        assert_same(found, expected)


def test_quantities_have_times_of_their_own_where_cells_are_null(tmp_path):
    t = np.arange(4) * 1000
    rates = np.array([[1, np.nan, 3, np.nan]] * 3).T
    columns = columns_of(t, np.tile(np.eye(3), (4, 1, 1)), rates)
    write(tmp_path, "a", **columns, speed=[0.0, None, None, 1.0])
    found = opened(tmp_path, rotor_momentum="speed", time_unit="ms")
    np.testing.assert_array_equal(found.channels["angular_velocity"].times, [0, 2])
    assert found.rotor_momentum is not None
    np.testing.assert_array_equal(found.rotor_momentum.times, [0, 3])
    assert found.rotor_momentum.shape == (1,)


def test_readings_do_not_depend_on_how_many_are_in_memory(recordings, folder):
    model, stored = Model(ISOTROPIC, SENSORS), opened(folder)
    selected = select_free_leaves(model, body_of, ())
    configuration = Configuration("", stored, model, None, selected.selected, None)
    method = choose_method(model, recordings, None)
    problem = Problem(model, selected, [configuration], methods=[method])
    level = whole_level([configuration], [np.full(3, 0.05)])
    states = jax.tree.map(np.asarray, initial_states(model, recordings))
    few = replace(level.chains[0], sizes=Sizes(quick_lanes=1, at_once=1))
    expected, found = (
        SimulatedReadings(problem, each, selected.theta, states)
        for each in (level, level._replace(chains=(few,)))
    )
    for which in ("residuals", "predicted"):
        assert len(list(found.in_parts(0, which))) == 3
        for mine, theirs in zip(
            *(jax.tree.leaves(each.of_configuration(0, which)) for each in (found, expected)),
            strict=True,
        ):
            np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


def test_a_fit_of_files_is_a_fit_of_what_is_in_them(recordings, folder, tmp_path):
    expected = identify(Model(ISOTROPIC, SENSORS), recordings)
    assert expected.residuals is expected.residuals
    model = Model(ISOTROPIC, SENSORS)
    start = initial_states(model, opened(folder))
    np.testing.assert_allclose(start.R, initial_states(model, recordings).R, atol=1e-14)
    found = identify(model, opened(folder))
    np.testing.assert_allclose(found.body.inertia, expected.body.inertia, rtol=1e-9)
    both = (each.covariance(errors="independent") for each in (found, expected))
    np.testing.assert_allclose(*both, rtol=1e-6)
    assert found.chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    for channel, residuals in expected.residuals.items():
        np.testing.assert_allclose(found.residuals[channel], residuals, atol=1e-7)
        np.testing.assert_allclose(found.predicted[channel], expected.predicted[channel], atol=1e-9)
    for channel, summary in expected.parts[""].summary.items():
        for mine, theirs in zip(
            jax.tree.leaves(found.parts[""].summary[channel]),
            jax.tree.leaves(summary),
            strict=True,
        ):
            np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-7)
    assert found.suspects == ()
    assert found.verdict.endswith("(what it may leave out was not tried)")
    found.to_json(tmp_path / "fit.json")
    assert json.loads((tmp_path / "fit.json").read_text())["suspects"] is None
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.residuals["attitude"], found.residuals["attitude"])


T = np.arange(3) * 0.1
GOOD = columns_of(T, np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"t": [0.0, 0.2, 0.1]}, r"b.parquet, row 2, column `t`: must increase .* 0.1 follows 0.2"),
        ({"qw": [1.0, 1.0, 0.5]}, r"b.parquet, row 2, column `qw,qx,qy,qz`: must have length 1"),
        ({"wx": [0.0, np.inf, 0.0]}, r"b.parquet, row 1, column `wx`: must be finite, but is inf"),
        ({"wx": [0.0, None, 0.0]}, r"b.parquet, row 1, column `wx`: must be a number"),
        ({"wx": ["0", "1", "2"]}, r"b.parquet, column `wx`: must hold numbers, but holds string"),
        ({"wx": None}, r"b.parquet, column `wx`: is missing; the file has the columns t, qw"),
        ({}, r"b.parquet: there is no sample"),
    ],
)
def test_a_file_that_is_malformed_is_named(tmp_path, changed, message):
    write(tmp_path, "a", **GOOD)
    columns = {name: each for name, each in {**GOOD, **changed}.items() if each is not None}
    if not changed:
        columns = {name: each[:0] for name, each in GOOD.items()}
    write(tmp_path, "b", **columns)
    with pytest.raises(ValueError, match=message):
        opened(tmp_path)


def test_a_file_that_has_changed_is_refused(tmp_path):
    for name in ("a", "b", ".c"):
        write(tmp_path, name, **GOOD)
    stored = opened(tmp_path)
    assert stored.names == ("a", "b")
    values = stored[0]["attitude"][1]
    with pytest.raises(ValueError, match="read-only"):
        values[0] = 0
    write(tmp_path, "a", **{name: each[:2] for name, each in GOOD.items()})
    assert len(stored[0]["attitude"][0]) == 3  # it is still in memory
    stored[1]
    with pytest.raises(ValueError, match=r"a.parquet has changed since its folder was opened"):
        stored[0]


def test_samples_of_one_time_are_counted(tmp_path):
    twice = {**GOOD, "t": np.array([0.0, 0.1, 0.1])}
    for name in "ab":
        write(tmp_path, name, **twice)
    assert opened(tmp_path, duplicates="first").dropped == (
        "2 samples of attitude (same time as the one before, left out)",
        "2 samples of angular velocity (same time as the one before, left out)",
    )


def test_a_folder_that_holds_no_recordings_is_named(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match=r"a folder with a file `\*.parquet` for each"):
            opened(folder)
    with pytest.raises(TypeError, match="`folder` must be the path of a folder, but is 3"):
        ANY.open(3, attitude=QUATERNION)
    (tmp_path / "log.parquet").write_text("t,qw\n")
    with pytest.raises(
        ValueError, match=r"log.parquet: must be a Parquet file, but cannot be read as one"
    ):
        opened(tmp_path)
    write(tmp_path, "log", **GOOD)
    content = bytearray((tmp_path / "log.parquet").read_bytes())
    content[20:200] = bytes(180)
    (tmp_path / "log.parquet").write_bytes(content)
    with pytest.raises(ValueError, match=r"log.parquet: must be a Parquet file, but cannot"):
        opened(tmp_path)
    write(tmp_path, "log", **{name: each[:1] for name, each in GOOD.items()})
    with pytest.raises(ValueError, match=r"log.parquet: Trajectory 'log' must have two samples"):
        opened(tmp_path)
