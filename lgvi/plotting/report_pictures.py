"""The pictures of a report: bodies, their motions, plans; readings, fit and residuals."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeGuard

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..identification import Identifiability, Plan
from ..identification.fit.part import FittedPart
from ..logs import Log
from ..modules.body import AbstractRigidBody
from .expected_errors import Result, plot_identifiability
from .inline_svg import as_svg
from .log import plot_log
from .motions import FITTED, RECORDED, evenly, follow_rates, motions_of
from .page import grid, heading, paragraph, picture, table
from .plan import draw_gains, draw_motion
from .readings import draw_curves, draw_residuals
from .shapes import equivalent_box
from .style import NAMES
from .view import Motion, view_of

MOST_DOTS = 300  # readings of a trajectory
MOST_POINTS = 1500  # of a line
MOST_RESIDUALS = 1200  # of a component, in a picture of all trajectories
LARGEST = 40  # one of so many pictured residuals is there as one of the largest
MOST_MOTIONS, MOST_FRAMES = 40, 6000  # of all trajectories, in the view
PLANNED = "planned"
PLANNED_FRAMES = 200  # of a planned motion
PLAYING = 6.0  # s in which a motion is shown, about
SPEEDS = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10])
SIZE = 5.2, 3.4  # inches of a picture, two of which stand side by side
FACES = "blue", "orange", "green"  # across the axes of the principal moments
STORED = "Recordings are in files, so that motions and readings are not drawn here."
LEGEND = {
    "loc": "lower right",
    "bbox_to_anchor": (1, 1),
    "borderaxespad": 0.1,
    "frameon": False,
    "ncols": 5,
    "handletextpad": 0.1,
    "columnspacing": 0.8,
    "markerscale": 2.5,
}


def picture_errors(result: Result) -> str:
    """How well each number is known, as bars."""
    figure = Figure(layout="constrained")
    axis = figure.subplots()
    plot_identifiability(result, ax=axis)
    return _bars(figure, axis, 1, "How well each number is known")


def picture_gains(plan: Plan) -> str:
    """How well each number would be known by a plan, and without it, as bars."""
    figure = Figure(layout="constrained")
    axis = figure.subplots()
    draw_gains(plan, axis)
    caption = "How well each number would be known by the plan (above) and without it (below)"
    return _bars(figure, axis, 2, caption)


def _bars(figure: Figure, axis: Axes, pieces: int, caption: str) -> str:
    """The picture of a figure with so many bars for each number."""
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter("")
    names = [label.get_text() for label in axis.get_yticklabels()]
    figure.set_size_inches(SIZE[0], 0.8 + 0.05 * (3 + 2 * pieces) * len(names))
    lengths = [bar.get_text() for bar in axis.texts]
    bars = [
        f"{name} {' and '.join(lengths[pieces * k : pieces * (k + 1)])}"
        for k, name in enumerate(names)
    ]
    words = f"{caption}. Bars of the standard errors: {'; '.join(bars)}"
    return picture(as_svg(figure, "errors", words), caption)


def picture_plan(plan: Plan) -> str:
    """The angular rate over time of a plan, and its commands."""
    figure = Figure(figsize=(SIZE[0], 1.9 * (1 + bool(plan.commands))), layout="constrained")
    axes = figure.subplots(1 + bool(plan.commands), squeeze=False)[:, 0]
    draw_motion(plan, axes)
    figure.align_ylabels()
    fastest = np.max(np.linalg.norm(plan.rates, axis=-1))
    caption = "The size of the angular velocity over time"
    words = (
        f"{caption}; the largest is {fastest:.3g} rad/s, and the limit {plan.limits.rate:.3g} rad/s"
    )
    if plan.commands:
        caption += " and, below, the commands"
        if len(plan.rates) > 1:
            caption += " of the first trajectory, with thin lines for the others"
        words += f". Below, the commands: {', '.join(plan.commands)}"
    return picture(as_svg(figure, "plan", words), f"{caption}; limits are dashed")


def picture_bodies(parts: Mapping[str, FittedPart | Identifiability | Plan]) -> str:
    """Boxes and inertia ellipsoids of bodies, which turn as recorded, fitted or planned."""
    possible = {name: part for name, part in parts.items() if _is_possible(part.model.body)}
    if not possible:
        return paragraph("No body can have this inertia, so that none is drawn.")
    motions = list(_motions(possible))
    durations = [motion.times[-1] for motion in motions]
    speed = SPEEDS[np.argmin(abs(np.log(SPEEDS * PLAYING / max(np.median(durations), 1e-3))))]
    turning = [label for motion in motions for label in motion.attitudes if label]
    words = (
        "The solid box that has the inertia, and the ellipses in which its principal planes cut "
        "the inertia ellipsoid"
    )
    about = f"{words}. Drag, or press arrow keys, to turn the view."
    if turning:
        words = f"{words}, turning {' and '.join(dict.fromkeys(turning))}"
        about += (
            " The curve is the path of a corner. "
            f"Motions are played at {speed:g} times their speed."
        )
    bodies = [part.model.body for part in possible.values()]
    view = view_of(
        bodies, motions, f"{words}. Arrow keys turn the view.", speed=speed, ellipsoids=True
    )
    rows = [row for name, part in possible.items() for row in _principal_axes(name, part)]
    head = ["principal moment", "part of the trace", "axis (x, y, z) in the body frame"]
    head += ["edge of the box", "faces across it"]
    notes = [paragraph(note) for note in dict.fromkeys(_about_motions(possible, motions))]
    axes = table("Principal axes, and the box, whose longest edge is 1", head, rows)
    return "".join([paragraph(about), *notes, view, axes])


def _is_possible(body: AbstractRigidBody) -> bool:
    try:
        equivalent_box(body)
    except ValueError:
        return False
    return True


def _motions(parts: Mapping[str, FittedPart | Identifiability | Plan]) -> Iterator[Motion]:
    """Motions of each part, the trajectories that fit worst first; a still body without any."""
    drawn = [part for part in parts.values() if _has_pictures(part)]
    total = sum(len(part.recordings) for part in drawn)
    for number, (name, part) in enumerate(parts.items()):
        motions = []
        if isinstance(part, Plan):
            motions = list(_planned_motions(part, number))
        elif _has_pictures(part):
            picks = _picks(part)
            chosen = list(dict.fromkeys([*picks, *range(len(part.recordings))]))
            chosen = chosen[: max(MOST_MOTIONS // len(drawn), 1)]
            names = [_named(part, i, name, picks) for i in chosen]
            most = MOST_FRAMES // min(total, MOST_MOTIONS)
            motions = motions_of(part, chosen, names, number, most)
        nowhere = Motion(name, number, np.zeros(1), np.zeros(1, int), {"": np.eye(3)[None]})
        yield from motions or [nowhere]


def _planned_motions(plan: Plan, number: int) -> Iterator[Motion]:
    """Motions of a plan, of the body with a number, from its angular velocities."""
    count = min(len(plan.rates), MOST_MOTIONS)
    t = np.linspace(plan.times[0], plan.times[-1], min(PLANNED_FRAMES, MOST_FRAMES // count))
    intervals = float(plan.model.time_scale) * np.diff(t)[:, None]
    for k in range(count):
        rates = np.stack([np.interp(t, plan.times, x) for x in plan.rates[k].T], axis=1)
        start = np.asarray(plan.states.R[k], float)
        R = follow_rates(start, intervals * (rates[:-1] + rates[1:]) / 2)
        yield Motion(plan.recordings.names[k], number, t - t[0], np.arange(len(t)), {PLANNED: R})


def _has_pictures(part: FittedPart | Identifiability | Plan) -> TypeGuard[FittedPart]:
    """Whether readings are there, and in memory."""
    return isinstance(part, FittedPart) and not part.recordings.are_stored


def _about_motions(
    parts: Mapping[str, FittedPart | Identifiability | Plan], motions: Sequence[Motion]
) -> Iterator[str]:
    """What is not seen in the view, in words."""
    for number, part in enumerate(parts.values()):
        if not _has_pictures(part):
            if isinstance(part, FittedPart):
                yield STORED
            continue
        labels = {label for m in motions if m.body == number for label in m.attitudes}
        if FITTED not in labels:
            yield "No sensor tells attitudes or rates, so that the body is drawn at rest."
        elif RECORDED not in labels:
            words = "No attitudes are recorded, so that the fitted motion is drawn from its rates"
            if not any(sensor.depends_on_attitude for sensor in part.model.sensors.values()):
                words += ", and the attitude at the start is chosen freely"
            yield f"{words}."


def _principal_axes(name: str, part: FittedPart | Identifiability | Plan) -> Iterator[list[str]]:
    body = part.model.body
    lengths, axes = equivalent_box(body)
    moments = np.linalg.eigvalsh(np.asarray(body.inertia, float))
    for which, moment, length, axis, faces in zip(
        NAMES, moments / np.sum(moments), lengths, axes.T, FACES, strict=True
    ):
        label = f"{name}, {which}" if name else which
        direction = ", ".join(f"{x:.4f}" for x in np.round(axis, 4) + 0.0)
        yield [label, f"{moment:.5f}", direction, f"{length:.4f}", faces]


def _picks(part: FittedPart) -> dict[int, str]:
    """The trajectories whose pictures are drawn, by their numbers, and why."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    order = np.argsort(-np.where(freedom > 0, chi_square / np.maximum(freedom, 1), 0)).tolist()
    picks = {order[0]: "worst fit"}
    for i, why in ((order[len(order) // 2], "median fit"), (0, "first"), (order[-1], "best fit")):
        if len(picks) < 3:
            picks.setdefault(i, why)
    return picks


def _named(part: FittedPart, i: int, where: str, picks: Mapping[int, str]) -> str:
    name = part.recordings.names[i]
    name = f"{where}: {name}" if where else name
    return f"{name} ({picks[i]})" if i in picks and len(part.recordings) > 1 else name


def picture_readings(parts: Mapping[str, FittedPart]) -> str:
    """Readings, fit and residuals of each channel: of some trajectories, and of all."""
    drawn = []
    for number, (name, part) in enumerate(parts.items()):
        if part.recordings.are_stored:
            drawn.append(paragraph(STORED))
            continue
        for place, channel in enumerate(part.model.sensors):
            title = f"{name}: {channel}" if name else channel
            drawn.append(heading(title.replace("_", " ")))
            drawn.append(grid(_of_channel(part, channel, name, f"readings-{number}-{place}")))
    return "".join(drawn)


def _of_channel(part: FittedPart, channel: str, where: str, key: str) -> Iterator[str]:
    """Pictures of a channel: of some trajectories, and of the residuals of all."""
    samples, picks = part.recordings.channels[channel], _picks(part)
    first = np.cumsum(samples.count) - samples.count
    predicted = samples.split(part.predicted[channel])
    finite = [np.isfinite(values).all() for values in samples.split(part.residuals[channel])]
    for i in picks:
        if samples.count[i] and finite[i]:
            name = _named(part, i, where, picks)
            yield _of_trajectory(part, channel, i, int(first[i]), predicted[i], name, f"{key}-{i}")
    if len(part.recordings) > 1 and len(samples.times) and all(finite):
        yield _of_all(part, channel, f"{key}-all")


def _of_trajectory(
    part: FittedPart,
    channel: str,
    i: int,
    first: int,
    fitted: np.ndarray,
    name: str,
    key: str,
) -> str:
    """Readings and fit of a trajectory, with the residuals, from number `first` on, below."""
    sensor, (t, readings) = part.model.sensors[channel], part.recordings.channels[channel].of(i)
    residuals = part.residuals[channel][first : first + len(t)]
    figure = Figure(figsize=SIZE, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1.4])
    line, dots = evenly(len(t), MOST_POINTS), _some(residuals, MOST_DOTS)
    draw_curves(sensor, (t, readings), (t[line], fitted[line]), above, dots)
    above.legend(**LEGEND)
    draw_residuals(part, channel, t[dots], first + dots, below)
    _in_plain_numbers(below)
    below.set(xlabel="time (s)", ylabel=f"residual\n({sensor.unit})")
    figure.align_ylabels()
    size = residuals * np.asarray(sensor.sigma)
    words = (
        f"{channel.replace('_', ' ')} of trajectory {name}: {len(t)} readings as dots and the fit "
        f"as lines over {t[-1] - t[0]:.3g} s; below, the residuals, whose root mean square is "
        f"{np.sqrt(np.mean(size**2)):.3g} {sensor.unit}, and the largest {np.max(abs(size)):.3g}"
    )
    caption = "readings (dots), fit (lines), residuals, and three deviations (dashed)"
    return picture(as_svg(figure, key, words), f"Trajectory {name}: {caption}")


def _of_all(part: FittedPart, channel: str, key: str) -> str:
    """Residuals of all trajectories over the time since the start of each."""
    samples, sensor = part.recordings.channels[channel], part.model.sensors[channel]
    starts = np.array([t[0] for t in part.recordings.reading_times()])
    t, residuals = samples.times - np.repeat(starts, samples.count), part.residuals[channel]
    which = _some(residuals, MOST_RESIDUALS)
    figure = Figure(figsize=SIZE, layout="constrained")
    axis = figure.subplots()
    draw_residuals(part, channel, t[which], which, axis)
    axis.legend(**LEGEND)
    _in_plain_numbers(axis)
    axis.set(xlabel="time since the start (s)", ylabel=f"residual ({sensor.unit})")
    share = "" if len(which) == len(t) else f": {len(which)} of {len(t)}, the largest among them"
    words = (
        f"Residuals of {channel.replace('_', ' ')} of all {len(samples.count)} trajectories over "
        f"the time since the start; the largest is {np.max(abs(residuals)):.3g} times sigma"
    )
    return picture(as_svg(figure, key, words), f"Residuals of all trajectories{share}")


def _some(residuals: np.ndarray, most: int) -> np.ndarray:
    """Numbers of some of the residuals (readings, m): evenly chosen ones, and the largest."""
    largest = np.argsort(-np.max(abs(residuals), axis=1), kind="stable")[: most // LARGEST]
    return np.union1d(evenly(len(residuals), most), largest)


def _in_plain_numbers(axis: Axes) -> None:
    axis.ticklabel_format(axis="y", useMathText=False)


def picture_log(log: Log, intervals: Sequence[tuple[str, float, float]], key: str) -> str:
    """The signals of a log, with the intervals that were taken."""
    figure = plot_log(log, intervals)
    taken = ", ".join(f"{name} from {begin:.4g} to {end:.4g} s" for name, begin, end in intervals)
    words = f"Signals of {log.path} over time; shaded: {taken}"
    caption = f"Signals of {log.path}; what is shaded was taken"
    return picture(as_svg(figure, key, words), caption)
