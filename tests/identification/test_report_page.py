"""The page of a report stands by itself, says everything, and shows it to everybody."""

import dataclasses
import json
import re
from html.parser import HTMLParser
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import InitialStates, JointEstimate, Model, Recordings, identifiability
from lgvi.identification.estimate.validation import Validation, compare
from lgvi.identification.fit.part import summarise
from lgvi.plotting.inline_svg import as_svg, style_of_page
from lgvi.plotting.motions import follow_rates
from lgvi.plotting.report import KINDS, Run, write_report
from lgvi.plotting.shapes import equivalent_box

from .recorded import SIGMA_R, SIGMA_W, trajectory

EVIL = "<script>alert('toss')</script> & \"`b`\" $x$"
VOID = "meta", "input", "option"  # without an end


class Page(HTMLParser):
    """What a browser makes of a page."""

    def __init__(self, source: str):
        super().__init__()
        self.source = source
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[tuple[str, str]] = []  # each text with the innermost element
        self.open: list[str] = []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip():
            self.words.append((self.open[-1] if self.open else "", data))

    def of(self, *tags: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.elements if tag in tags]

    @property
    def text(self) -> str:
        return " ".join(words for tag, words in self.words if tag not in ("script", "style"))

    @property
    def scene(self) -> dict[str, Any]:
        (data,) = [words for tag, words in self.words if tag == "script" and words[0] == "{"]
        return json.loads(data)


def page_of(result, folder, **options) -> Page:
    return Page(write_report(result, folder / "report.html", **options).read_text("utf-8"))


def with_part(estimate, recordings, model, seed=0):
    """The estimate with other recordings, and residuals of white noise."""
    random = np.random.default_rng(seed)
    residuals = {
        channel: random.normal(size=(len(recordings.channels[channel].times), 3))
        for channel in model.sensors
    }
    predicted = {channel: recordings.channels[channel].values for channel in model.sensors}
    part = dataclasses.replace(
        estimate.parts[""],
        recordings=recordings,
        model=model,
        states=InitialStates.from_rates(np.ones((len(recordings), 3))),
        summary=summarise(model, recordings, [(recordings, residuals)]),
        simulate={"residuals": residuals, "predicted": predicted}.__getitem__,
    )
    return dataclasses.replace(estimate, parts={"": part})


@pytest.fixture(scope="module")
def page(estimate, tmp_path_factory):
    return page_of(estimate, tmp_path_factory.mktemp("page"))


def test_the_page_stands_by_itself(page):
    assert "http" not in page.source
    assert "file:" not in page.source
    assert "@import" not in page.source
    for _, attributes in page.elements:
        assert "src" not in attributes
        assert (attributes.get("href") or "#").startswith("#")
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(set(ids)) == len(ids)
    used = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page.source)
    assert {first or second for first, second in used} <= set(ids)


