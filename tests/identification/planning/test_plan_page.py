"""The picture and the page of a plan show what it does, its limits, and what it gains."""

import dataclasses
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import same_color
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Limits, LimitUse, Model, Plan, Wheels, plan
from lgvi.plotting import plot_plan
from lgvi.plotting.expected_errors import draw_errors
from lgvi.plotting.report import write_report
from lgvi.plotting.shapes import equivalent_box
from lgvi.plotting.style import GREY

from ..test_report_page import Page

SPEED = np.array([300.0, 200.0])  # rad/s, of each wheel


def body_and_bias(model):
    return model.body, model.sensors["angular_velocity"].bias


@pytest.fixture(scope="module")
def planned() -> Plan:
    body = lgvi.PhysicalRigidBody.from_principal_moments([0.11, 0.16, 0.19])
    wheels = Wheels(np.eye(3)[:2], inertia=2e-4, speed=SPEED, start=0.0, knots=3)
    limits = Limits(rate=0.5, trajectories=2, initial_rate=0.3, commands=wheels)
    model = Model(body, lgvi.Gyroscope(1e-3, bias=np.array([1e-3, 0.0, 0.0])))
    return plan(model, np.arange(0, 10.01, 0.5), limits, free=body_and_bias)


@pytest.fixture(scope="module")
def page(planned, tmp_path_factory) -> Page:
    return page_of(planned, tmp_path_factory.mktemp("page"))


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def page_of(planned, folder) -> Page:
    return Page(write_report(planned, folder / "plan.html").read_text("utf-8"))


def as_throw(planned) -> Plan:
    """The plan without its commands."""
    limits = dataclasses.replace(planned.limits, commands=None)
    return dataclasses.replace(planned, limits=limits, commands={}, knots=np.zeros(0))


def lines_of(axis, style) -> list[Any]:
    return [line for line in axis.lines if line.get_linestyle() == style]


def cells_of(page) -> list[str]:
    return [words for tag, words in page.words if tag in ("td", "th")]


def verdict_of(page) -> str:
    return page.source.partition('class="verdict')[2].partition("</div>")[0]


def test_the_rate_is_drawn_for_each_trajectory_below_its_limit(planned):
    axis = plot_plan(planned).axes[0]
    curves = lines_of(axis, "-")
    for curve, rates in zip(curves, planned.rates, strict=True):
        np.testing.assert_array_equal(curve.get_xdata(), planned.times)
        np.testing.assert_array_equal(curve.get_ydata(), np.linalg.norm(rates, axis=1))
    (limit,) = lines_of(axis, "--")
    assert limit.get_ydata()[0] == 0.5
    assert axis.get_ylim()[0] == 0
    assert axis.get_ylim()[1] > 0.5


def test_there_is_a_curve_for_each_command_with_limits_in_its_colour(planned):
    axis = plot_plan(planned).axes[1]
    curves = lines_of(axis, "-")
    assert len(curves) == 4  # of each of two wheels, in each of two trajectories
    limits = lines_of(axis, "--")
    for (name, values), speed in zip(planned.commands.items(), SPEED, strict=True):
        (thick,) = [curve for curve in curves if curve.get_label() == name]
        np.testing.assert_array_equal(thick.get_xydata(), np.stack([planned.knots, values[0]], 1))
        alike = [curve for curve in curves if same_color(curve.get_color(), thick.get_color())]
        (thin,) = [curve for curve in alike if curve is not thick]
        np.testing.assert_array_equal(thin.get_ydata(), values[1])
        assert thin.get_linewidth() < thick.get_linewidth() / 2
        bounds = [line for line in limits if same_color(line.get_color(), thick.get_color())]
        assert {line.get_ydata()[0] for line in bounds} == {-speed, speed}
    assert axis.get_ylabel() == "commands\n(rad/s)"
    assert axis.get_xlim() == plot_plan(planned).axes[0].get_xlim()


def test_limits_that_all_commands_share_are_grey(planned):
    wheels = dataclasses.replace(planned.limits.commands, speed=300.0)
    limits = dataclasses.replace(planned.limits, commands=wheels)
    axis = plot_plan(dataclasses.replace(planned, limits=limits)).axes[1]
    assert all(same_color(line.get_color(), GREY) for line in lines_of(axis, "--"))


def test_bars_are_as_long_as_standard_errors_planned_and_not(planned):
    axis = plot_plan(planned).axes[-1]
    names = [label.get_text() for label in axis.get_yticklabels()]
    bars: list[Any] = list(axis.patches)
    summary = planned.summary()
    rows = {name: k for k, name in enumerate(summary["name"])}
    assert len(names) == 6  # moments and a bias, and no entries of the inertia
    assert len(bars) == 2 * len(names)
    for number, name in enumerate(names):
        k = rows[name]
        value, error = abs(summary["value"][k]), summary["standard_error"][k]
        for bar, length in zip(bars[2 * number :], (error, summary["usual"][k]), strict=False):
            length = 100 * length / value if value > error else length
            assert bar.get_x() + bar.get_width() == pytest.approx(length)
    above, below = bars[:2]
    assert above.get_y() < below.get_y()  # the axis goes down
    assert axis.get_xscale() == "log"
    legend = axis.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["planned", "not planned"]


def test_a_number_that_only_the_plan_shows_has_one_grey_bar():
    axis = plt.figure().subplots()
    errors = {"planned": np.array([0.1, 0.2]), "not planned": np.array([np.inf, 5.0])}
    draw_errors(["one", "two"], np.array([2.0, 4.0]), ["kg m²", "kg m²"], errors, axis)
    words = ["5 %", "not observable", "5 %", "125 %"]
    assert [text.get_text() for text in axis.texts] == words
    grey = [same_color(bar.get_facecolor()[:3], GREY) for bar in axis.patches]
    assert grey == [False, True, False, False]


