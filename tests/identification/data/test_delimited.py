"""CSV files come back as they are, or are refused with the file, the line and the column."""

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings
from lgvi.identification.data.delimited import Body, read_columns, read_lines

from ...systems import rng
from .csv_oracle import ALPHABET, table
from .csv_oracle import HEADER as OF_RATES
from .csv_oracle import RATES as W

ANY: Any = Recordings
T = np.array([0.0, 0.1, 0.25, 0.3])
HEADER = "t,qw,qx,qy,qz,wx,wy,wz"
Q = ("qw", "qx", "qy", "qz")


def write(path, rows, header=HEADER):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_a_file_comes_back_with_columns_by_name(tmp_path):
    rows = [
        "b, 0.5, 1,0,0,0, 1,2,3",
        "a, 0.0, 0,1,0,0, , , ",  # attitudes are sampled more often than rates
        "b, 0.75, -1,0,0,0, 4,5,6",
        "a, 0.1, 0,0,1,0, 7,8,9",
        "",
        "a, 0.3, 0,0,0,1, , , ",
    ]
    file = write(tmp_path / "log.csv", rows, f"trajectory,{HEADER}")
    found = Recordings.from_csv(file, attitude=Q, angular_velocity=W)
    assert found.names == ("b", "a")
    np.testing.assert_array_equal(found.channels["attitude"].of(1)[0], [0, 0.1, 0.3])
    np.testing.assert_array_equal(found.channels["attitude"].of(1)[1][2], np.diag([-1, -1, 1]))
    np.testing.assert_array_equal(found.channels["angular_velocity"].of(1)[0], [0.1])
    np.testing.assert_array_equal(
        found.channels["angular_velocity"].of(0)[1], [[1, 2, 3], [4, 5, 6]]
    )


def test_a_trajectory_of_a_file_may_lack_a_sensor(tmp_path):
    rows = ["a,0,1,0,0,0,,,", "a,1,1,0,0,0,,,", "b,0,,,,,1,2,3", "b,1,,,,,4,5,6"]
    file = write(tmp_path / "log.csv", rows, f"trajectory,{HEADER}")
    found = Recordings.from_csv(file, attitude=Q, angular_velocity=W)
    np.testing.assert_array_equal(found.channels["attitude"].count, [2, 0])
    np.testing.assert_array_equal(found.channels["angular_velocity"].count, [0, 2])
    assert [samples["attitude"][1].shape for samples in found] == [(2, 3, 3), (0, 3, 3)]


