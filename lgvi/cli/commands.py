"""The verbs of the command `lgvi`, and their options."""

import json
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from .. import __version__
from .settings import (
    ONLY,
    Settings,
    SettingsError,
    make_settings,
    parse_names,
    parse_numbers,
    parse_pairs,
    parse_sigma,
    parse_value,
)

FAILED, WRONG_INPUT = 1, 2  # exit statuses; see also `status_of`
CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
INPUT_ERRORS = (ValueError, TypeError, OSError, ImportError)


@click.group(context_settings=CONTEXT)
@click.version_option(__version__, prog_name="lgvi")
def lgvi() -> None:
    """Identify the inertia of a body from a log of attitudes or rates.

    \b
    lgvi info LOG                 what is in a log
    lgvi identify LOG... -o DIR   the inertia, with intervals, and a report in DIR/report.html

    The exit status is 0 if the model holds, 1 if the run failed, or the fit did not converge and no
    cause is known, 2 for wrong options, or a log that cannot be read or has a usual mistake, and 3
    if the model does not hold.
    """


def with_errors(verb: Callable[..., None]) -> Callable[..., None]:
    """A verb whose errors are one line, or with `--debug` a stack."""

    @wraps(verb)
    def run(*arguments: Any, debug: bool, **options: Any) -> None:
        def show(message, category, filename, lineno, file=None, line=None) -> None:
            print(f"lgvi: warning: {' '.join(str(message).split())}", file=sys.stderr)

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", UserWarning)
                warnings.showwarning = show
                verb(*arguments, **options)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except KeyboardInterrupt as error:
            _fail(error, debug, 130)
        except INPUT_ERRORS as error:
            _fail(error, debug, WRONG_INPUT)
        except Exception as error:
            _fail(error, debug, FAILED)

    return click.option("--debug", is_flag=True, help="Show the stack of an error.")(run)


def _fail(error: BaseException, debug: bool, status: int) -> None:
    if debug:
        traceback.print_exc()
    words = " ".join(str(error).split())
    if not words:
        is_stopped = isinstance(error, KeyboardInterrupt)
        words = "stopped" if is_stopped else type(error).__name__
    if isinstance(error, OSError) and error.strerror and error.filename:
        words = f"{error.filename}: {error.strerror}"
    print(f"lgvi: error: {ARGUMENT.sub(_as_option, words)}", file=sys.stderr)
    sys.exit(status)


ARGUMENT = re.compile(r"`(\w+)=([^`]*)`")  # of Python, in an error
OF_TABLES = "t", "time_unit", "delimiter", "decimal", "missing", "comment", "skip_lines"


def _as_option(argument: re.Match) -> str:
    """The option for an argument of Python: one of the command, or one of the reader."""
    name, value = argument.groups()
    option = f"--{name.replace('_', '-')}"
    known = {name for parameter in identify.params for name in parameter.opts}
    if name == "check":
        return "`--no-check`"
    if option in known:
        return f"`{option} {value}`" if value else f"`{option}`"
    return f"`--read {name}={value}`" if not value or name in OF_TABLES else argument[0]


def options_of(*decorators: Callable) -> Callable:
    """Several options as one decorator, in their order."""

    def decorate(verb: Callable) -> Callable:
        for decorator in reversed(decorators):
            verb = decorator(verb)
        return verb

    return decorate