def test_a_plan_is_drawn_in_axes_that_are_given(planned):
    figure, axes = plt.subplots(3)
    assert plot_plan(planned, ax=axes) is figure
    assert all(axis.lines or axis.patches for axis in axes)
    with pytest.raises(ValueError, match="`ax` must be 3 of Matplotlib's axes, but has 2"):
        plot_plan(planned, ax=axes[:2])
    throw = as_throw(planned)
    assert len(plot_plan(throw).axes) == 2
    with pytest.raises(ValueError, match="`ax` must be 2 of Matplotlib's axes, but has 3"):
        plot_plan(throw, ax=axes)


def test_the_page_says_what_to_do(planned, page):
    cells = cells_of(page)
    for k, omega in enumerate(np.asarray(planned.states.omega)):
        at = cells.index(str(k), cells.index("size") + 1)
        written = np.array(cells[at + 1 : at + 5], float)
        np.testing.assert_allclose(written, [*omega, np.linalg.norm(omega)], atol=1e-4)
    captions = [words for tag, words in page.words if tag == "caption"]
    assert "Commands of trajectory 1, rad/s" in captions
    starts = [i for i, words in enumerate(cells) if words == "time (s)"]
    for k, start in enumerate(starts):
        assert cells[start + 1 : start + 3] == list(planned.commands)
        written = np.array(cells[start + 3 : start + 12], float).reshape(3, 3)
        expected = [planned.knots, *(curves[k] for curves in planned.commands.values())]
        np.testing.assert_allclose(written.T, expected, atol=0.1)
        assert "-0" not in cells[start : start + 12]
    assert len(starts) == 2


def test_the_page_has_each_limit_and_what_the_plan_would_tell(planned, page):
    cells = cells_of(page)
    assert len(planned.uses) > 3
    for use in planned.uses:
        at = cells.index(use.name, cells.index("binds"))
        assert float(cells[at + 1]) == pytest.approx(use.extreme, rel=1e-3)
        assert float(cells[at + 2]) == pytest.approx(use.limit, rel=1e-3)
        assert cells[at + 3 : at + 5] == [use.unit, "yes" if use.binds else "no"]
    for row in planned.table_cells()[1:]:
        at = cells.index(row[0])
        assert cells[at : at + len(row)] == row


def test_everybody_can_read_the_page_of_a_plan(page):
    assert page.text.startswith("Plan of an experiment")
    pictures = page.of("svg", "canvas")
    assert len(pictures) == 3  # the motion with the commands, bars, the body
    assert all(len(picture["aria-label"] or "") > 40 for picture in pictures)
    assert all(words for tag, words in page.words if tag == "th")
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(set(ids)) == len(ids)


def test_the_verdict_is_good_only_without_any_reason_for_doubt(planned, page, tmp_path):
    good = dataclasses.replace(planned, converged=True)
    assert verdict_of(page_of(good, tmp_path)).startswith(' good"')
    assert "DID NOT END" not in page_of(good, tmp_path).text
    unseen = dataclasses.replace(planned.expected, unobservable=("the scale: a torque",))
    within = LimitUse("lowest of motor 0", "rad/s", 4.0, 3.0, is_lowest=True)
    for changes, words in (
        ({"converged": False}, "another <code>seed</code>"),
        ({"expected": unseen}, "not observable: the scale</li>"),
        ({"uses": (LimitUse("turn", "rad", 0.7, 0.6),)}, "not kept: turn 0.7 of 0.6 rad"),
        ({"uses": (within._replace(extreme=2.0),)}, "not kept: lowest of motor 0 2 of 3 rad/s"),
    ):
        verdict = verdict_of(page_of(dataclasses.replace(good, **changes), tmp_path))
        assert verdict.startswith(' doubt"')
        assert words in verdict
        assert verdict.count("<li>") == 1
    kept = dataclasses.replace(good, uses=(within,))
    assert verdict_of(page_of(kept, tmp_path)).startswith(' good"')


def test_the_body_turns_as_planned(planned, page):
    _, axes = equivalent_box(planned.model.body)
    motions = page.scene["motions"]
    assert len(motions) == 2
    for motion, rates in zip(motions, planned.rates, strict=True):
        (shown,) = motion["shown"]
        assert shown["label"] == "planned"
        R = Rotation.from_quat(shown["attitudes"], scalar_first=True)
        np.testing.assert_allclose(R[0].as_matrix(), axes, atol=1e-4)
        turns = Rotation.from_matrix(R.as_matrix() @ axes.T)
        t = np.array(motion["times"])
        steps = (turns[:-1].inv() * turns[1:]).as_rotvec() / np.diff(t)[:, None]
        middle = (t[1:] + t[:-1]) / 2
        expected = [np.interp(middle, planned.times, x) for x in rates.T]
        np.testing.assert_allclose(steps.T, expected, atol=3e-3)


def test_a_plan_without_commands_has_a_page_without_them(planned, tmp_path):
    page = page_of(as_throw(planned), tmp_path)
    assert "Angular velocity at the start" in page.text
    assert "time (s)" not in cells_of(page)
    assert "Commands" not in page.text


def test_a_body_that_starts_at_rest_is_said_to(planned, tmp_path):
    limits = dataclasses.replace(planned.limits, initial_rate=0.0)
    page = page_of(dataclasses.replace(planned, limits=limits), tmp_path)
    assert "The body is at rest at the start." in page.text
    assert "Angular velocity at the start" not in page.text


def test_a_plan_writes_its_page(planned, page, tmp_path):
    written = planned.to_html(tmp_path / "plan.html")
    assert written.read_text("utf-8") == page.source