def test_everybody_can_read_the_page(page):
    pictures = page.of("svg", "canvas")
    assert len(pictures) == 6  # errors, the body, three trajectories, and all
    for picture in pictures:
        assert picture["role"] == "img"
        assert len(picture["aria-label"] or "") > 40
    levels = [int(tag[1]) for tag, _ in page.elements if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert len(page.of("caption")) == len(page.of("table")) > 2
    assert all(cell["scope"] in ("col", "row") for cell in page.of("th"))
    heads = [words for tag, words in page.words if tag == "th"]
    assert all(heads)
    (slider,) = page.of("input")
    assert slider["type"] == "range"
    assert slider["aria-label"] == "time"
    assert re.search(r"<label>trajectory <select>", page.source)
    assert "prefers-reduced-motion" in page.source
    assert "@media print" in page.source


def test_the_verdict_is_the_first_thing(estimate, page, tmp_path):
    words = [words for tag, words in page.words if tag not in ("title", "style")]
    assert words[:4] == ["Report of an estimate", "Verdict", "✓", " The model holds"]
    assert 'class="verdict good"' in page.source
    reasons = ("the fit did not converge", "the step of the integrator is too long")
    failed = dataclasses.replace(estimate, converged=False, reasons=reasons)
    failed = page_of(failed, tmp_path, title="Toss & <turn>")
    assert 'class="verdict bad"' in failed.source
    items = [words for tag, words in failed.words if tag == "li"]
    assert items[:2] == list(reasons)
    assert "NOT CONVERGED after" in failed.text
    assert "Toss & <turn>" in failed.text


def test_every_verdict_has_a_colour(estimate):
    nothing = dataclasses.replace(estimate, degrees_of_freedom=0)
    failed = dataclasses.replace(estimate, reasons=("it is wrong",))
    for other in (estimate, nothing, failed):
        assert sum(other.verdict.startswith(beginning) for beginning in KINDS) == 1


def test_the_page_says_what_the_report_says(estimate, page):
    text = re.sub(r"\s+", " ", page.text)
    cells = [words for tag, words in page.words if tag in ("td", "th")]
    rows = str(estimate).partition("\n\n")[2].partition("\n\n")[0].splitlines()[1:]
    assert len(rows) == len(estimate.summary()["name"])
    for row in rows:
        for cell in re.split(r" {2,}", row):
            assert cell in cells
    for line in (*estimate.unobservable, *estimate.messages, *estimate.parts[""].statements()):
        assert line.replace("`", "") in text
    assert "inf" not in [words for tag, words in page.words if tag == "text"]


def test_names_are_words_and_not_elements(estimate, tosses, tmp_path):
    recordings = dataclasses.replace(
        tosses, names=("1", "2", EVIL), dropped=(EVIL,), provenance=("file <a.csv>",)
    )
    part = dataclasses.replace(estimate.parts[""], recordings=recordings)
    run = Run(
        read=(EVIL,),
        command=f"lgvi '{EVIL}'",
        python=f"# {EVIL}",
        versions={"lgvi": "<1>"},
        logs={EVIL: "abc"},
    )
    evil = page_of(dataclasses.replace(estimate, parts={"": part}), tmp_path, run=run, title=EVIL)
    assert all("alert" not in words for tag, words in evil.words if tag in ("script", "style"))
    assert evil.source.count("<script") == 2
    assert evil.text.count("alert('toss')") > 8
    assert f"# {EVIL}" in evil.text
    assert "file <a.csv>" in evil.text
    assert {"<1>", "abc"} <= {words for _, words in evil.words}


def test_the_view_turns_as_recorded_and_as_fitted(estimate, page):
    (body,) = page.scene["bodies"]
    lengths, axes = equivalent_box(estimate.body)
    np.testing.assert_allclose(body["lengths"], lengths, atol=1e-5)
    assert len(page.scene["motions"]) == 3
    samples = estimate.recordings.channels["attitude"]
    names = re.findall(r'<option value="\d">([^<]*)', page.source)
    predicted = samples.split(estimate.predicted["attitude"])
    for name, motion in zip(names, page.scene["motions"], strict=True):
        i = estimate.recordings.names.index(name.partition(" (")[0])
        t, recorded = samples.of(i)
        shown = np.searchsorted(t - t[0], np.array(motion["times"]) - 1e-5)
        turns = []
        for data, values in zip(motion["shown"], (recorded, predicted[i]), strict=True):
            R = Rotation.from_quat(data["attitudes"], scalar_first=True).as_matrix()
            np.testing.assert_allclose(R, values[shown] @ axes, atol=3e-5)
            turns.append(Rotation.from_matrix(values[shown]))
        apart = np.degrees((turns[0].inv() * turns[1]).magnitude())
        np.testing.assert_allclose(motion["apart"], apart, atol=6e-4)


@pytest.mark.parametrize("has_own", [False, True], ids=["one bias", "own bias"])
def test_without_attitudes_the_motion_follows_the_fitted_rates(has_own, estimate, tmp_path):
    recordings = trajectory(0, samples=200, interval=0.005, attitudes=False, rates=True)
    model = Model(estimate.body, lgvi.Gyroscope(SIGMA_W))
    fitted, bias = with_part(estimate, recordings, model), np.zeros(3)
    if has_own:
        bias = np.array([0.3, 0.2, -0.1])
        nothing = jax.tree.map(lambda _: None, model)
        own = eqx.tree_at(bias_of, nothing, bias[None], is_leaf=lambda node: node is None)
        part = dataclasses.replace(fitted.parts[""], own=own)
        fitted = dataclasses.replace(fitted, parts={"": part})
    page = page_of(fitted, tmp_path)
    assert "No attitudes are recorded" in page.text
    assert "the attitude at the start is chosen freely" in page.text
    (motion,) = page.scene["motions"]
    (shown,) = motion["shown"]
    assert shown["label"] == "fitted"
    R = Rotation.from_quat(shown["attitudes"], scalar_first=True)
    rates = recordings.channels["angular_velocity"].values - bias
    expected = follow_rates(np.eye(3), 0.005 * (rates[1:] + rates[:-1]) / 2)[-1]
    turned = (R[0].inv() * R[-1]).magnitude()
    assert turned == pytest.approx(Rotation.from_matrix(expected).magnitude(), abs=1e-4)
    assert not page.of("select")  # there is nothing to choose


def bias_of(model):
    return model.sensors["angular_velocity"].bias


def test_what_cannot_be_drawn_is_said(estimate, tosses, tmp_path):
    t = np.arange(60) * 0.03
    field = Recordings.from_arrays(t, magnetic_field=np.random.default_rng(0).normal(size=(60, 3)))
    magnetometer = lgvi.Magnetometer(np.array([1.0, 0.0, 0.0]), 1.0)
    page = page_of(with_part(estimate, field, Model(estimate.body, magnetometer)), tmp_path)
    assert "No sensor tells attitudes or rates" in page.text
    assert len(page.scene["motions"][0]["times"]) == 1
    for i, name in enumerate(tosses.names):
        t, R = tosses.channels["attitude"].of(i)
        q = Rotation.from_matrix(R).as_quat(scalar_first=True).T
        columns = dict(zip(("t", "w", "x", "y", "z"), (t, *q), strict=True))
        pq.write_table(pa.table(columns), tmp_path / f"{name}.parquet")
    stored = Recordings.open(tmp_path, attitude=("w", "x", "y", "z"))
    part = dataclasses.replace(estimate.parts[""], recordings=stored)
    page = page_of(dataclasses.replace(estimate, parts={"": part}), tmp_path)
    assert page.text.count("Recordings are in files") == 2
    assert len(page.of("svg", "canvas")) == 2


def test_attitudes_follow_constant_rates():
    turn = np.array([0.01, 0.02, -0.03])
    R = follow_rates(np.eye(3), np.tile(turn, (300, 1)))
    expected = Rotation.from_rotvec(np.arange(301)[:, None] * turn).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-12)


