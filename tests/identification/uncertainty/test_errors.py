"""Standard errors of every kind: against dense linear algebra, further fits, and the truth."""

import csv
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student

import lgvi
from lgvi.identification import Model, Recordings, identify
from lgvi.identification.model.configuration import ModelAt
from lgvi.identification.model.selection import body_of, select_free_leaves
from lgvi.identification.segments.chain import follow
from lgvi.identification.segments.segment import lay_out, whole_trajectories
from lgvi.identification.solver.elimination import STATE_SIZE, BlockArrow, triangularise
from lgvi.identification.solver.linearise import linearise_part
from lgvi.identification.start.guess import guess_states
from lgvi.identification.start.measured import largest_rates
from lgvi.identification.uncertainty.information import compute_information
from lgvi.identification.uncertainty.posterior import choose_errors
from lgvi.identification.uncertainty.report_table import format_alike
from lgvi.identification.uncertainty.sandwich import (
    cluster_blocks,
    cluster_trajectories,
    compute_sandwich,
)

from ...systems import rng
from ..recorded import (
    ISOTROPIC,
    MODEL,
    MOMENTS,
    SIGMA_R,
    SIGMA_W,
    moments,
    ratios,
    trajectories,
)

WINDOWS, COMMON, ROWS = 5, 3, 40
FREE = np.zeros(COMMON, bool)


class Problem:
    """Windows of white residuals about the minimum, and the same problem as dense matrices."""

    def __init__(self, key, position=None):
        random = rng(180, key)
        A = random.normal(size=(WINDOWS, ROWS, STATE_SIZE + COMMON))
        A = A * 10.0 ** random.integers(-2, 3, STATE_SIZE + COMMON)
        A[..., 2] = (
            A[..., STATE_SIZE] * A[..., 2] / abs(A[..., STATE_SIZE])
        )  # own unknowns matter to others
        self.A = np.zeros((WINDOWS * ROWS, WINDOWS * STATE_SIZE + COMMON))
        for i in range(WINDOWS):
            rows = slice(i * ROWS, (i + 1) * ROWS)
            self.A[rows, i * STATE_SIZE : (i + 1) * STATE_SIZE] = A[i, :, :STATE_SIZE]
            self.A[rows, -COMMON:] = A[i, :, STATE_SIZE:]
        self.gaps = np.zeros((0, self.A.shape[1]))
        gaps = None
        if position is not None:
            gaps = 1e7 * random.normal(size=(WINDOWS, STATE_SIZE, 2 * STATE_SIZE + COMMON + 1))
            gaps[:, :, :-1] *= np.abs(A[0, 0, [*range(STATE_SIZE), *range(STATE_SIZE + COMMON)]])
            gaps[:, :, -1] = 0
            gaps[np.roll(position, -1) == 0] = 0
            for i in np.flatnonzero(np.roll(position, -1)):
                row = np.zeros((STATE_SIZE, self.A.shape[1]))
                row[:, (i + 1) * STATE_SIZE : (i + 2) * STATE_SIZE] = gaps[i, :, :STATE_SIZE]
                row[:, i * STATE_SIZE : (i + 1) * STATE_SIZE] = gaps[
                    i, :, STATE_SIZE : 2 * STATE_SIZE
                ]
                row[:, -COMMON:] = gaps[i, :, 2 * STATE_SIZE : -1]
                self.gaps = np.concatenate([self.gaps, row])
        rows = np.concatenate([self.A, self.gaps])
        self.scale = np.linalg.norm(rows, axis=0)
        whole = np.linalg.qr(rows / self.scale)[0][: len(self.A)]
        self.H = whole @ whole.T
        noise = random.normal(size=len(self.A))
        self.residual = noise - self.H @ noise
        table = np.concatenate([A, self.residual.reshape(WINDOWS, ROWS, 1)], axis=2)
        self.table = table
        self.system = BlockArrow(triangularise(table), gaps, position)
        self.known = compute_information(self.system, FREE)

    def dense(self, cluster, c):
        """Variance and degrees of freedom of `c @ theta`, by their definitions."""
        rows = np.concatenate([self.A, self.gaps]) / self.scale
        root = np.linalg.inv(triangularise(rows)) / self.scale[:, None]
        x = root @ (root.T @ np.append(np.zeros(self.A.shape[1] - COMMON), c))
        variance, columns = 0.0, []
        left = np.eye(len(self.A)) - self.H
        for i in np.unique(cluster):
            at = cluster == i
            values, axes = np.linalg.eigh(left[np.ix_(at, at)])
            power = np.where(values > 1e-7, abs(values), np.inf) ** -0.5
            e = (axes * power) @ axes.T @ (self.A[at] @ x)
            variance += (e @ self.residual[at]) ** 2
            columns.append(left[at].T @ e)
        P = np.array(columns) @ np.array(columns).T
        return variance, np.trace(P) ** 2 / np.sum(P**2), np.trace(P), x[-COMMON:] @ c


