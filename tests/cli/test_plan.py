"""`lgvi plan`: the experiment that it searches for, what it writes, and its errors."""

import csv
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from lgvi.cli.commands import lgvi
from lgvi.cli.limits import read_limits
from lgvi.cli.script import Script

PAGE = Path(__file__).parents[2] / "docs" / "logs" / "index.md"
READINGS = "--seconds", "0.5", "--rate", "20", "--no-cache"
SIGMA = "--sigma", "angular_velocity=0.01"
WHEELS = """\
rate = 5.0
trajectories = 1

[wheels]
axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]
inertia = 0.01
speed = [30.0, 20.0]
start = 0.0
knots = 3
"""
ROTORS = """\
[rotors]
arms = [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]]
axes = [0, 0, 1]
spin = [1, -1, 1, -1]
thrust = 3e-6
drag = 1e-8
"""


def plan(*words, status=0):
    arguments = "plan", "--moments", "1,2,2.8", *READINGS, *words
    result = CliRunner().invoke(lgvi, [str(word) for word in arguments])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def throws(tmp_path_factory):
    """The result of a plan of two throws, and its folder."""
    folder = tmp_path_factory.mktemp("throws")
    words = "--max-rate", "4", "--throws", "2", "--free", "bias", *SIGMA
    files = "--csv", folder / "plan.csv", "-o", folder / "plan.html"
    return plan(*words, *files), folder, (*words, *files)


def table_of(file):
    """The columns of a CSV file by name."""
    with open(file, newline="", encoding="utf-8") as opened:
        header, *rows = csv.reader(opened)
    return dict(zip(header, np.array(rows, float).T, strict=True))


def test_throws_keep_the_largest_rate_and_are_written(throws):
    result, folder, _ = throws
    table = table_of(folder / "plan.csv")
    np.testing.assert_array_equal(table["trajectory"], [0, 1])
    rates = np.stack([table[f"angular_velocity_{axis} (rad/s)"] for axis in "xyz"], axis=1)
    assert np.all(np.linalg.norm(rates, axis=1) <= 4)
    for k in range(2):
        words = ", ".join(f"{rate:.4g}" for rate in rates[k])
        assert f"trajectory {k} starts at {words} rad/s" in result.stdout
    assert "of 4 rad/s" in result.stdout
    assert "angular_velocity.bias[0]" in result.stdout
    assert (folder / "plan.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    assert "lgvi: searching for the experiment that tells most" in result.stderr


def test_the_script_prints_the_same_plan(throws):
    result, _, words = throws
    printed = StringIO()
    with redirect_stdout(printed):
        exec(plan(*words, "--python").stdout, {})
    assert printed.getvalue() == result.stdout


def test_wheels_of_a_file_are_planned_and_options_come_first(tmp_path):
    limits, table = tmp_path / "wheels.toml", tmp_path / "plan.csv"
    limits.write_text(WHEELS, "utf-8")
    words = "--limits", limits, "--max-rate", "3.5", "--csv", table, "--python", *SIGMA
    assert "rate=3.5" in plan(*words).stdout
    columns = table_of(table)
    np.testing.assert_allclose(columns["t (s)"], [0, 0.25, 0.5])
    for name, speed in (("wheel 0 (rad/s)", 30), ("wheel 1 (rad/s)", 20)):
        assert columns[name][0] == 0
        assert 0 < np.max(abs(columns[name])) <= speed * (1 + 1e-9)


def test_the_limits_on_the_page_are_limits(tmp_path):
    file, script = tmp_path / "wheels.toml", Script()
    content = PAGE.read_text("utf-8").split("```toml\n")[1].split("```")[0]
    file.write_text(content, "utf-8")
    script.add("from lgvi import identification")
    read_limits(str(file), {}).add_to(script)
    assert len(script["limits"].commands.axes) == 4


NAMED = "--rates", "1,2,3"
FILE = "--limits", "FILE"


@pytest.mark.parametrize(
    ("content", "arguments", "words"),
    [
        ("", [], "--max-rate must be there, the largest angular rate in rad/s"),
        ("", [*NAMED, "--max-rate", "3", "--throws", "2"], "--rates and --max-rate, --throws must"),
        ("", [*NAMED, "--csv", "x.csv"], "--rates and --csv must not be there together"),
        ("", [*NAMED, *FILE], "--rates and --limits must not be there together"),
        ("", ["--max-rate", "-1"], "--max-rate must be above 0, but is -1.0"),
        ("", ["--max-rate", "nan"], "--max-rate must be a finite number, but is nan"),
        ("", ["--max-rate", "3", "--throws", "0"], "--throws must be a whole number above 0"),
        (
            "",
            ["--max-rate", "3", "--initial-rate", "4"],
            "--initial-rate must be a number from",
        ),
        ("", ["--max-rate", "3", "--turn", "-1"], "--turn must be above 0, but is -1.0"),
        ("", ["--max-rate", "3", "--saturation", "1,2"], "--saturation must be a number or three"),
        ("", ["--max-rate", "3", "--saturation", "1,2,-3"], "--saturation must be above 0, but is"),
        (
            "",
            ["--max-rate", "3", "--saturation", "9", "--sigma", "attitude=0.1"],
            "--saturation is of a gyroscope, and needs its noise by --sigma angular_velocity=",
        ),
        ("", ["--max-rate", "3", "-o", "no/plan.html"], "no/plan.html: its folder is not there"),
        ("", ["--max-rate", "3", "--csv", "no/plan.csv"], "no/plan.csv: its folder is not there"),
        ("", ["--limits", "missing.toml"], "missing.toml: No such file"),
        ("rate", FILE, "FILE: must be TOML, but is not"),
        ("rte = 1.0", FILE, "FILE: there is no option `rte`; there are rate, trajectories"),
        ("rate = -1.0", FILE, "`rate` of FILE must be above 0, but is -1.0"),
        ("wheels = 3", FILE, "FILE: `wheels` must be of the kind dict[str, Any], but is 3"),
        ("rate = 1.0\n[wheels]\n[torques]", FILE, "FILE: must have one table of hardware, but has"),
        ("rate = 1.0\n[torques]\nsize = 1", FILE, "FILE: [torques]: there is no option `size`"),
        ("rate = 1.0\n[wheels]\nspeed = 1.0", FILE, "[wheels]: must have axes, inertia as well"),
        (WHEELS.replace("30.0", "-1.0"), FILE, "`speed` in [wheels] of FILE must be above 0"),
        ("rate = 1.0\n[motors]\nlowest = 1.0\nhighest = 2.0", FILE, "FILE must have `rotors`"),
        (
            f"rate = 1.0\n[motors]\nlowest = 1.0\nhighest = [2.0, 3.0]\n{ROTORS}",
            FILE,
            "`highest` in [motors] of FILE must be a number or have shape (4,), but its shape is",
        ),
        ("travel = 1.0", [*FILE, "--max-rate", "1"], "`travel` of FILE of the limits must be None"),
    ],
)
def test_an_error_is_one_line_and_names_the_option_or_the_file(tmp_path, content, arguments, words):
    file = tmp_path / "limits.toml"
    file.write_text(content, "utf-8")
    result = plan(*(str(file) if word == "FILE" else word for word in arguments), status=2)
    error = result.stderr.strip().splitlines()[-1]
    assert error.startswith("lgvi: error: ")
    assert words.replace("FILE", str(file)) in error
    assert "Traceback" not in result.stderr