def test_a_body_that_cannot_be_has_no_picture(estimate, tosses, tmp_path):
    body = lgvi.RigidBody(np.diag([1.0, 1.0, 3.0]))
    page = page_of(with_part(estimate, tosses, Model(body, lgvi.AttitudeSensor(1e-3))), tmp_path)
    assert "No body can have this inertia" in page.text
    assert not page.of("canvas")


def test_twenty_throws_are_a_small_page_that_hides_no_large_residual(estimate, tmp_path):
    recordings = Recordings.concatenate(
        trajectory(i, samples=500, interval=0.002, rates=True) for i in range(20)
    )
    sensors = lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)
    many = with_part(estimate, recordings, Model(estimate.body, sensors))
    residuals = many.residuals["attitude"]
    residuals[3 * 500 + 77] = 50, 0, 0
    page = page_of(many, tmp_path)
    assert len(page.source) < 1_500_000
    assert len(page.scene["motions"]) == 20
    assert re.search(r"Residuals of all trajectories: 12\d\d of 10000, the largest", page.text)
    # The picture goes as far as the largest residual, which is a dot of its own.
    picture = page.source.partition('aria-label="Residuals of attitude')[2]
    first = re.search(r'd="((?:M[\d.]+ [\d.]+h0)+)"', picture)
    assert first is not None
    heights = np.array(re.findall(r" ([\d.]+)h0", first[1]), float)
    assert np.sort(heights)[1] - np.min(heights) > 60  # points