def test_another_name_of_the_column_of_trajectories_is_told(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("Trajectory,t,x,y,z\na,0,1,2,3\nb,1,4,5,6\n", encoding="utf-8")
    rates = ("x", "y", "z")
    with pytest.warns(UserWarning, match=r'`Trajectory` is not read; write `trajectory="Traj'):
        Recordings.from_csv(file, angular_velocity=rates)


def test_a_file_of_matrices_needs_no_trajectory(tmp_path):
    R = Rotation.random(4, rng=rng(70)).as_matrix()
    header = "time," + ",".join(f"r{i}" for i in range(9))
    rows = [",".join(map(repr, map(float, [t, *r.ravel()]))) for t, r in zip(T, R, strict=True)]
    file = write(tmp_path / "log.csv", rows, header)
    found = Recordings.from_csv(file, attitude=header.split(",")[1:], t="time")
    np.testing.assert_allclose(found.channels["attitude"].value[0], R, atol=1e-15)


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ([], HEADER, "line 2, column `t`: there is no sample"),
        (["0,1,0,0,0"], "t,qw,qx,qy", "line 1, column `qz`: must be there once"),
        (["0,1,0,0,0"], "t,qw,qw,qx,qy,qz", "line 1, column `qw`: must be there once"),
        (["0,1,0,0,0,0"], "t,qw,qx,qy,qz", "line 2, column `6`: has no name"),
        (["0,1,0,0,0", "1,1,0,0"], "t,qw,qx,qy,qz", "line 3, column `qz`: is missing"),
        (["0,1,0,{zero},{"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number.*{zero}"),
        (["0,1,0,zero,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number.*'zero'"),
        (["0,1,0,,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number, but is empty"),
        (["0,1,0,0_0,0"], "t,qw,qx,qy,qz", "line 2, column `qy`: must be a number, but is '0_0'"),
        (["0,1,0,0,0"], "Time,qw,qx,qy,qz", 'line 1, column `t`: must .*; write `t="Time"` if'),
        (["t,qw,qx,qy,qz", "0,1,0,0,0"], "# one, two", "line 1, .*; write `comment='#'` if"),
        (["0,1,0,0,0", "1,1,0,0,x" + 200_000 * "0"], "t,qw,qx,qy,qz", "line 3: must be CSV, but"),
        (["0,1,0,0,0", '1,1,0,0,"0', "2,1,0,0,0"], "t,qw,qx,qy,qz", "line 3: .* never closed"),
        (["0,1,0,0,0", '1,1,0,0,"0', '2,1,0,0,"0'], "t,qw,qx,qy,qz", "line 4: must be CSV, but"),
        (
            ['""a,0,1,0,0,0', '""a,1,1,0,0,0'],
            "trajectory,t,qw,qx,qy,qz",
            "line 2: must be CSV, but",
        ),
        (["1.7e9,1,0,0,0", "1700000000.00001,1,0,0,0"], "t,qw,qx,qy,qz", "line 3, .* told apart"),
        (["0,1,0,0,\N{ARABIC-INDIC DIGIT ONE}"], "t,qw,qx,qy,qz", "line 2, column `qz`: must be a"),
        (["0,1,0,0,nan"], "t,qw,qx,qy,qz", "line 2, column `qz`: must be finite"),
        (["0,1,0,0,0", "", "0,1,0,0,0"], "t,qw,qx,qy,qz", "line 4, column `t`: must increase"),
        (["0,1,0,0,0.1"], "t,qw,qx,qy,qz", "line 2, column `qw,qx,qy,qz`: must have length 1"),
    ],
)
def test_a_bad_file_is_refused_with_line_and_column(rows, header, message, tmp_path):
    file = write(tmp_path / "log.csv", rows, header)
    with pytest.raises(ValueError, match=f"log.csv, {message}"):
        Recordings.from_csv(file, attitude=Q)


def test_a_file_that_is_no_text_or_wants_other_columns_is_refused(tmp_path):
    file = tmp_path / "log.csv"
    file.write_bytes(b"t,qw\n\xff\xfe")
    with pytest.raises(ValueError, match=r"log.csv, line 2: must be text in UTF-8"):
        Recordings.from_csv(file, attitude=Q)
    with pytest.raises(TypeError, match="`file` must be the path of a file, but is None"):
        ANY.from_csv(None, attitude=Q)
    for names in (W, 5, "qw", ("qw", "qx", "qx", "qz"), (1, 2, 3, -1), (1, 2, 3, True)):
        with pytest.raises(ValueError, match="`attitude` must name 4 or 9 different columns"):
            ANY.from_csv(file, attitude=names)
    write(file, ["0,1,0,0,0", "1,1,0,0,0"], "t,qw,qx,qy,qz")
    assert Recordings.from_csv(file, attitude=Q).names == ("0",)
    with pytest.raises(ValueError, match="line 1, column `toss`: must be there once"):
        Recordings.from_csv(file, attitude=Q, trajectory="toss")
    words = (
        "`angular_velocity` or `specific_force` or `magnetic_field` or `direction` or `position` "
        "or `velocity` must be given"
    )
    with pytest.raises(ValueError, match=f"`attitude` or {words}"):
        Recordings.from_csv(file)
    write(file, ["0,1,0,0,0"], "t,qw,qx,qy,qz")
    with pytest.raises(ValueError, match=r"log\.csv: Trajectory '0' must have two samples"):
        Recordings.from_csv(file, attitude=Q)


def test_options_that_logs_need(tmp_path):
    rows = ["#a comment", "1500000;1;0;0", "  # another", "1750000;2;0;0", "2000000;3;0;0"]
    file = write(tmp_path / "log.csv", rows, "# made by a logger\n\nstamp;wx;wy;wz")
    given: Any = {"t": "stamp", "time_unit": "us", "delimiter": ";", "comment": "#"}
    found = Recordings.from_csv(file, angular_velocity=W, **given).channels["angular_velocity"]
    np.testing.assert_array_equal(found.times, [1.5, 1.75, 2.0])
    np.testing.assert_array_equal(found.values[:, 0], [1, 2, 3])
    with pytest.raises(ValueError, match="line 4, column `wx`: is missing: the line ends"):
        Recordings.from_csv(
            write(file, rows, "stamp;wx;wy;wz\n\n"), **given | {"comment": None}, angular_velocity=W
        )
    for name, value, message in (
        ("time_unit", "h", r"`time_unit` must be one of 's', 'ms', 'us', 'ns', 'min', but is 'h'"),
        ("duplicates", "last", "`duplicates` must be one of 'error', 'first', 'mean', but"),
        ("delimiter", ",,", "`delimiter` must be one of ',', ';'"),
        ("delimiter", None, "`delimiter` must be one of"),
        ("decimal", ";", "`decimal` must be one of '.', ',', but is ';'"),
        ("decimal", ",", "`decimal` must not be the `delimiter`"),
        (
            "missing",
            "NaN",
            r"`missing` must have the cells .* such as \('NaN', '-'\), but is 'NaN'",
        ),
        ("skip_lines", -1, "`skip_lines` must be at least 0, but is -1"),
        *(
            ("comment", mark, "`comment` must be what a comment begins with")
            for mark in ("", "-", "1", ",", '"', 5)
        ),
    ):
        with pytest.raises((ValueError, TypeError), match=message):
            ANY.from_csv(file, angular_velocity=W, **{name: value})
    with pytest.raises(ValueError, match=r"line 1, column `t`: .*; write `delimiter=';'` if"):
        Recordings.from_csv(write(file, rows[1:], "t;wx;wy;wz"), angular_velocity=W)


RATES = [[1, 7, 8], [2, 7, 9], [3.5, 7, 8]]
WRITTEN = {
    "header in a comment, spaces": (
        "# t  x y z temperature\n0.0 1.0  7 8 20 \n 0.1\t2 7 9 20\n0.2 3.5 7 8 20  \n",
        {"delimiter": " "},
    ),
    "comments and a header in the last": (
        "% by a logger\n%t x y z\n\n0.0 1.0 7 8\n% break\n0.1 2 7 9\n0.2 3.5 7 8\n",
        {"delimiter": " ", "comment": "%"},
    ),
    "column with the name of a mark": (
        "#,t,x,y,z\n0,0.0,1.0,7,8\n1,0.1,2,7,9\n2,0.2,3.5,7,8\n",
        {},
    ),
    "mark before the time": ("#t,x,y,z\n0.0,1.0,7,8\n0.1,2,7,9\n0.2,3.5,7,8\n", {}),
    "mark in the name": (
        "#t,x,y,z\n0.0,1.0,7,8\n0.1,2,7,9\n0.2,3.5,7,8\n",
        {"t": "#t"},
    ),
    "decimal comma": (
        "t;x;y;z\n0,0;1,0;7;8\n0,1;2;7;9\n0,2;3,5;7;8\n",
        {"delimiter": ";", "decimal": ","},
    ),
    "words for what is missing": (
        "t,x,y,z\n0.0,1.0,7,8\n0.05,NaN, - ,NA\n0.1,2,7,9\n0.2,3.5,7,8\n",
        {"missing": ["NaN", "NA", "null", "-"]},
    ),
    "lines before the header, one of which is no text of cells": (
        'device "7\n\nt,x,y,z\n0.0,1.0,7,8\n0.1,2,7,9\n0.2,3.5,7,8\n',
        {"skip_lines": 2},
    ),
    "numbers of columns, no header": (
        "\n9,1.0,7,0.0,8\n9,2,7,0.1,9\n9,3.5,7,0.2,8\n",
        {"t": 3, "angular_velocity": (1, 2, 4)},
    ),
    "numbers of columns, header and units": (
        "t,x,y,x\ns,deg/s,deg/s,deg/s\n0.0,1.0,7,8\n0.1,2,7,9\n0.2,3.5,7,8\n",
        {"t": 0, "angular_velocity": (1, 2, 3), "skip_lines": 2},
    ),
    "numbers of columns under a header": (
        "a,x,y,x\n0.0,1.0,7,8\n0.1,2,7,9\n0.2,3.5,7,8\n",
        {"t": 0, "angular_velocity": (1, 2, 3)},
    ),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("text", "options"), WRITTEN.values(), ids=WRITTEN)
def test_ordinary_logs_are_read(text, options, encoding, tmp_path):
    file = tmp_path / "log.csv"
    options = {"angular_velocity": ("x", "y", "z"), **options}
    for end in ("\n", "\r\n", "\r"):
        file.write_bytes(text.replace("\n", end).encode(encoding))
        rates = Recordings.from_csv(file, **options).channels["angular_velocity"]
        np.testing.assert_array_equal(rates.times, [0.0, 0.1, 0.2])
        np.testing.assert_array_equal(rates.values, RATES)
    # Line by line too, which a line that is out of the ordinary asks for.
    write(file, [], re.sub(r"3[.,]5", "oh", text))
    with pytest.raises(ValueError, match=r"line \d+, column `.`: must be a number, but is 'oh'"):
        Recordings.from_csv(file, **options)


HINTS = {
    "quoted header": ('"t";"wx";"wy";"wz"\n0;1;2;3\n', {}, "1: .*; write `delimiter=';'` if"),
    "mark before the time": ("#timestamp,wx,wy,wz\n", {}, '`t`: .*; write `t="timestamp"` if'),
    "another mark": ("%time,wx,wy,wz\n", {}, '`t`: .*; write `t="time"` if that is'),
    "unit of the time": ("Time (s),wx,wy,wz\n", {}, r'; write `t="Time \(s\)"` if that is'),
    "glued unit": ("TimeUS,wx,wy,wz\n", {}, '; write `t="TimeUS", time_unit="us"` if'),
    "units": ("t,wx,wy,wz\ns,rad/s,rad/s,rad/s\n0,1,2,3\n", {}, "line 2, .*with `skip_lines=2`"),
    "header again": (
        "t,wx,wy,wz\n0,1,2,3\nt,wx,wy,wz\n",
        {},
        "line 3, .*repeats the header: .*`conc",
    ),
    "no number": ("t,wx,wy,wz\n0,1,2,NaN\n", {}, r"2, column `wz`: .*write `missing=\('NaN',\)`"),
    "decimal comma": (
        "t;wx;wy;wz\n0;1;2,5;3\n",
        {"delimiter": ";"},
        "`wy`: .*; write `decimal=','`",
    ),
    "spaces": ("t wx wy wz\n0 1 2 3\n", {}, r"; write `delimiter=' '` if spaces"),
    "other letters": ("t,WX,wy,wz\n0,1,2,3\n", {}, "column `wx`: .*; it has 'WX'"),
    "lines before": ("Device 5\nFs=100\nt,wx,wy,wz\n0,1,2,3\n", {}, "line 3 is: .*`skip_lines=2`"),
    "comment": ("t,wx,wy,wz\n0,1,2,3\n# start\n", {}, "3, .*; write `comment='#'` if the line"),
    "long cell": ("t,wx,wy,wz\n0,1,2," + 99 * "x" + "\n", {}, r"is 'x{40}\.\.\.'$"),
    "length": (
        "t,a,b,c,d\n0,2,0,0,0\n",
        {"angular_velocity": None, "attitude": tuple("abcd")},
        "must have length 1, but has 2; `normalise=True` takes",
    ),
    "no such column": (
        "t,a\n0,1\n",
        {"angular_velocity": (0, 1, 2)},
        "column `2`: must be there, co",
    ),
}


@pytest.mark.parametrize(("text", "options", "words"), HINTS.values(), ids=HINTS)
def test_errors_name_the_option_that_helps(text, options, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        Recordings.from_csv(
            write(tmp_path / "log.csv", [], text), **{"angular_velocity": W, **options}
        )


def test_a_unit_in_the_name_of_the_time_is_compared(tmp_path):
    rows = ["0,1,2,3", "1,1,2,3"]
    for name in ("TimeUS", "time_us", "t [us]", "Time (us)", "t [µs]", "time_usec", "t/us"):
        file = write(tmp_path / "log.csv", rows, f"{name},wx,wy,wz")
        with pytest.warns(UserWarning, match="says us, but `time_unit` is 's'"):
            Recordings.from_csv(file, t=name, angular_velocity=W)
        with pytest.warns(UserWarning, match="says us, but `time_unit` is 'ms'"):
            Recordings.from_csv(file, t=0, time_unit="ms", angular_velocity=W)
        Recordings.from_csv(file, t=name, time_unit="us", angular_velocity=W)
    for name in ("TIME_MS", "Time (MS)", "time.ms", "time ms", "Time_MSEC"):
        file = write(tmp_path / "log.csv", rows, f"{name},wx,wy,wz")
        with pytest.warns(UserWarning, match="says ms, but `time_unit` is 's'"):
            Recordings.from_csv(file, t=name, angular_velocity=W)
    for name in ("times", "TIMES", "t", "status"):
        file = write(tmp_path / "log.csv", rows, f"{name},wx,wy,wz")
        Recordings.from_csv(file, t=name, time_unit="ms", angular_velocity=W)


def test_a_unit_in_the_name_of_a_column_is_compared(tmp_path):
    rows = ["0,1,2,3", "1,1,2,3"]
    for channel, unit, names in (
        ("angular_velocity", "deg/s", ["wx (deg/s)", "wy (deg/s)", "wz (deg/s)"]),
        ("angular_velocity", "deg/s", ["gx_dps", "gy_dps", "gz_dps"]),
        ("angular_velocity", "rpm", ["gx rpm", "gy rpm", "gz rpm"]),
        ("angular_velocity", "deg/s", ["x [deg s^-1]", "y [deg s^-1]", "z [deg s^-1]"]),
        ("position", "mm", ["x_mm", "y_mm", "z_mm"]),
        ("position", "mm", ["x (millimeters)", "y (millimeters)", "z (millimeters)"]),
        ("specific_force", "g", ["ax [g]", "ay [g]", "az [g]"]),
    ):
        file = write(tmp_path / "log.csv", rows, ",".join(["t", *names]))
        options: Any = {channel: names}
        with pytest.warns(UserWarning, match=f"says {unit}, but the unit of `{channel}` is '"):
            Recordings.from_csv(file, **options)
        Recordings.from_csv(file, **options, units={channel: unit})
    file = write(tmp_path / "log.csv", rows, "t,x_g,y_g,z_mm")
    Recordings.from_csv(file, angular_velocity=("x_g", "y_g", "z_mm"))


def test_samples_of_the_same_time(tmp_path):
    rows = [
        "0,1,0,0,0,1,2,3",
        "1,0,1,0,0,,,",
        "1,0,-1,0,0,5,5,5",
        "1,0,1,0,0,7,7,7",
        "2,0,0,1,0,0,0,0",
    ]
    file = write(tmp_path / "log.csv", rows)
    columns: Any = {"attitude": Q, "angular_velocity": W}
    with pytest.raises(
        ValueError,
        match=r"line 4, column `t`: must increase .*, but 1 follows 1; `duplicates=` says",
    ):
        Recordings.from_csv(file, **columns)
    R = [np.eye(3), np.diag([1, -1, -1]), np.diag([-1, 1, -1])]
    for duplicates, rate in (("first", 5), ("mean", 6)):
        found = ANY.from_csv(file, duplicates=duplicates, **columns)
        np.testing.assert_array_equal(found.channels["attitude"].times, [0, 1, 2])
        np.testing.assert_allclose(found.channels["attitude"].values, R, atol=1e-15)
        np.testing.assert_array_equal(
            found.channels["angular_velocity"].values, [[1, 2, 3], [rate] * 3, [0, 0, 0]]
        )
        assert [words[:21] for words in found.dropped] == [
            "2 samples of attitude",
            "1 sample of angular v",
        ]
    apart = ["0,1,0,0,0", "1,0,1,0,0", "", "1,0,0,1,0"]
    file = write(file, apart, "t,qw,qx,qy,qz")
    with pytest.raises(ValueError, match="line 3, column `qw,qx,qy,qz`: must be a rotation matrix"):
        Recordings.from_csv(file, attitude=Q, duplicates="mean")
    file = write(file, ["0,1,2,3", "1,1,2,3", "1,1,2,3", "0,1,2,3"], "t,wx,wy,wz")
    with pytest.raises(ValueError, match=r"line 5, column `t`: .* 0 follows 1; `trajectory=`"):
        Recordings.from_csv(file, angular_velocity=W, duplicates="mean")


LINES = st.lists(
    st.lists(
        st.sampled_from(["", "0", "1", "-2.5", "3e-1", "a", "b", "nan", "1_0", " 4 ", '"5"', "é"]),
        min_size=5,
        max_size=7,
    ).map(",".join),
    min_size=1,
    max_size=5,
)
TEXTS = st.lists(st.sampled_from(ALPHABET), max_size=30).map("".join)
ENDS = st.sampled_from(["\n", "\r\n", "\r"])
FILES = st.one_of(
    st.binary(max_size=40),
    st.builds(lambda body: f"{OF_RATES}\n{body}".encode(), TEXTS),
    st.builds(lambda lines, end: end.join([OF_RATES, *lines]).encode(), LINES, ENDS),
    st.builds(
        lambda a, b, c, end: end.join([OF_RATES, f"0,{a},1,2,3,", f"{b},{a},{c},0,5,"]).encode(),
        TEXTS,
        *2 * [st.floats().map(repr)],
        ENDS,
    ),
)


@settings(max_examples=1000, deadline=None, derandomize=True)
@given(data=FILES)
def test_whatever_bytes_come_they_are_read_right_or_refused_with_their_place(
    data, tmp_path_factory
):
    file = tmp_path_factory.getbasetemp() / "any.csv"
    file.write_bytes(data)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = None
    found, problem = None, ""
    try:
        found = Recordings.from_csv(file, angular_velocity=W)
    except ValueError as error:
        problem = str(error)
    place = rf"{re.escape(str(file))}(, line \d+(, column `|: must be )|: Trajectory )"
    assert found is not None or re.match(place, problem)
    if text is not None and '"' in text:
        return  # The oracle knows no quotation marks.
    expected = None if text is None else table(text)
    assert (found is None) == (expected is None)
    if found is not None and expected is not None:
        assert found.names == tuple(expected)
        for i, samples in enumerate(expected.values()):
            read = np.column_stack(found.channels["angular_velocity"].of(i))
            np.testing.assert_array_equal(read, samples)


@settings(max_examples=500, deadline=None, derandomize=True)
@given(data=FILES)
def test_a_file_says_the_same_at_once_and_line_by_line(data):
    try:
        data.decode()
    except UnicodeDecodeError:
        return
    header = OF_RATES.split(",")
    body = Body(lambda: data, header, 1, ",", {"t": 0, "wx": 2, "wy": 3, "wz": 4}, trajectory=1)
    if (at_once := read_columns(body)) is None:
        return
    by_line = read_lines(body)
    assert at_once.trajectories == by_line.trajectories
    np.testing.assert_array_equal(at_once.trajectory, by_line.trajectory)
    for name in body.numbers:
        np.testing.assert_array_equal(at_once.empty[name], by_line.empty[name])
        np.testing.assert_array_equal(at_once.numbers[name], by_line.numbers[name])


def test_trajectories_of_a_long_file_keep_their_order_and_every_digit(tmp_path):
    values = rng(71).normal(size=(40_000, 3)) * 10.0 ** rng(72).integers(-300, 300, (40_000, 1))
    which = rng(73).integers(300, size=40_000)
    rows = [
        f"{i},toss {j},{x!r},{y!r},{z!r}"
        for i, (j, (x, y, z)) in enumerate(zip(which, values.tolist(), strict=True))
    ]
    file = write(tmp_path / "log.csv", rows, "t,trajectory,wx,wy,wz")
    assert file.stat().st_size > 2**21  # several blocks of the reader
    found = Recordings.from_csv(file, angular_velocity=W)
    assert found.names == tuple(f"toss {j}" for j in dict.fromkeys(which))
    for i, j in enumerate(dict.fromkeys(which)):
        t, rates = found.channels["angular_velocity"].of(i)
        np.testing.assert_array_equal(t, np.flatnonzero(which == j))
        np.testing.assert_array_equal(rates, values[which == j])


def test_times_that_do_not_increase_are_told_with_all_their_digits(tmp_path):
    rows = ["1609060336.7700002,1,2,3", "1609060336.77,1,2,3"]
    file = write(tmp_path / "log.csv", rows, "t,wx,wy,wz")
    with pytest.raises(ValueError, match=r"but 1609060336\.77 follows 1609060336\.7700002;"):
        Recordings.from_csv(file, angular_velocity=W)


def test_units_of_a_file_are_those_of_the_library_after_it(tmp_path):
    file = write(tmp_path / "log.csv", ["0,1,-2,3", "1,4,5,6"], "t,x,y,z")
    values, columns = np.array([[1, -2, 3], [4, 5, 6]]), ("x", "y", "z")
    for channel, unit, factor in (
        ("angular_velocity", "rad/s", 1),
        ("angular_velocity", "deg/s", np.pi / 180),
        ("angular_velocity", "rpm", np.pi / 30),
        ("angular_velocity", "rev/s", 2 * np.pi),
        ("position", "mm", 1e-3),
        ("position", "cm", 1e-2),
        ("specific_force", "g", 9.80665),
        ("magnetic_field", "uT", 1e-6),
        ("magnetic_field", "G", 1e-4),
    ):
        options: Any = {channel: columns, "units": {channel: unit}}
        found = Recordings.from_csv(file, **options)
        np.testing.assert_allclose(found.channels[channel].values, factor * values, rtol=1e-15)
    twice = write(tmp_path / "twice.csv", ["0,1,2,3", "0,3,2,3", "1,4,5,6"], "t,x,y,z")
    options = {"units": {"angular_velocity": "deg/s"}, "duplicates": "mean"}
    found = Recordings.from_csv(twice, angular_velocity=columns, **options)
    np.testing.assert_allclose(np.rad2deg(found.channels["angular_velocity"].values[0]), [2, 2, 3])
    for units, words in (
        ({"angular_velocity": "m"}, "give 'rad/s' or 'deg/s' or .* for `angular_velocity`, but"),
        ({"position": "mm"}, "units of some of `angular_velocity`, but is {'position': 'mm'}"),
        ("deg/s", "units of some of `angular_velocity`, but is 'deg/s'"),
    ):
        with pytest.raises(ValueError, match=f"`units` must .*{words}"):
            ANY.from_csv(file, angular_velocity=columns, units=units)


@pytest.mark.parametrize("order", ["wxyz", "xyzw", "rotation_vector", "ZYX", "matrix"])
def test_attitudes_are_read_in_the_direction_that_is_named(order, tmp_path):
    R = Rotation.random(3, rng=rng(75))
    numbers = {
        "wxyz": R.as_quat(scalar_first=True),
        "xyzw": R.as_quat(),
        "rotation_vector": R.as_rotvec(),
        "ZYX": R.as_euler("ZYX"),
        "matrix": R.as_matrix().reshape(-1, 9),
    }[order]
    names = list("abcdefghi"[: numbers.shape[1]])
    rows = [",".join(map(repr, map(float, [t, *x]))) for t, x in zip(T, numbers, strict=False)]
    file = write(tmp_path / "log.csv", rows, ",".join(["t", *names]))
    options: Any = {"attitude": names, "attitude_order": "wxyz" if order == "matrix" else order}
    found = Recordings.from_csv(file, **options, attitude_direction="space to body")
    expected = R.inv().as_matrix()
    np.testing.assert_allclose(found.channels["attitude"].values, expected, atol=1e-14)
    with pytest.raises(ValueError, match=r"`attitude_direction` must be one of 'body to space', "):
        ANY.from_csv(file, **options, attitude_direction="inverse")


@pytest.mark.parametrize("order", ["wxyz", "xyzw", "rotation_vector", "ZYX", "xyz", "zxz"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_attitudes_are_read_in_the_order_that_is_named(order, unit, tmp_path):
    R = Rotation.random(4, rng=rng(74))
    numbers = {
        "wxyz": R.as_quat(scalar_first=True),
        "xyzw": R.as_quat(),
        "rotation_vector": R.as_rotvec(),
    }.get(order, R.as_euler(order if len(order) == 3 else "xyz"))
    names = list("abcd"[: numbers.shape[1]])
    options: Any = {"attitude": names, "attitude_order": order}
    if unit == "deg":
        numbers, options["units"] = np.rad2deg(numbers), {"attitude": "deg"}
    rows = [",".join(map(repr, map(float, [t, *x]))) for t, x in zip(T, numbers, strict=True)]
    file = write(tmp_path / "log.csv", rows, ",".join(["t", *names]))
    if unit == "deg" and len(names) == 4:
        with pytest.raises(ValueError, match=r"`units` must give no unit, .* for `attitude`"):
            Recordings.from_csv(file, **options)
        return
    found = Recordings.from_csv(file, **options)
    np.testing.assert_allclose(found.channels["attitude"].values, R.as_matrix(), atol=1e-14)


def test_quaternions_of_any_length_are_taken_on_request_and_counted(tmp_path):
    rows = ["0,2,0,0,0", "1,0,1.0005,0,0", "2,0,-0.5,0,0"]
    file = write(tmp_path / "log.csv", rows, "t,qw,qx,qy,qz")
    with pytest.raises(ValueError, match=r"line 2, .* must have length 1, but has 2"):
        Recordings.from_csv(file, attitude=Q)
    found = Recordings.from_csv(file, attitude=Q, normalise=True)
    assert found.dropped == ("2 samples of attitude (normalised)",)
    np.testing.assert_allclose(found.channels["attitude"].values[2], np.diag([1, -1, -1]))
    file = write(tmp_path / "log.csv", ["0,0,0,0,0", "1,1,0,0,0"], "t,qw,qx,qy,qz")
    with pytest.raises(ValueError, match=r"line 2, .* must have length 1, but has 0"):
        Recordings.from_csv(file, attitude=Q, normalise=True)
    for order in ("wyxz", "xxy", "xYz", None, 4):
        with pytest.raises(ValueError, match=r"`attitude_order` must be 'wxyz', .*, but is "):
            ANY.from_csv(file, attitude=Q, attitude_order=order)
    with pytest.raises(TypeError, match="`normalise` must be True or False, but is 1"):
        ANY.from_csv(file, attitude=Q, normalise=1)
    with pytest.raises(ValueError, match="`attitude` must name 3 different columns"):
        Recordings.from_csv(file, attitude=Q, attitude_order="ZYX")


def test_the_first_line_is_no_header_where_a_cell_has_a_number(tmp_path):
    options: Any = {"t": 0, "trajectory": 1, "angular_velocity": (2, 3, 4)}
    file = write(tmp_path / "log.csv", ["1,a,4,5,6", "2,a,7,8,9"], "0,a,1,2,3")
    rates = Recordings.from_csv(file, **options).channels["angular_velocity"]
    np.testing.assert_array_equal(rates.times, [0, 1, 2])
    for first in ("0,a,1x,2,3", "x0,a,1,2,3", "0,a,nan,nan,nan", "0,a,-,-,-"):
        file = write(file, ["1,a,4,5,6", "2,a,7,8,9"], first)
        with pytest.raises(ValueError, match=r"line 1, column `.`: must be "):
            Recordings.from_csv(file, **options)


def test_a_title_before_the_names_in_a_comment_is_no_column(tmp_path):
    options: Any = {"comment": "#", "delimiter": " ", "angular_velocity": ("x", "y", "z")}
    file = write(tmp_path / "log.csv", ["0 1 2 3", "1 4 5 6"], "# columns: t x y z")
    found = Recordings.from_csv(file, **options).channels["angular_velocity"]
    np.testing.assert_array_equal(found.times, [0, 1])
    write(file, ["0 1 2 3 5", "1 4 5 6 5"], "# columns: t x y z")
    with pytest.raises(ValueError, match="column `5`: has no name in the header"):
        Recordings.from_csv(file, **options)


def test_what_is_skipped_or_a_comment_may_be_no_text(tmp_path):
    file = tmp_path / "log.csv"
    file.write_bytes(b"Temp \xb0C\n# Temp \xb0C\nt,wx,wy,wz\n0,1,2,3\n1,1,2,3\n")
    found = Recordings.from_csv(file, angular_velocity=W, comment="#", skip_lines=1)
    np.testing.assert_array_equal(found.channels["angular_velocity"].times, [0, 1])
    with pytest.raises(ValueError, match="line 1: must be text in UTF-8, but its byte 6 is not"):
        Recordings.from_csv(file, angular_velocity=W, comment="#")


def test_the_mean_of_attitudes_is_the_rotation_nearest_to_it(tmp_path):
    turns = [0.0, 0.0, 0.8, 1.5]  # rad, about one axis
    q = Rotation.from_rotvec(np.outer(turns, [0.6, 0, 0.8])).as_quat(scalar_first=True)
    rows = [",".join(map(repr, map(float, [t, *x]))) for t, x in zip([0, 1, 1, 2], q, strict=True)]
    file = write(tmp_path / "log.csv", rows, "t,qw,qx,qy,qz")
    found = Recordings.from_csv(file, attitude=Q, duplicates="mean").channels["attitude"]
    expected = Rotation.from_rotvec(np.outer([0, 0.4, 1.5], [0.6, 0, 0.8])).as_matrix()
    np.testing.assert_allclose(found.values, expected, atol=1e-14)