LOGS = click.argument("logs", nargs=-1, type=click.Path())
READER = options_of(
    click.option("--reader", help="Format of the log; by default it is recognised."),
    click.option(
        "--read",
        "read",
        multiple=True,
        metavar="KEY=VALUE",
        help="An option of the reader, such as time_unit=ms or motor_poles=14.",
    ),
)
SIGNALS = options_of(
    READER,
    click.option(
        "--map",
        "map_",
        multiple=True,
        metavar="QUANTITY=SIGNAL[,SIGNAL...]",
        help="Signals of a quantity, such as angular_velocity=gx,gy,gz.",
    ),
    click.option(
        "--unit",
        multiple=True,
        metavar="[QUANTITY=]UNIT",
        help="Unit of a quantity, such as deg/s, where the file does not tell.",
    ),
    click.option("--frame", help="Axes of the body for the result: FLU or FRD."),
    click.option("--space", help="Axes of space for attitudes and positions: ENU or NED."),
    click.option(
        "--attitude-order", help="wxyz, xyzw, rotation_vector, or axes of angles such as ZYX."
    ),
    click.option(
        "--attitude-direction",
        type=click.Choice(["body to space", "space to body"]),
        help="Direction of attitudes, where the file does not tell.",
    ),
    click.option(
        "--duplicates",
        type=click.Choice(["error", "first", "mean"]),
        help="What to do with samples of the same time.",
    ),
    click.option(
        "--trajectory",
        metavar="COLUMN",
        help="Column of the names of trajectories, in CSV files with several. The columns of --map "
        "are then read as by Recordings.from_csv, whose arguments --read takes, such as t=time.",
    ),
    click.option(
        "--flights",
        metavar="auto|whole|FILE",
        help="Free flights: found by the accelerometer (auto), the whole log, or a table of times "
        "with columns from,to.",
    ),
    click.option("--from", "begin", type=float, metavar="S", help="First time in the log, s."),
    click.option("--to", "end", type=float, metavar="S", help="Last time in the log, s."),
)
MODEL = options_of(
    click.option(
        "--free",
        multiple=True,
        metavar="NAME[,NAME...]",
        help="What is estimated beside the inertia: bias, scale, alignment, time_offset, damping, "
        "drag, rotor_delay, angular_velocity.bias, rotors.lag ...",
    ),
    click.option(
        "--sigma",
        multiple=True,
        metavar="QUANTITY=NUMBER",
        help="Noise of a sensor; by default how much successive readings scatter.",
    ),
    click.option(
        "--moments",
        metavar="A,B,C",
        help="Principal moments from which the fit starts, kg m²; they do not set the size.",
    ),
    click.option("--rotor", metavar="SIGNAL", help="Signal of the speed of one rotor."),
    click.option("--axis", metavar="x|y|z|A,B,C", help="Axis of the rotor in the body."),
    click.option("--rotor-inertia", type=float, metavar="I", help="Its spin inertia, kg m²."),
    click.option(
        "--config",
        type=click.Path(),
        metavar="FILE.toml",
        help="Options in a file; those of the command line come first.",
    ),
)
SCRIPT = options_of(
    click.option("--python", is_flag=True, help="Print the Python script that does the same."),
    click.option("--no-cache", is_flag=True, help="Keep no compiled programs for the next run."),
)


def as_settings(config: str | None = None, **options: Any) -> Settings:
    """The settings of a file and of the options of the command line."""
    options["map"] = {
        quantity: [name.strip() for name in names.split(",")]
        for quantity, names in parse_pairs("--map", options.pop("map_", ())).items()
    }
    options["read"] = {
        key: parse_value(value) for key, value in parse_pairs("--read", options["read"]).items()
    }
    options["sigma"] = parse_sigma(options.get("sigma") or ())
    options["unit"] = _units(options.get("unit") or ())
    options["free"] = parse_names(options.get("free") or ())
    for name in ("moments", "centre"):
        if options.get(name):
            options[name] = parse_numbers(f"--{name}", options[name])
    if "," in (options.get("axis") or ""):
        options["axis"] = parse_numbers("--axis", options["axis"])
    options["logs"] = list(options["logs"])
    return make_settings(options, config)


def _units(words: tuple[str, ...]) -> dict[str, str]:
    """Units by quantity; one without a quantity has the name `ONLY`."""
    return parse_pairs("--unit", [word if "=" in word else f"{ONLY}={word}" for word in words])


