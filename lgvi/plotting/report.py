"""The report of an estimate as a page by itself: the verdict, the numbers, and pictures."""

import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from os import PathLike
from pathlib import Path
from string import Template

import numpy as np

from ..identification import Estimate, Identifiability, JointEstimate, Plan
from ..identification.diagnosis.suspects import NOTED, Suspect
from ..identification.estimate.estimate import Contents, contents_of
from ..identification.estimate.validation import Validation
from ..identification.fit.part import FittedPart
from ..identification.model.model import Model
from ..identification.uncertainty.report_table import HEAD, Table, make_table
from ..logs import Log
from .expected_errors import Result
from .inline_svg import style_of_page
from .page import (
    Section,
    code,
    definitions,
    grid,
    heading,
    items,
    paragraph,
    table,
    text,
    verdict_of,
)
from .report_pictures import (
    picture_bodies,
    picture_errors,
    picture_gains,
    picture_log,
    picture_plan,
    picture_readings,
)

PACKAGES = "lgvi", "jax", "jaxlib", "equinox", "numpy", "scipy"
MOST_ROWS = 12  # trajectories in a table
MOST_LOGS = 4  # that are drawn
DIGITS = 4  # significant ones, of the largest of the numbers in a table
WORDS = [
    ["95 % interval", "95 of 100 such intervals hold the true number, if the model holds"],
    ["std. error", "standard error: how far the number scatters from one experiment to the next"],
    ["not observable", "the motion does not show the number, however good the sensors are"],
    ["principal moments", "moments of inertia about the three axes about which it turns steadily"],
    ["`sigma`", "the noise of one reading that the model expects"],
    ["residual", "a reading minus the fit; in units of `sigma` where no unit is said"],
    ["degrees of freedom", "how many numbers were read, minus how many are fitted"],
    [
        "chi-square",
        "the sum of the squared residuals in units of `sigma`: for each degree of freedom about 1, "
        "if the model holds and `sigma` is right",
    ],
    ["independent", "standard errors for noise that is new in each reading"],
    ["clustered", "standard errors that allow for noise that is alike within a trajectory"],
    ["correlated", "standard errors that allow for noise that lasts for a while"],
    [
        "Student's t",
        "makes intervals wider where few trajectories or blocks of time tell how large errors are",
    ],
    ["suspect", "what may be missing in the model: freed, it would lower chi-square"],
    ["by chance", "the probability of as much where nothing is missing"],
]
# The kind of a verdict, by how it begins.
KINDS = {
    "the model holds": "good",
    "the model may hold": "doubt",
    "the model does not hold": "bad",
    "nothing tells": "doubt",
}


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


@dataclass(frozen=True)
class Run:
    """How a result was made, for its report.

    Parameters
    ----------
    read
        What was read, cut and assumed, in words.
    command
        A command that makes the result again.
    python
        A script that makes the result again.
    versions
        Versions of programs and packages by name; by default of those in use.
    logs
        SHA-256 of the logs by path.
    flights
        Logs with the intervals, `(name, begin, end)`, that were taken of each, to be drawn.
    """

    read: Sequence[str] = ()
    command: str = ""
    python: str = ""
    versions: Mapping[str, str] = field(default_factory=_versions)
    logs: Mapping[str, str] = field(default_factory=dict)
    flights: Sequence[tuple[Log, Sequence[tuple[str, float, float]]]] = ()


def write_report(
    result: Result | Plan,
    path: str | PathLike[str],
    *,
    title: str | None = None,
    run: Run | None = None,
    validation: Validation | None = None,
) -> Path:
    """Write the report of an estimate, or of a plan, as a page that needs no network.

    Parameters
    ----------
    result
        What `identify`, `identify_jointly`, `identifiability` or `plan` returned.
    path
        The file, such as `"report.html"`.
    title
        The title of the page.
    run
        How the result was made.
    validation
        Trajectories that were not fitted, as `validate` of the estimate returned them.

    Returns
    -------
    pathlib.Path
        The file.
    """
    run = Run() if run is None else run
    with style_of_page():
        if isinstance(result, Plan):
            usual, sections = "Plan of an experiment", _of_plan(result)
        elif isinstance(result, Identifiability):
            usual, sections = "What an experiment would tell", _of_identifiability(result)
        else:
            usual, sections = "Report of an estimate", _of_estimate(result, run, validation)
        verdict, *sections = [*sections, _how_to_do_it_again(run)]
    links = "".join(f'<li><a href="#{part.name}">{text(part.title)}</a></li>' for part in sections)
    template = Template(files("lgvi.plotting").joinpath("report.html").read_text("utf-8"))
    page = template.substitute(
        title=text(usual if title is None else title),
        verdict=verdict,
        links=links,
        sections="\n".join(map(str, sections)),
    )
    path = Path(path)
    path.write_text(page, encoding="utf-8")
    return path


