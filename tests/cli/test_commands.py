"""The command `lgvi`: what it prints, writes and returns."""

import dataclasses
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.integrate import solve_ivp

from lgvi.cli.commands import lgvi
from lgvi.cli.experiment import add_model, free_function
from lgvi.cli.script import Script
from lgvi.cli.settings import Settings, SettingsError, make_settings

ROOT = Path(__file__).parents[2]
MOMENTS = np.array([1.0, 2.0, 2.8])
T = np.arange(100) * 0.01


def rates_of(omega):
    """Angular velocities of a free body by SciPy, rad/s."""

    def fall(t, omega):
        return np.cross(MOMENTS * omega, omega) / MOMENTS

    return solve_ivp(fall, (0, 1), omega, t_eval=T, rtol=1e-10, atol=1e-12).y.T


def run(*arguments, status=0):
    result = CliRunner().invoke(lgvi, [str(word) for word in arguments])
    assert result.exit_code == status, result.output
    return result


@pytest.fixture(scope="module")
def throws(tmp_path_factory):
    """CSV files of a gyroscope in deg/s with a bias, one for each of five throws."""
    folder, random = tmp_path_factory.mktemp("throws"), np.random.default_rng(0)
    files = []
    for i in range(5):
        rates = rates_of(random.normal(size=3) * 5) + random.normal(size=(100, 3)) * 5e-3
        table = np.column_stack([T, np.rad2deg(rates)])
        files.append(folder / f"throw{i}.csv")
        header = "t (s),gx (deg/s),gy (deg/s),gz (deg/s)"
        np.savetxt(files[-1], table, delimiter=",", header=header, comments="")
    return files


GYRO = "--map", "angular_velocity=gx,gy,gz", "--no-cache"


def test_help_is_there_at_once_and_without_jax():
    code = (
        "import sys; from lgvi.cli.commands import lgvi\n"
        "try: lgvi(['identify', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not [m for m in sys.modules if m.split('.')[0] in ('jax', 'scipy', 'matplotlib')]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--hold-out" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--version"], 0, ""),
        (["identify", "--no-such"], 2, "No such option"),
        (["forecast"], 2, "No such command 'forecast'"),
        (["info"], 2, "Missing argument 'LOG'"),
    ],
)
def test_wrong_use_is_one_line(arguments, status, words):
    code = "from lgvi.cli.start import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.returncode == status
    lines = done.stderr.splitlines()
    assert len(lines) == (status != 0)
    assert words in "".join(lines)