@lgvi.command(
    epilog="In Python: log = lgvi.logs.read('flight.bbl'); print(lgvi.logs.describe(log)); "
    "lgvi.logs.find_free_flights(log)"
)
@click.argument("path", metavar="LOG", type=click.Path())
@READER
@click.option("--plot", type=click.Path(), metavar="FILE", help="Draw the signals and flights.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
@with_errors
def info(path: str, plot: str | None, as_json: bool, **options: Any) -> None:
    """What is in a log: signals, rates, gaps, what is wrong with them, and free flights."""
    from .info import show_info

    settings = as_settings(logs=(path,), **options)
    show_info(settings, plot, as_json)


@lgvi.command(
    epilog="In Python: log = lgvi.logs.read(LOG); recordings = log.recordings(angular_velocity="
    "'gyro'); estimate = identify(Model(lgvi.Gyroscope(0.01)), recordings); "
    "estimate.to_html('report.html'). The option --python prints the script of a run."
)
@LOGS
@SIGNALS
@MODEL
@click.option(
    "--errors",
    type=click.Choice(["independent", "clustered", "correlated", "bootstrap"]),
    help="Kind of standard errors; by default chosen by the number of trajectories.",
)
@click.option(
    "--hold-out",
    type=float,
    metavar="PART",
    help="Part of the trajectories, such as 0.2, that is not fitted, and is predicted: the report "
    "says whether they agree. The exit status is that of the fit.",
)
@click.option(
    "--no-check",
    "check",
    is_flag=True,
    flag_value=False,
    default=None,
    help="Fit a log that has a usual mistake, such as another unit, as it is.",
)
@click.option("--mass", type=float, metavar="KG", help="Mass, for --urdf, --mjcf and under thrust.")
@click.option("--centre", metavar="X,Y,Z", help="Centre of mass for these, m; by default 0,0,0.")
@click.option("--urdf", type=click.Path(), metavar="FILE", help="Write an <inertial> for URDF.")
@click.option("--mjcf", type=click.Path(), metavar="FILE", help="Write an <inertial> for MuJoCo.")
@click.option("-o", "--output", type=click.Path(), metavar="DIR", help="Folder for the report.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@SCRIPT
@with_errors
def identify(
    urdf: str | None,
    mjcf: str | None,
    output: str | None,
    as_json: bool,
    python: bool,
    no_cache: bool,
    **options: Any,
) -> None:
    """Identify the inertia of a body from LOGS, with intervals and a verdict.

    Where the format tells which signals are rates or attitudes nothing has to be said; else --map
    names them. Every quantity that --map names is fitted. Free flights are found by the
    accelerometer, if there is one.
    """
    from .identify import run_identify

    settings = as_settings(**options)
    sys.exit(
        run_identify(
            settings,
            output=output,
            models={"urdf": urdf, "mjcf": mjcf},
            as_json=as_json,
            python=python,
            cache=not no_cache,
        )
    )


MOMENTS = click.option(
    "--moments", required=True, metavar="A,B,C", help="Principal moments, kg m²."
)
READINGS = options_of(
    click.option("--seconds", type=float, default=1.0, show_default=True, help="Duration."),
    click.option("--rate", type=float, default=100.0, show_default=True, help="Samples a second."),
    click.option(
        "--sigma",
        multiple=True,
        metavar="QUANTITY=NUMBER",
        help="A sensor and its noise: attitude=0.001 (rad), angular_velocity=0.01 (rad/s).",
    ),
)


@lgvi.command(epilog="In Python: simulate_recordings(Model(body, sensors), times, states, key=key)")
@MOMENTS
@click.option(
    "--rates",
    required=True,
    multiple=True,
    metavar="X,Y,Z",
    help="Angular velocity at the start, rad/s; once for each trajectory.",
)
@READINGS
@click.option("--seed", type=int, default=0, show_default=True, help="Of the noise.")
@click.argument("output", metavar="FILE", type=click.Path())
@SCRIPT
@with_errors
def simulate(output: str, python: bool, no_cache: bool, **options: Any) -> None:
    """Simulate what sensors read of a free body, and write it to FILE (.csv or .parquet)."""
    from .simulate import run_simulate

    run_simulate(output, python=python, cache=not no_cache, **options)


@lgvi.command(
    epilog="In Python: plan(Model(body, sensors), times, Limits(rate=6.0, trajectories=3)); of an "
    "experiment with --rates: identifiability(Model(body, sensors), times, states, free=...)"
)
@MOMENTS
@click.option(
    "--max-rate",
    type=float,
    metavar="RAD_PER_S",
    help="Largest angular rate of the body, rad/s, at any time.",
)
@click.option(
    "--throws",
    type=int,
    metavar="N",
    help="Number of trajectories; by default 3, or 1 where something commands the body.",
)
@click.option(
    "--initial-rate",
    type=float,
    metavar="RAD_PER_S",
    help="Largest rate at the start, rad/s; by default that of --max-rate, or rest where something "
    "commands the body.",
)
@click.option(
    "--saturation",
    metavar="NUMBER|X,Y,Z",
    help="Largest reading of the gyroscope about each of its axes, rad/s.",
)
@click.option(
    "--turn",
    type=float,
    metavar="RAD",
    help="Largest turn from the first attitude, rad, that a camera follows.",
)
@click.option(
    "--limits",
    type=click.Path(),
    metavar="FILE.toml",
    help="Limits in a file, such as rate = 0.2, and hardware that takes commands, in a table "
    "[wheels], [motors] (with [rotors]) or [torques].",
)
@READINGS
@click.option("--free", multiple=True, metavar="NAME[,NAME...]", help="As for identify.")
@click.option(
    "--rates",
    multiple=True,
    metavar="X,Y,Z",
    help="An experiment of your own, instead of --max-rate: the angular velocity at the start, "
    "rad/s; once for each trajectory.",
)
@click.option("--csv", type=click.Path(), metavar="FILE", help="What to do, as a table.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="A report as HTML.")
@SCRIPT
@with_errors
def plan(output: str | None, python: bool, no_cache: bool, **options: Any) -> None:
    """The experiment that tells most of a body, and the standard errors to expect of it.

    Throws up to --max-rate are searched for; with a file for --limits, speeds of wheels, speeds of
    motors, or torques. With --rates nothing is searched for: it is what that experiment would tell.
    """
    from .plan import run_plan

    run_plan(output, python=python, cache=not no_cache, **options)


@lgvi.command(epilog="In Python: the folder has run.py, the script of the run.")
@click.argument("folder", metavar="DIR", type=click.Path())
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@click.option("--open", "open_", is_flag=True, help="Open the page in a browser.")
@with_errors
def report(folder: str, as_json: bool, open_: bool) -> None:
    """Show the result that identify has written to DIR."""
    from .identify import RESULT, TEXT, status_of

    file = Path(folder) / (RESULT if as_json else TEXT)
    if not file.is_file():
        raise SettingsError(f"{folder}: must be a folder that `lgvi identify -o` has written")
    text = file.read_text("utf-8")
    click.echo(text, nl=False)
    page = Path(folder) / "report.html"
    print(f"lgvi: the page is {page}", file=sys.stderr)
    if open_:
        click.launch(str(page))
    result = json.loads((Path(folder) / RESULT).read_text("utf-8"))
    sys.exit(status_of(result["verdict"]))


@lgvi.command(epilog="In Python: lgvi.logs.read(LOG).write(FILE, signals)")
@click.argument("path", metavar="LOG", type=click.Path())
@click.argument("output", metavar="FILE", type=click.Path())
@READER
@click.option("--signal", "signals", multiple=True, help="A signal to write; by default all.")
@with_errors
def convert(path: str, output: str, signals: tuple[str, ...], **options: Any) -> None:
    """Write the signals of a log to a CSV or Parquet file, one row for each time."""
    from ..logs import read

    settings = as_settings(logs=(path,), **options)
    log = read(path, settings.reader, **settings.read)
    log.write(output, list(signals) or None)


@lgvi.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print what makes a shell complete the command: eval "$(lgvi completion bash)"."""
    from click.shell_completion import get_completion_class

    kind = get_completion_class(shell)
    assert kind is not None
    click.echo(kind(lgvi, {}, "lgvi", "_LGVI_COMPLETE").source())