def _of_estimate(
    estimate: Estimate | JointEstimate, run: Run, validation: Validation | None
) -> Iterator[Section]:
    contents = contents_of(estimate)
    parts = {name: _with_readings(part) for name, part in estimate.parts.items()}
    yield _verdict(estimate, contents.verdict)
    yield _answer(estimate, "Estimated numbers", contents.table, contents.about)
    yield _open("The recordings determine", contents.unobservable, contents.notes)
    yield Section("The body", "body", picture_bodies(parts))
    yield Section("How well the model fits", "fit", items(contents.fit), picture_readings(parts))
    yield _what_is_left_out(estimate, contents)
    if validation is not None:
        yield _hold_out(validation)
    yield _what_was_read(estimate.parts, run)
    words = table("Words of this report", ["word", "meaning"], WORDS)
    yield Section("Words", "words", words)


def _of_identifiability(result: Identifiability) -> Iterator[Section]:
    if result.unobservable:
        kind, words = "doubt", "the experiment would not determine all numbers"
        reasons = [words.partition(": ")[0] for words in result.unobservable]
    else:
        kind, words, reasons = "good", "the experiment would determine all numbers", []
    yield Section("Verdict", "verdict", verdict_of(kind, words, reasons))
    values = ", ".join(f"{value:.3g}" for value in result.singular_values)
    yield _answer(
        result,
        "Standard errors to expect, with the noise of the sensors of the model",
        make_table(result),
        [f"singular values of the whitened Jacobian: {values}"],
    )
    yield _open("The experiment would determine", result.unobservable, ())
    yield Section("The body", "body", picture_bodies({"": result}))


def _of_plan(plan: Plan) -> Iterator[Section]:
    yield _verdict_of_plan(plan)
    yield Section("What to do", "do", *_what_to_do(plan), picture_plan(plan))
    yield _limits(plan)
    (_, *head), *rows = plan.table_cells()
    yield Section(
        "What it would tell",
        "tell",
        table(
            "Standard errors to expect, with the noise of the sensors of the model",
            ["number", *head],
            rows,
            _moments([name for name, *_ in rows]),
            "plan",
        ),
        paragraph(
            "Not planned is the middle one, by the criterion, of random experiments within the "
            "limits."
        ),
        picture_gains(plan),
    )
    yield _open("The experiment would determine", plan.expected.unobservable, ())
    yield Section("The body", "body", picture_bodies({"": plan}))


def _verdict_of_plan(plan: Plan) -> Section:
    exceeded = [f"a limit is not kept: {use}" for use in plan.uses if not use.is_kept]
    unobservable = [words.partition(": ")[0] for words in plan.expected.unobservable]
    better = "the search did not end in a minimum, so that another `seed` may give a better plan"
    reasons = [*exceeded, *(f"not observable: {words}" for words in unobservable)]
    reasons += [better] * (not plan.converged)
    kind, words = "doubt", "the plan keeps all limits and determines all numbers"
    if exceeded:
        words = "the plan does not keep all limits"
    elif unobservable:
        words = "the plan keeps all limits, but does not determine all numbers"
    elif not reasons:
        kind = "good"
    facts = {
        "trajectories": f"{len(plan.rates)}",
        "duration of each": f"{plan.times[-1] - plan.times[0]:.4g} s",
        "criterion": plan.criterion,
        "search": f"{'ended' if plan.converged else 'DID NOT END'} in a minimum",
        "searches within 1 % of the best": f"{plan.starts_that_agree} of {plan.starts}",
    }
    return Section("Verdict", "verdict", verdict_of(kind, words, reasons), definitions(facts))