def test_several_configurations_are_told_apart(estimate, tmp_path):
    values = {field.name: getattr(estimate, field.name) for field in dataclasses.fields(estimate)}
    part = estimate.parts[""]
    joint = JointEstimate(**{**values, "parts": {"bare": part, "with <load>": part}})
    page = page_of(joint, tmp_path)
    heads = [words for tag, words in page.words if tag == "h3"]
    assert heads[-4:-2] == ["bare: attitude", "with <load>: attitude"]
    assert len(page.scene["bodies"]) == 2
    assert [motion["body"] for motion in page.scene["motions"]] == [0] * 3 + [1] * 3
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(set(ids)) == len(ids)


def test_what_was_held_out_is_on_the_page(estimate, tmp_path):
    count, p = len(estimate.recordings), len(estimate.free.theta)
    nothing = {"": np.zeros((count, p, p))}
    comparison = compare(estimate.parts, estimate.parts, nothing)
    validation = Validation(estimate.parts, estimate.parts, comparison, converged=True)
    page = page_of(estimate, tmp_path, validation=validation)
    assert "Hold-out" in page.text
    assert re.sub(r"\s+", " ", str(validation).partition("\nattitude")[0])[2:] in page.text
    lost = dataclasses.replace(validation, converged=False)
    assert "DISAGREE" in page_of(estimate, tmp_path, validation=lost).text


def test_a_plan_has_a_page(estimate, tmp_path):
    model = Model(estimate.body, lgvi.AttitudeSensor(SIGMA_R))
    states = InitialStates.from_rates(np.random.default_rng(0).normal(size=(3, 3)))
    plan = identifiability(model, np.arange(60) * 0.03, states)
    page = page_of(plan, tmp_path)
    assert "The experiment would not determine all numbers" in page.text
    assert plan.unobservable[0] in page.text
    cells = [words for tag, words in page.words if tag in ("td", "th")]
    for row in str(plan).partition("\n\n")[0].splitlines()[1:]:
        assert all(cell in cells for cell in re.split(r" {2,}", row))
    (motion,) = page.scene["motions"]
    assert len(motion["times"]) == 1
    assert not page.of("input")


def test_writing_leaves_nothing_behind(estimate, page, tmp_path):
    with mpl.rc_context({"text.color": "white", "axes.grid": True, "figure.facecolor": "black"}):
        before, figures = mpl.rcParams.copy(), plt.get_fignums()
        again = page_of(estimate, tmp_path)
        assert mpl.rcParams == before
    assert again.source == page.source  # whatever the style of the user is
    assert plt.get_fignums() == figures


def test_pictures_have_the_colours_of_the_page_and_keep_their_words():
    with style_of_page():
        figure = Figure()
        axis = figure.subplots()
        axis.plot(np.linspace(0, 1, 50), np.zeros(50), ".", color="#2a8fd4")
        axis.set_title("0.00123456 $<b>$")
        svg = as_svg(figure, "one", 'a "picture"')
    assert "0.00123456 $&lt;b&gt;$" in svg
    assert 'aria-label="a &quot;picture&quot;"' in svg
    assert svg.count("h0") == 50
    assert "currentColor" in svg
    assert not re.search("#010203|#000000|#ffffff|<style|<!--|metadata", svg)
    assert set(re.findall(r'id="([^-"]+)', svg)) == {"one"}