def test_a_log_becomes_a_result_and_a_folder(throws, tmp_path):
    folder = tmp_path / "run"
    result = run("identify", *throws, *GYRO, "-o", folder, "--hold-out", "0.2")
    assert result.stdout.startswith("verdict: the model holds")
    assert "angular velocity is `gx, gy, gz`, in deg/s" in result.stdout
    assert "hold-out: 1 trajectory that was not fitted agrees" in result.stdout
    content = json.loads((folder / "result.json").read_text("utf-8"))
    moments = {
        name: (low, high)
        for name, low, high in zip(content["name"], content["lower"], content["upper"], strict=True)
        if name.startswith("principal moment")
    }
    assert len(moments) == 3
    for (low, high), true in zip(moments.values(), MOMENTS / MOMENTS.sum(), strict=True):
        assert low < true < high
    assert content["hold_out"]["agrees"]
    assert (folder / "report.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    assert (folder / "report.txt").read_text("utf-8") == result.stdout
    shown = run("report", folder)
    assert shown.stdout == result.stdout
    assert json.loads(run("report", folder, "--json").stdout) == content


def test_throws_in_one_file_are_the_same_as_in_files_of_their_own(throws, tmp_path):
    """Without the column of their names nothing is fitted: their times would be mixed."""
    tables = [np.loadtxt(file, delimiter=",", skiprows=1) for file in throws[:3]]
    rows = [
        f"throw{i},{','.join(map(repr, row))}"
        for i, table in enumerate(tables)
        for row in table.tolist()
    ]
    file = tmp_path / "throws.csv"
    file.write_text("\n".join(["throw,t,gx,gy,gz", *rows]) + "\n", "utf-8")
    options = *GYRO, "--unit", "deg/s", "--json"
    for duplicates in ((), ("--duplicates", "first")):
        words = run("identify", file, *options, *duplicates, status=2).stderr
        assert "times that increase, but they begin again (2 times)" in words
        assert "`--trajectory COLUMN` tells the column of their names" in words
    together = json.loads(run("identify", file, *options, "--trajectory", "throw").stdout)
    alone = json.loads(run("identify", *throws[:3], *GYRO, "--json").stdout)
    np.testing.assert_allclose(together["value"], alone["value"], rtol=1e-8)
    assert together["trajectories"] == 3


def test_the_script_and_the_settings_do_the_same_again(throws, tmp_path):
    folder = tmp_path / "run"
    first = run("identify", *throws[:3], *GYRO, "--free", "bias", "-o", folder, "--json")
    again = run("identify", "--config", folder / "run.toml", "--no-cache", "--json")
    assert json.loads(first.stdout) == json.loads(again.stdout)
    script = run("identify", *throws[:3], *GYRO, "--free", "bias", "--python").stdout
    assert (folder / "run.py").read_text("utf-8").endswith(script)
    names = {}
    exec(script, names)
    np.testing.assert_array_equal(
        names["estimate"].summary()["value"], json.loads(first.stdout)["value"]
    )
    settings = tomllib.loads((folder / "run.toml").read_text("utf-8"))
    assert "logs" in settings
    assert settings["free"] == ["bias"]
    assert settings["map"] == {"angular_velocity": ["gx", "gy", "gz"]}


def test_settings_come_back_from_their_file(tmp_path):
    settings = Settings(
        logs=['a "b"\\c.csv', "ü\n.csv"],
        map={"angular_velocity": ["x y", "z"]},
        sigma={"attitude": 1e-3},
        sensors={"specific_force": {"position": [0.1, -2e-5, 3.0]}},
        model={"deep": {"er": [{"a": "\U000e0001"}]}},
        rotors={"spin": [1, -1], "arms": [[0.1, 0.2, 0.0], [0.3, 0.0, 0.0]]},
        hold_out=0.25,
        check=False,
    )
    file = tmp_path / "run.toml"
    file.write_text(settings.to_toml(), "utf-8")
    paths = [str(tmp_path / path) for path in settings.logs]
    assert make_settings({}, str(file)) == dataclasses.replace(settings, logs=paths)


def test_a_saved_run_is_from_its_folder_and_knows_its_logs(throws, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log, flights = Path("logs/throw.csv"), Path("flights.csv")
    log.parent.mkdir()
    log.write_bytes(throws[0].read_bytes())
    flights.write_text("from,to\n0.1,0.9\n", "utf-8")
    run("identify", log, *GYRO, "--flights", flights, "-o", "runs/one")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    arguments = "identify", "--config", "../runs/one/run.toml", "--no-cache"
    assert "SHA-256" not in run(*arguments).stderr
    with open("../logs/throw.csv", "a") as file:
        file.write("1,0,0,0\n")
    warning = "lgvi: warning: ../logs/throw.csv: is not the file of the saved run"
    assert warning in run(*arguments).stderr


def test_a_model_that_does_not_hold_has_a_status_of_its_own(throws, tmp_path):
    """Rates that fall by the air, which the model leaves out."""
    files = []
    for file in throws:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        table[:, 1:] *= np.exp(-0.02 * table[:, :1])
        files.append(tmp_path / file.name)
        header = "t (s),gx (deg/s),gy (deg/s),gz (deg/s)"
        np.savetxt(files[-1], table, delimiter=",", header=header, comments="")
    result = run("identify", *files, *GYRO, status=3)
    assert result.stdout.startswith("verdict: the model does not hold")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["identify"], "a log must be given"),
        (["identify", "missing.csv"], "missing.csv: No such file"),
        (["identify", "LOG", "--map", "rates=gx"], "there is no quantity `rates`"),
        (["identify", "LOG", "--map", "gx"], "--map must be like name=value, but is 'gx'"),
        (["identify", "LOG"], "say so by --map"),
        (["identify", "LOG", "--map", "angular_velocity=gx,gy"], "angular_velocity"),
        (["identify", "LOG", "--map", "angular_velocity=gx,gy,no"], "signal `no`: is not there"),
        (["identify", "LOG", *GYRO, "--free", "bais"], "--free bais: there is no such name"),
        (["identify", "LOG", *GYRO, "--free", "attitude.bias"], "there is no such name"),
        (["identify", "LOG", *GYRO, "--free", "angular_velocity.b"], "angular_velocity.bias"),
        (["identify", "LOG", *GYRO, "--free", "alignment"], "--free alignment: no sensor"),
        (["identify", "LOG", *GYRO, "--urdf", "x.urdf"], "need the mass, by --mass"),
        (["identify", "LOG", *GYRO, "--hold-out", "2"], "--hold-out must be above 0 and below 1"),
        (["identify", "LOG", *GYRO, "--from", "2", "--to", "1"], "--to must be after --from, 2.0"),
        (["identify", "LOG", "LOG", *GYRO], "some have the same content"),
        (["info", "LOG", "--read", "foo=1"], "There is no option `foo`: options of the reader"),
        (["identify", "LOG", *GYRO, "--from", "5", "--to", "6"], "must have samples"),
        (["identify", "LOG", *GYRO, "--config", "CONFIG"], "there is no option `fre`"),
        (["identify", "LOG", *GYRO, "--unit", "attitude=rad"], "is read, angular_velocity, but"),
        (["identify", "LOG", *GYRO, "--sigma", "angular_velocity=1,2"], "a number above 0, but is"),
        (["identify", "LOG", *GYRO, "--sigma", "angular_velocity=nan"], "must be numbers such as"),
        (["identify", "LOG", *GYRO, "--hold-out", "nan"], "--hold-out must be a number"),
        (["identify", "LOG", *GYRO, "--axis", "z"], "--axis needs the signal of the --rotor"),
        (["identify", "LOG", *GYRO, "--free", "angular_velocity"], "there is no such name"),
        (["identify", "LOG", *GYRO, *GYRO[:2]], "there once for angular_velocity"),
        (["identify", "LOG", *GYRO, "--from", "0", "--flights", "whole"], "not be there together"),
        (["identify", "LOG", "--trajectory", "k"], "--trajectory needs --map"),
        (["identify", "LOG", *GYRO, "--trajectory", "k", "--from", "0"], "--trajectory and --from"),
        (["identify", "LOG", *GYRO, "--trajectory", "k"], "write `--read t="),
        (["identify", "LOG", *GYRO, "--config", "KINDS"], "`free` must be of the kind list[str]"),
        (["identify", "LOG", *GYRO, "--mass", "1", "--urdf", "no/x.urdf"], "folder is not there"),
        (["simulate", "--moments", "1,2,3", "--rates", "1,2,3", "x.txt"], "must end with .csv"),
        (["simulate", "--moments", "1,2", "--rates", "1,2,3", "x.csv"], "three numbers"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(throws, tmp_path, arguments, words):
    config = tmp_path / "run.toml"
    config.write_text("fre = ['bias']\n", "utf-8")
    kinds = tmp_path / "kinds.toml"
    kinds.write_text("free = [1]\n", "utf-8")
    names = {"LOG": str(throws[0]), "CONFIG": str(config), "KINDS": str(kinds)}
    result = run(*(names.get(word, word) for word in arguments), status=2)
    error = result.stderr.strip().splitlines()[-1]
    assert error.startswith("lgvi: error: ")
    assert words in error
    assert "Traceback" not in result.stderr


def test_a_sensor_that_is_off_is_named(tmp_path):
    file = tmp_path / "off.csv"
    table = np.column_stack([T, np.zeros((100, 3))])
    header = "t (s),gx (deg/s),gy (deg/s),gz (deg/s)"
    np.savetxt(file, table, delimiter=",", header=header, comments="")
    result = run("identify", file, *GYRO, status=2)
    assert "signal of angular velocity: must change in the log, but is constant" in result.stderr


def test_an_error_names_options_and_not_arguments_of_python(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("k,gx,gy,gz\n" + "".join(f"{i},1,2,{i % 3}\n" for i in range(20)), "utf-8")
    assert "write `--read time=`" in run("info", file, status=2).stderr


def test_debug_shows_the_stack(throws):
    result = run("identify", throws[0], "--debug", status=2)
    assert "Traceback" in result.stderr


def test_what_is_simulated_is_identified(tmp_path):
    file = tmp_path / "throw.csv"
    rates = ("--rates", "4,1,2", "--rates", "1,3,4", "--rates", "-2,4,3")
    run("simulate", "--moments", "1,2,2.8", *rates, "--no-cache", file)
    files = [tmp_path / f"throw-{i}.csv" for i in range(3)]
    assert run("identify", *files, "--no-cache").stdout.startswith("verdict: the model holds")
    page = tmp_path / "plan.html"
    arguments = "plan", "--moments", "1,2,2.8", *rates, "--no-cache", "--free", "drag, bias"
    planned = run(*arguments, "-o", page).stdout
    assert "principal moment, smallest" in planned
    assert "angular_velocity.bias[0]" in planned
    assert "torque.matrix[0]" in page.read_text("utf-8")


def test_mass_properties_need_a_scale(throws, tmp_path):
    arguments = "identify", *throws, *GYRO, "--mass", "2", "--urdf", tmp_path / "body.urdf"
    result = run(*arguments, "-o", tmp_path / "run", status=2)
    assert "must determine the size of the inertia" in result.stderr
    assert (tmp_path / "run" / "report.html").is_file()


def test_what_is_left_out_is_named_with_the_option_that_allows_for_it(throws, tmp_path):
    files = []
    for file in throws:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        table[:, 1:] += [3.0, -2.0, 4.0]
        files.append(tmp_path / file.name)
        header = "t (s),gx (deg/s),gy (deg/s),gz (deg/s)"
        np.savetxt(files[-1], table, delimiter=",", header=header, comments="")
    result = run("identify", *files, *GYRO, status=3)
    assert "run again with --free angular_velocity.bias as well" in result.stderr
    assert run("identify", *files, *GYRO, "--free", "angular_velocity.bias").stdout.startswith(
        "verdict: the model holds"
    )


def test_a_unit_that_the_file_tells_otherwise_is_a_warning(throws):
    result = run("identify", throws[0], *GYRO, "--unit", "rad/s", status=3)
    assert "lgvi: warning: " in result.stderr
    assert "in rad/s as given (the file says deg/s)" in result.stderr


def test_a_log_with_a_usual_mistake_is_refused(throws, tmp_path):
    """Rates in rad/s, which the header says to be in deg/s."""
    files = []
    for file in throws:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        table[:, 1:] = np.deg2rad(table[:, 1:])
        files.append(tmp_path / file.name)
        header = "t (s),gx (deg/s),gy (deg/s),gz (deg/s)"
        np.savetxt(files[-1], table, delimiter=",", header=header, comments="")
    error = run("identify", *files, *GYRO, status=2).stderr
    assert "a usual mistake: reading the rates, taken for degrees per second, as rad" in error
    assert "`--no-check` fits it as it is" in error


def test_noise_is_not_taken_to_be_what_the_model_leaves_unexplained(tmp_path):
    """An accelerometer away from the centre of mass, whose place is not free."""
    random, files, place = np.random.default_rng(1), [], np.array([0.02, -0.01, 0.03])
    for i in range(6):
        omega = rates_of(random.normal(size=3) * 6)
        alpha = np.cross(MOMENTS * omega, omega) / MOMENTS
        force = np.cross(alpha, place) + np.cross(omega, np.cross(omega, place))
        omega, force = (
            omega + 5e-3 * random.normal(size=(100, 3)),
            force + 0.02 * random.normal(size=(100, 3)),
        )
        files.append(tmp_path / f"throw{i}.csv")
        names = "t (s),gx (rad/s),gy (rad/s),gz (rad/s),ax (m/s²),ay (m/s²),az (m/s²)"
        table = np.column_stack([T, omega, force])
        np.savetxt(files[-1], table, delimiter=",", header=names, comments="", encoding="utf-8")
    arguments = "identify", *files, *GYRO, "--map", "specific_force=ax,ay,az", "--flights", "whole"
    result = run(*arguments, status=3)
    assert "run again with --free specific_force.position" in result.stderr
    assert run(*arguments, "--free", "position").stdout.startswith("verdict: the model holds")


def test_under_thrust_an_accelerometer_needs_the_mass():
    rotor = {"arms": [[0, 0, 0]], "axes": [0, 0, 1], "spin": [1], "thrust": 1e-6, "drag": 1e-8}
    settings = Settings(rotors=rotor, free=["mass", "position"])
    sigma = {"angular_velocity": 0.01, "specific_force": 0.1}
    with pytest.raises(SettingsError, match="--free mass: the mass can be told where there are"):
        add_model(Script(), list(sigma), settings, sigma)
    fixed = dataclasses.replace(settings, free=["position"])
    with pytest.raises(SettingsError, match="over the mass: give the mass in kg by --mass"):
        add_model(Script(), list(sigma), fixed, sigma)
    script = Script()
    script.add("import lgvi\nfrom lgvi import identification\n")
    settings = dataclasses.replace(settings, mass=0.6)
    add_model(script, list(sigma), settings, sigma)
    assert float(script["model"].mass) == 0.6
    assert "model.mass" in free_function(list(sigma), settings)


def test_convert_keeps_the_samples(throws, tmp_path):
    file = tmp_path / "log.parquet"
    run("convert", throws[0], file)
    again = tmp_path / "log.csv"
    run("convert", file, again)
    np.testing.assert_allclose(
        np.loadtxt(again, delimiter=",", skiprows=1),
        np.loadtxt(throws[0], delimiter=",", skiprows=1),
        rtol=1e-14,
    )


INJECTED = "x=1) or open('injected', 'w'"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--read", f"{INJECTED}=1"],
        ["--free", f"rotors.{INJECTED}"],
        ["--free", f"angular_velocity.{INJECTED}"],
        ["--map", f"angular_velocity={INJECTED},b,c"],
        ["--config", "CONFIG"],
    ],
)
def test_words_of_users_are_never_executed(throws, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "run.toml"
    config.write_text(f'[sensors.angular_velocity]\n"{INJECTED}" = 1\n', "utf-8")
    words = [str(config) if word == "CONFIG" else word for word in arguments]
    run("identify", throws[0], *GYRO, *words, status=2)
    assert not (tmp_path / "injected").exists()


def test_the_name_of_a_log_is_no_line_of_the_script(throws, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = Path("throw\nopen('injected', 'w') #.csv")
    file.write_bytes(throws[0].read_bytes())
    run("identify", file, *GYRO, "-o", "out")
    done = subprocess.run([sys.executable, "out/run.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "verdict: the model holds" in done.stdout
    assert not Path("injected").exists()
    run("identify", "--config", "out/run.toml", "--no-cache")


def commands_of(page):
    """The lines of a page that call the command, each with the lines that go on."""
    text = page.read_text("utf-8").replace("\\\n", " ")
    blocks = re.findall(r"^```(?:sh|console)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.splitlines() if line.startswith("lgvi ")]


PAGES = [page for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")) if commands_of(page)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_on_the_pages_have_options_that_there_are(page):
    for line in commands_of(page):
        words = shlex.split(line, comments=True)[1:]
        if words[0].startswith("-"):
            continue
        command = lgvi.commands[words[0]]
        context = click.Context(command, info_name=words[0], resilient_parsing=False)
        command.parse_args(context, words[1:])