def _what_to_do(plan: Plan) -> Iterator[str]:
    names = plan.recordings.names
    if plan.limits.largest_initial_rate > 0:
        omega = np.asarray(plan.states.omega, float)
        written = _write(np.column_stack([omega, np.linalg.norm(omega, axis=1)]))
        rows = [[name, *row] for name, row in zip(names, written, strict=True)]
        head = ["trajectory", "x", "y", "z", "size"]
        yield table("Angular velocity at the start, body frame, rad/s", head, rows, kind="plan")
    else:
        yield paragraph("The body is at rest at the start.")
    if not plan.commands:
        return
    yield paragraph(
        "Commands are linear between the times of these tables. `to_csv` of the plan writes them "
        "with all digits, and at more times if you wish."
    )
    tables = []
    for k, name in enumerate(names):
        at_knots = _write(np.column_stack([curves[k] for curves in plan.commands.values()]))
        rows = [[f"{t:.4g}", *row] for t, row in zip(plan.knots, at_knots, strict=True)]
        caption = f"Commands of trajectory {name}, {plan.command_unit}"
        tables.append(table(caption, ["time (s)", *plan.commands], rows, kind="plan"))
    yield grid(tables)


def _write(numbers: np.ndarray) -> list[list[str]]:
    """The words of numbers (rows, columns), to the same digit, so that rounding is 0."""
    digits = DIGITS - 1 - int(np.floor(np.log10(np.max(abs(numbers), initial=1e-300))))
    rounded = np.round(numbers, digits) + 0.0  # no -0
    return [[f"{number:.{DIGITS}g}" for number in row] for row in rounded]


def _limits(plan: Plan) -> Section:
    rows = [
        [use.name, f"{use.extreme:.4g}", f"{use.limit:.4g}", use.unit, "yes" if use.binds else "no"]
        for use in plan.uses
    ]
    binding = [row for row, use in enumerate(plan.uses) if use.binds]
    return Section(
        "Limits",
        "limits",
        table(
            "How much of each limit is taken",
            ["what is limited", "in the plan", "limit", "unit", "binds"],
            rows,
            binding,
            "trajectories",
        ),
        paragraph("A limit that binds keeps the experiment from telling more."),
    )


def _with_readings(part: FittedPart) -> FittedPart:
    """The part with residuals and predictions that are simulated once, however many there are."""
    if part.recordings.are_stored:
        return part
    kept = {"residuals": part.residuals, "predicted": part.predicted}
    return replace(part, simulate=kept.__getitem__)


def _verdict(estimate: Estimate | JointEstimate, verdict: str) -> Section:
    words, _, reasons = verdict.partition(": ")
    kind = next(kind for beginning, kind in KINDS.items() if words.startswith(beginning))
    freedom = estimate.degrees_of_freedom
    facts = {
        "trajectories": f"{estimate.trajectories}",
        "degrees of freedom": f"{freedom:,}".replace(",", " "),
        "chi-square for each": f"{estimate.chi_square / freedom:.4g}" if freedom else "none",
        "fit": f"{'converged' if estimate.converged else 'NOT CONVERGED'} after "
        f"{estimate.iterations} iterations",
    }
    reasons = reasons.split("; ") if reasons else []
    return Section("Verdict", "verdict", verdict_of(kind, words, reasons), definitions(facts))


def _answer(result: Result, caption: str, numbers: Table, about: list[str]) -> Section:
    return Section(
        "The answer",
        "answer",
        table(caption, ["number", *HEAD[1:]], numbers.cells(), _moments(numbers.names), "numbers"),
        items(about),
        picture_errors(result),
    )


def _moments(names: Sequence[str]) -> list[int]:
    return [i for i, name in enumerate(names) if "principal moment" in name]


def _open(who: str, unobservable: Sequence[str], messages: Sequence[str]) -> Section:
    parts = [paragraph(f"{who} all numbers.")]
    if unobservable:
        parts = [paragraph("Not observable, with what would show it:"), items(unobservable)]
    if messages:
        parts += [heading("Notes"), items(messages)]
    return Section("What is not determined", "open", *parts)