@pytest.mark.parametrize("kind", ["trajectories", "blocks", "segments"])
def test_the_sandwich_is_that_of_the_dense_problem(kind):
    """CR2 and Satterthwaite's degrees of freedom; unbiased where the noise is white."""
    position = np.array([0, 1, 2, 0, 1]) if kind == "segments" else None
    problem = Problem(1, position)
    if kind == "trajectories":
        clusters = cluster_trajectories(problem.system, problem.known)
        cluster = np.repeat(np.arange(WINDOWS), ROWS)
    else:
        blocks = triangularise(problem.table.reshape(WINDOWS, 2, ROWS // 2, -1))
        clusters = cluster_blocks(problem.system, blocks, problem.known, 12)
        cluster = np.repeat(np.arange(2 * WINDOWS), ROWS // 2)
    found = compute_sandwich(clusters, problem.known, 1.0)
    for c in np.eye(COMMON):
        variance, freedom, mean, white = problem.dense(cluster, c)
        assert mean == pytest.approx(white, rel=1e-5)
        assert found.covariance_of(c[None])[0, 0] == pytest.approx(variance, rel=1e-5)
        assert found.freedom_of(c[None])[0] == pytest.approx(freedom, rel=1e-5)
        assert 1 < freedom < len(np.unique(cluster))


def test_blocks_of_time_are_put_together_until_there_are_about_as_many_as_asked_for():
    problem = Problem(2, np.array([0, 1, 2, 0, 1]))
    blocks = triangularise(problem.table.reshape(WINDOWS, 2, ROWS // 2, -1))
    few = cluster_blocks(problem.system, blocks, problem.known, 4)
    assert len(few.rows) == 4
    gram = np.einsum("nrj,nrk->jk", few.rows, few.rows)
    np.testing.assert_allclose(gram[:COMMON, :COMMON], np.eye(COMMON), atol=1e-7)


def test_of_many_segments_the_states_follow_from_the_first():
    problem = Problem(1, np.arange(WINDOWS))
    blocks = triangularise(problem.table.reshape(WINDOWS, 2, ROWS // 2, -1))
    exact = cluster_blocks(problem.system, blocks, problem.known, 10)
    found = cluster_blocks(problem.system, blocks, problem.known, 10, most_own=1)
    assert found.rows.shape[2] == COMMON + STATE_SIZE < exact.rows.shape[2]
    sandwiches = [compute_sandwich(each, problem.known, 1.0) for each in (exact, found)]
    variances = [np.diag(each.covariance_of(np.eye(COMMON))) for each in sandwiches]
    np.testing.assert_allclose(*variances, rtol=1e-4)


def test_blocks_of_time_of_many_trajectories_are_the_trajectories():
    problem = Problem(2)
    blocks = cluster_blocks(problem.system, None, problem.known, WINDOWS)
    for found, expected in zip(
        blocks, cluster_trajectories(problem.system, problem.known), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_what_one_trajectory_alone_decides_has_the_error_of_independent_noise():
    problem = Problem(3)
    table = problem.table.copy()
    table[1:, :, STATE_SIZE] = 0
    table[0, :, STATE_SIZE + 1 : -1] = 0  # it decides nothing else
    system = BlockArrow(triangularise(table))
    known = compute_information(system, FREE)
    found = compute_sandwich(cluster_trajectories(system, known), known, 0.7)
    alone = np.eye(COMMON)[:1]
    np.testing.assert_allclose(found.covariance_of(alone), 0.7 * known.covariance_of(alone))
    assert found.freedom_of(alone) == 1


def test_intervals_hold_where_noise_is_correlated_in_time():
    """Ten trajectories of noise that is correlated by 0.9, 400 times; independent: under 60 %."""
    random, samples, held, naive = rng(181), 60, [], []
    t = np.linspace(0, 1, samples)[:, None]
    for _ in range(400):
        waves = np.sin(
            2 * np.pi * random.uniform(0.5, 3, (10, 1, STATE_SIZE + COMMON)) * t
            + random.uniform(0, 6, (10, 1, STATE_SIZE + COMMON))
        )
        e = np.asarray(lfilter([1], [1, -0.9], random.normal(size=(10, samples + 100)), axis=1))
        e = e[:, 100:]
        system = BlockArrow(triangularise(np.concatenate([waves, e[..., None]], axis=2)))
        known = compute_information(system, FREE)
        # The estimate, zero in truth, from the rows that are left of all trajectories.
        clusters = cluster_trajectories(system, known)
        y = -np.einsum("nrk,nr->k", clusters.rows, clusters.residuals)
        moved = clusters._replace(residuals=clusters.residuals + clusters.rows @ y)
        found = compute_sandwich(moved, known, 1.0)
        theta = known.whiten(np.eye(COMMON)) @ y
        errors = np.sqrt(np.diag(found.covariance_of(np.eye(COMMON))))
        width = errors * student.ppf(0.975, found.freedom_of(np.eye(COMMON)))
        held.append(abs(theta) < width)
        variance = np.sum(moved.residuals**2) / (10 * (samples - STATE_SIZE) - COMMON)
        naive.append(abs(theta) < 1.96 * np.sqrt(variance * np.diag(known.covariance())))
    assert np.mean(naive) < 0.6
    np.testing.assert_allclose(np.mean(held), 0.95, atol=0.025)


def test_windows_are_made_of_blocks_with_as_many_readings_of_each_channel():
    long, short = trajectories(1, rates=True), trajectories(1, key=1, samples=37, rates=True)
    ends = np.arange(37) > 30
    given = Recordings.concatenate([long, short.drop_samples("angular_velocity", ends)])
    model = Model(ISOTROPIC, (lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)))
    free, method = select_free_leaves(model, body_of, ()), lgvi.MoserVeselovIntegrator(1.0)
    windows = whole_trajectories(given)
    (layout,) = lay_out(given, [windows], np.full(2, 0.03), model)
    states = guess_states(model, given, windows, largest_rates(model, given))
    at = ModelAt(model, free.selected, free.theta, None)
    found = linearise_part(at, states, layout, method, blocks=4)
    blocks, triangles = np.asarray(found.blocks), found.system.triangles
    gram = np.einsum("nbrj,nbrk->njk", blocks, blocks)
    expected = np.einsum("nrj,nrk->njk", triangles, triangles)
    np.testing.assert_allclose(gram, expected, rtol=1e-6, atol=1e-9 * np.max(expected))
    squares = np.zeros((2, 4))
    for channel, r in follow(at, states, layout, method).residuals.items():
        for i, of_trajectory in enumerate(given.channels[channel].split(r)):
            ends = np.arange(5) * len(of_trajectory) // 4
            parts = np.split(of_trajectory, ends[1:-1])
            squares[i] += [np.sum(part**2) for part in parts]
    np.testing.assert_allclose(np.sum(blocks[..., -1] ** 2, axis=2), squares, rtol=1e-9)


def test_errors_of_all_kinds_agree_where_the_noise_is_white(estimate):
    alone = estimate.standard_error(ratios, "independent")
    for kind in ("clustered", "correlated"):
        ratio = estimate.standard_error(ratios, kind) / alone
        assert np.all((ratio > 0.4) & (ratio < 2.5))
    assert estimate.errors == "correlated"  # three trajectories
    np.testing.assert_array_equal(
        estimate.standard_error(ratios), estimate.standard_error(ratios, "correlated")
    )
    lower, upper = estimate.interval(ratios)
    assert np.all((lower < MOMENTS / MOMENTS.sum()) & (MOMENTS / MOMENTS.sum() < upper))
    wide = estimate.interval(ratios, level=0.99)
    assert np.all((wide[0] < lower) & (upper < wide[1]))
    lower, upper = estimate.interval(ratios, "independent")
    times = student.ppf(0.975, estimate.degrees_of_freedom)
    np.testing.assert_allclose(upper - lower, 2 * times * alone, rtol=1e-9)
    assert np.all(np.isinf(estimate.interval(moments)[1]))


@pytest.mark.slow
def test_draws_of_the_bootstrap_keep_bounds():
    """A draw that ends at a bound is one like others."""

    def bias_of(model):
        return model.sensors["angular_velocity"].bias

    recorded = trajectories(4, key=21, rates=True, bias=(0.1, -0.1, -0.1))
    model = Model(ISOTROPIC, (lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)))
    options: dict[str, Any] = {"free": lambda m: (m.body, bias_of(m))}
    estimate = identify(model, recorded, **options)
    most = float(bias_of(estimate.model)[0] + 0.3 * bias_of(estimate.standard_error())[0])
    limited = identify(model, recorded, bounds=[(bias_of, -1.0, most)], **options)
    draws = limited.bootstrap.draws
    assert np.isfinite(draws).all()
    first = draws[:, limited.free.names.index("angular_velocity.bias[0]")]
    assert np.all(first <= most)
    assert 20 < np.sum(first == most) < 180


def test_a_draw_of_the_bootstrap_is_the_fit_to_the_trajectories_drawn(tosses, estimate):
    counts = np.random.default_rng(0).multinomial(3, np.full(3, 1 / 3), 200)
    draw = next(i for i, count in enumerate(counts) if sorted(count) == [0, 1, 2])
    each = [tosses.drop(set(tosses.names) - {name}) for name in tosses.names]
    drawn = [one for one, count in zip(each, counts[draw], strict=True) for _ in range(count)]
    fitted = identify(MODEL, Recordings.concatenate(drawn))
    found = estimate.free.put(estimate.model, estimate.bootstrap.draws[draw])
    errors = fitted.standard_error(ratios, "independent")
    np.testing.assert_allclose((ratios(found) - ratios(fitted.model)) / errors, 0, atol=0.03)
    far = (ratios(found) - ratios(estimate.model)) / errors
    assert np.max(abs(far)) > 0.3
    assert np.isfinite(estimate.bootstrap.draws).all()
    errors = estimate.standard_error(ratios, "bootstrap")
    lower, upper = estimate.interval(ratios, "bootstrap", level=0.9)
    assert np.all((0.1 * errors < upper - lower) & (upper - lower < 10 * errors))
    assert np.all(np.isinf(estimate.standard_error(moments, "bootstrap")))


def test_the_table_has_intervals_and_values_end_where_their_errors_do(estimate):
    text = str(estimate)
    assert all(len(line) <= 100 for line in text.splitlines())
    assert text.startswith("verdict: the model holds")
    head = text.splitlines()[2]
    assert head.split() == [
        "value",
        "std.",
        "error",
        "95",
        "%",
        "interval",
        "unit",
    ]
    (row,) = (line for line in text.splitlines() if line.startswith("principal moment, largest"))
    value, error, lower, _, upper, unit = row.split()[3:]
    assert {len(x.split(".")[1]) for x in (value, error, lower, upper)} == {len(value) - 2}
    assert len(error.strip("0.")) == 2
    assert unit == "1"
    assert "correlated (from the scatter of 18 blocks of time in 3 trajectories)" in text
    drawn = str(replace(estimate, errors="bootstrap"))
    assert "bootstrap (from 200 draws of 3 trajectories)" in drawn
    assert "independent of all others" in str(replace(estimate, errors="independent"))


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (1.23456, 0.0123, ("1.235", "0.012")),
        (1234.5, 120.0, ("1234", "120")),
        (2.34567e-5, 1.2e-8, ("2.3457e-05", "0.0012e-05")),
        (1.5e9, 2.2e6, ("1.5000e+09", "0.0022e+09")),
        (0.0, 0.5, ("0.00", "0.50")),
        (-0.12, 0.0999, ("-0.120", "0.100")),
        (0.0, 3.3e-4, ("0.00000", "0.00033")),
        (1.5, np.inf, ("1.5", "inf")),
        (1.5, 0.0, ("1.5", "0")),
    ],
)
def test_a_value_is_written_with_the_last_digit_of_its_error(value, error, words):
    written = format_alike(value, error)
    assert (written(value), written(error)) == words


def test_the_summary_is_the_table_and_files_have_it(estimate, tmp_path):
    summary = estimate.summary()
    columns = ["name", "value", "standard_error", "lower", "upper", "unit", "interval_freedom"]
    assert list(summary) == columns
    of_moments = np.char.startswith(summary["name"], "principal moment")
    np.testing.assert_allclose(summary["value"][of_moments], ratios(estimate.model), rtol=1e-12)
    np.testing.assert_allclose(
        summary["standard_error"][of_moments], estimate.standard_error(ratios), rtol=1e-6
    )
    for name, ends in zip(("lower", "upper"), estimate.interval(ratios), strict=True):
        np.testing.assert_allclose(summary[name][of_moments], ends, rtol=1e-9)
    width = summary["standard_error"] * student.ppf(0.975, summary["interval_freedom"])
    half = (summary["upper"] - summary["lower"])[of_moments] / 2
    np.testing.assert_allclose(half, width[of_moments], rtol=1e-9)
    estimate.to_csv(tmp_path / "numbers.csv")
    with open(tmp_path / "numbers.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["unit"] for row in rows] == summary["unit"].tolist()
    np.testing.assert_array_equal([float(row["lower"]) for row in rows], summary["lower"])
    estimate.to_json(tmp_path / "numbers.json")
    content = json.loads((tmp_path / "numbers.json").read_text(encoding="utf-8"))
    assert content["value"] == summary["value"].tolist()
    assert all(len(content[name]) == len(summary["name"]) for name in summary)
    assert content["standard_error"][0] is None  # of the scale, which is not observable
    assert (content["errors"], content["converged"]) == ("correlated", True)
    assert content["verdict"] == estimate.verdict
    assert [each["gain"] for each in content["suspects"]] == [s.gain for s in estimate.suspects]
    assert (
        repr(estimate) == f"Estimate({len(estimate.recordings)} trajectories, 6 numbers, converged)"
    )
    shown = estimate._repr_html_()
    assert shown.startswith(f"<b>verdict: {estimate.verdict}</b><table>")
    assert shown.count("<tr>") == 1 + len(summary["name"])
    other = estimate.with_errors("independent")
    found = other.summary()["standard_error"][of_moments]
    np.testing.assert_allclose(found, estimate.standard_error(ratios, "independent"), rtol=1e-6)
    assert "standard errors: independent" in str(other)
    with pytest.raises(ValueError, match="Argument `errors` must be one of"):
        estimate.with_errors("all")


def test_the_size_of_the_residuals_is_that_of_the_noise(estimate):
    (rms,) = estimate.residual_rms.values()
    assert rms.shape == (3,)
    np.testing.assert_allclose(rms, SIGMA_R, rtol=0.2)
    given = estimate.model.sensors["attitude"].sigma * np.sqrt(estimate.variance)
    assert np.sqrt(np.mean(rms**2)) == pytest.approx(float(given), rel=1e-9)


def test_errors_are_chosen_by_what_the_recordings_are():
    assert choose_errors(10, 100, "residuals")[0] == "clustered"
    assert choose_errors(9, 100, "residuals")[0] == "correlated"
    assert choose_errors(10, 100, "given")[0] == "independent"
    assert choose_errors(10, 0, "residuals")[0] == "independent"


def test_wrong_errors_are_told(tosses, estimate, unchecked):
    wrong: Any = "robust"
    with pytest.raises(ValueError, match=r"`errors` must be one of .* but is 'robust'"):
        identify(MODEL, tosses, errors=wrong)
    with pytest.raises(ValueError, match="`errors` must be one of"):
        estimate.covariance(errors=wrong)
    with pytest.raises(ValueError, match="for a single trajectory"):
        identify(MODEL, tosses.drop(tosses.names[1:]), errors="clustered")
    with pytest.raises(ValueError, match="`level` must be a probability"):
        estimate.interval(ratios, level=95)