def _what_is_left_out(estimate: Estimate | JointEstimate, contents: Contents) -> Section:
    suspects, parts = contents.suspects, [items(contents.left_out)]
    if suspects:
        head = [
            "freed",
            "lowers chi-square by",
            "by chance",
            "would move",
            "std. errors",
            "verdict",
        ]
        rows = [_row_of(suspect) for suspect in suspects]
        certain = [i for i, suspect in enumerate(suspects) if suspect.is_certain]
        parts.append(table("What each suspect would gain", head, rows, certain, "suspects"))
    for name, part in estimate.parts.items():
        parts.append(_trajectories(part, f" of {name}" if len(estimate.parts) > 1 else ""))
    return Section("What the model leaves out", "left-out", *parts)


def _row_of(suspect: Suspect) -> list[str]:
    gain = [suspect.name, f"{suspect.gain:.4g}", f"{suspect.probability:.1g}"]
    if suspect.probability >= NOTED:  # what it would move means nothing
        return [*gain, "", "", "no more than chance"]
    words = "perhaps"
    if suspect.is_certain:
        words = "certain, and it matters" if suspect.matters else "certain, within the intervals"
    moved = f"{suspect.standard_errors:+.2g}" if suspect.moved else ""
    return [*gain, suspect.moved, moved, words]


def _trajectories(part: FittedPart, where: str) -> str:
    """The trajectories that fit worst, by chi-square."""
    chi_square, freedom = part.trajectory_chi_square, part.trajectory_freedom
    judged = np.flatnonzero(freedom > 0)
    ratio = chi_square[judged] / freedom[judged]
    worst = np.argsort(-ratio, kind="stable")[:MOST_ROWS]
    names, outliers = np.array(part.recordings.names)[judged], part.outliers
    words = ["yes" if name in outliers else "no" for name in names]
    rows = [[str(names[i]), f"{freedom[judged][i]}", f"{ratio[i]:.3g}", words[i]] for i in worst]
    caption = f"Trajectories{where} by chi-square for each degree of freedom"
    if len(judged) > len(worst):
        caption += f": the {len(worst)} largest of {len(judged)}"
    head = ["trajectory", "degrees of freedom", "chi-square for each", "outlier"]
    strong = [row for row, i in enumerate(worst) if names[i] in outliers]
    return table(caption, head, rows, strong, "trajectories")


def _hold_out(validation: Validation) -> Section:
    first, *others = validation.lines()
    rows = [
        [str(name), f"{ratio:.3g}", f"{probability:.2g}"]
        for name, ratio, probability in zip(*validation.summary().values(), strict=True)
    ]
    kind = "good" if validation.agrees else "bad"
    return Section(
        "Hold-out",
        "hold-out",
        verdict_of(kind, first, []),
        items(others),
        table(
            "Trajectories that were not fitted",
            ["trajectory", "chi-square over that of the fit", "by chance"],
            rows,
            kind="trajectories",
        ),
    )


def _what_was_read(parts: Mapping[str, FittedPart], run: Run) -> Section:
    inner = [items(run.read)]
    for name, part in parts.items():
        recordings = part.recordings
        if len(parts) > 1:
            inner.append(heading(name))
        inner.append(items([*recordings.provenance, str(recordings), *_describe(part.model)]))
    for i, (log, intervals) in enumerate(run.flights[:MOST_LOGS]):
        inner.append(picture_log(log, intervals, f"log-{i}"))
    return Section("What was read, cut and assumed", "read", *inner)


def _describe(model: Model) -> Iterator[str]:
    """What a model assumes."""
    for channel, sensor in model.sensors.items():
        sigma = ", ".join(f"{x:.4g}" for x in np.ravel(np.asarray(sensor.sigma, float)))
        kind = f"`{type(sensor).__name__}`, `sigma` {sigma} {sensor.unit}"
        yield f"{channel.replace('_', ' ')}: {kind}"
    acting = {"body": model.body, "torque": model.torque, "rotors": model.rotors}
    for name, module in acting.items():
        if module is not None:
            yield f"{name}: `{type(module).__name__}`"


def _how_to_do_it_again(run: Run) -> Section:
    parts = []
    if run.command:
        parts += [heading("By a command"), code(run.command)]
    if run.python:
        parts += [heading("In Python"), code(run.python)]
    if run.logs:
        rows = [[path, f"`{digest}`"] for path, digest in run.logs.items()]
        parts.append(table("Logs", ["file", "SHA-256"], rows))
    parts.append(definitions(run.versions))
    return Section("How to do it again", "again", *parts)
