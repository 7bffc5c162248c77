"""MAT files: variables and structures become signals; objects and damage are told in words."""

import struct
import sys
import zlib

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_array

from lgvi.logs import LogError
from lgvi.logs import read as read_log
from lgvi.logs.matlab import read

from .damages import check_damages, limited

TIMES = 0.01 * np.arange(50)
RATES = np.random.default_rng(0).normal(size=(50, 3))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.mat"


VARIABLES = {
    "imu": {"t": TIMES[:, None], "gyro": RATES, "name": "A7 Größe µ 🚁", "rate": 100.0},
    "mocap": {"time_us": np.arange(30.0) * 5000, "q": np.ones((4, 30))},
}


def save(path, variables, **options):
    savemat(path, variables, **options)
    return path


def save_new(path, variables):
    """Version 7.3 by its layout: HDF5 after 512 bytes, arrays with their dimensions reversed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        put(file, file, variables)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    return path


def put(file, group, variables):
    for name, value in variables.items():
        if isinstance(value, dict):
            put(file, group.create_group(name), value)
            kind = "struct"
        elif isinstance(value, (list, tuple)):
            parts = file.require_group("#refs#")
            key = f"part{len(parts)}"
            put(file, parts, {f"{key}_{i}": part for i, part in enumerate(value)})
            references = [parts[f"{key}_{i}"].ref for i in range(len(value))]
            group.create_dataset(name, data=np.array([references], h5py.ref_dtype))
            if isinstance(value, list):  # a field of an array of structures
                continue
            kind = "cell"
        elif isinstance(value, str):
            group[name] = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            kind = "char"
        else:
            group[name] = np.atleast_2d(value).T
            kind = "double"
        group[name].attrs["MATLAB_class"] = np.bytes_(kind)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: save(path, VARIABLES),
        lambda path: save(path, VARIABLES, do_compression=True),
        lambda path: save_new(path, VARIABLES),
    ],
    ids=["5", "7", "7.3"],
)
def test_structures_are_groups(path, write):
    write(path)
    log = read_log(path)
    assert log.kind == "MATLAB"
    gyroscope = log.signals["imu.gyro"]
    np.testing.assert_array_equal(gyroscope.times, TIMES)
    np.testing.assert_array_equal(gyroscope.values, RATES)
    assert (gyroscope.unit, gyroscope.frame) == ("", "")
    assert log.signals["mocap.q"].values.shape == (30, 4)
    np.testing.assert_array_equal(log.signals["mocap.q"].times, np.arange(30) / 200)
    assert log.facts == {"imu.name": "A7 Größe µ 🚁", "imu.rate": "100.0"}
    assert "The times are `imu.t`, in s, `mocap.time_us`, in us." in log.assumed


def test_version_4_is_refused(path):
    with pytest.raises(LogError, match="byte 124: must be a MAT file of version 5"):
        read(save(path, VARIABLES["imu"] | {"name": 1.0}, format="4"))


def in_objects(values):
    parts = np.empty(len(values), object)
    parts[:] = values
    return parts


@pytest.mark.parametrize("write", [save, save_new], ids=["5", "7.3"])
def test_times_of_simulink(path, write):
    """A structure with time, and an array of structures with the values of each port."""
    matrices = np.random.default_rng(1).normal(size=(50, 3, 3))
    parts = [RATES, np.moveaxis(matrices, 0, -1)]
    signals = {"values": parts, "label": ["rates", "attitude"]}
    if write is save:
        kind = [("values", "O"), ("label", "O")]
        signals = np.array(list(zip(*signals.values(), strict=True)), kind)
    log = read(write(path, {"out": {"time": TIMES, "signals": signals}}))
    np.testing.assert_array_equal(log.signals["out.signals[0].values"].values, RATES)
    rows = log.signals["out.signals[1].values"].values
    np.testing.assert_array_equal(rows, matrices.reshape(50, 9))
    assert log.facts["out.signals[1].label"] == "attitude"


@pytest.mark.parametrize("write", [save, save_new], ids=["5", "7.3"])
def test_cells(path, write):
    parts = RATES[:, :2], "two"
    cell = in_objects(parts) if write is save else parts
    log = read(write(path, {"t": TIMES, "parts": cell}))
    np.testing.assert_array_equal(log.signals["parts[0]"].values, RATES[:, :2])
    assert log.facts == {"parts[1]": "two"}


@pytest.mark.parametrize("write", [save, save_new], ids=["5", "7.3"])
def test_the_parts_that_are_too_many_are_told(path, write):
    parts = [*RATES.T] * 40
    log = read(
        write(path, {"t": TIMES, "parts": in_objects(parts) if write is save else (*parts,)})
    )
    assert len(log.signals) == 100
    assert log.assumed[0] == "Left out: `parts` (parts from number 100 on)."


def test_numbers_are_read_whatever_their_kind(path):
    kinds = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8", "?"]
    columns = {f"x{kind.strip('?')}": (np.arange(50) % 2).astype(kind) for kind in kinds}
    columns["words"] = np.array(["one", "two"])
    others = {"z": RATES + 1j, "sparse": csc_array((5000, 5000))}
    log = read(save(path, {"t": TIMES} | columns | others))
    assert (log.facts["words[0]"], log.facts["words[1]"]) == ("one", "two")
    assert len(log.signals) == len(kinds)
    for name in log.signals:
        np.testing.assert_array_equal(log.signals[name].values, np.arange(50) % 2)
    assert log.assumed[0] == "Left out: `z` (complex numbers), `sparse` (sparse matrix)."
    with pytest.raises(LogError, match=r"`t` \(1, 50\): .*Left out: `z` \(complex numbers\)"):
        read(save(path, {"t": TIMES, "z": RATES + 1j}))


def test_times_and_their_unit_may_be_told(path):
    save(path, {"clock": np.arange(50), "imu": {"gyro": RATES}})
    with pytest.raises(LogError, match=r"the times \(none\) and the arrays `clock` \(1, 50\)"):
        read(path)
    log = read(path, time={"imu": "clock"}, time_unit="ms")
    np.testing.assert_array_equal(log.signals["imu.gyro"].times, np.arange(50) / 1000)


def test_objects_are_named_with_what_to_save_instead(path):
    with h5py.File(save_new(path, {"imu": VARIABLES["imu"]}), "a") as file:
        for name in ("flight", "imu/flight"):
            file[name] = np.zeros(6, np.uint32)
            file[name].attrs["MATLAB_class"] = np.bytes_("timetable")
    log = read(path)
    assert set(log.signals) == {"imu.gyro"}
    words = "Left out: `flight` (timetable), `imu.flight` (timetable); objects"
    assert log.assumed[0].startswith(words)
    with h5py.File(path, "a") as file:
        del file["imu"]
    with pytest.raises(LogError, match=r"must have arrays, but has `flight` \(timetable\); obj"):
        read(path)


def test_objects_of_version_7_are_named(path):
    """By their layout: name, system, class."""
    words = [b"flight", b"MCOS", b"timetable"]
    texts = [struct.pack("<2I", 1, len(word)) + word + bytes(-len(word) % 8) for word in words]
    body = struct.pack("<4I", 6, 8, 17, 0) + b"".join(texts)
    variable = struct.pack("<2I", 14, len(body)) + body
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + variable)
    with pytest.raises(LogError, match=r"must have arrays, but has `flight` \(timetable\); obj"):
        read(path)


def compressed(path, variable, size=0):
    """A file with one compressed variable, of which the last numbers are zeros."""
    squeezer = zlib.compressobj()
    parts = [squeezer.compress(variable)]
    parts += [squeezer.compress(bytes(10**6)) for _ in range(size // 10**6)]
    content = b"".join([*parts, squeezer.flush()])
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM")
    with open(path, "ab") as file:
        file.write(struct.pack("<2I", 15, len(content)) + content)
    return path


def variable_of(name, size):
    """All of a variable but its numbers."""
    body = struct.pack("<4I2I2i", 6, 8, 6, 0, 5, 8, size // 8, 1)
    body += struct.pack("<2H4s", 1, 1, name) + struct.pack("<2I", 9, size)
    return struct.pack("<2I", 14, len(body) + size) + body


def test_a_compressed_bomb_is_refused(path, monkeypatch):
    size = 400_000_000
    compressed(path, variable_of(b"t", size), size)
    assert path.stat().st_size < 500_000
    monkeypatch.setattr("lgvi.logs.columns.MOST_BYTES", 10**7)
    monkeypatch.setattr("lgvi.logs.matlab.MOST_BYTES", 10**7)
    with limited(), pytest.raises(LogError, match="must have arrays of less than 1e"):
        read(path)


def test_compressed_variables_without_an_end_are_left_out(path):
    """What is there may be wrong, as the checksum is at the end."""
    compressed(path, variable_of(b"t", 800) + TIMES.tobytes() * 2)
    with pytest.raises(LogError, match=r"the arrays `t` \(100, 1\)"):
        read(path)
    content = path.read_bytes()
    size = struct.pack("<I", len(content) - 136 - 4)
    path.write_bytes(content[:132] + size + content[136:-4])
    with pytest.raises(LogError, match="is compressed, and ends too soon"):
        read(path)


def test_arrays_that_are_not_in_the_file_are_left_out(path, tmp_path):
    with h5py.File(save_new(path, VARIABLES), "a") as file:
        file.create_dataset("nowhere", (10**6, 10**6), "f8")
        file["other"] = h5py.ExternalLink(tmp_path / "other.h5", "x")
    with limited():
        log = read(path)
    assert set(log.signals) == {"imu.gyro", "mocap.q"}
    words = "Left out: `nowhere` (array that is not in the file), `other` (link)"
    assert any(words in told for told in log.assumed)
    with h5py.File(path, "a") as file:
        options = {"chunks": (1000, 1000), "compression": 9}
        file.create_dataset("bomb", (10**6, 10**6), "f8", **options)[0, 0] = 1
    with limited(), pytest.raises(LogError, match="must have arrays of less than"):
        read(path)


def test_arrays_that_are_damaged_are_left_out(path):
    with h5py.File(save_new(path, VARIABLES), "a") as file:
        options = {"chunks": (50,), "fletcher32": True}
        begin = file.create_dataset("x", data=TIMES, **options).id.get_chunk_info(0).byte_offset
        file["cell"] = np.array([h5py.Reference()], h5py.ref_dtype)  # to nothing
    content = bytearray(path.read_bytes())
    content[begin + 20] ^= 255
    path.write_bytes(bytes(content))
    log = read(path)
    assert set(log.signals) == {"imu.gyro", "mocap.q"}
    assert log.assumed[0] == "Left out: `x` (array that is damaged)."


def test_cells_that_hold_each_other_many_times_are_refused(path, monkeypatch):
    monkeypatch.setattr("lgvi.logs.matlab.MOST_ARRAYS", 1000)
    with h5py.File(save_new(path, VARIABLES), "a") as file:
        inner = file.create_dataset("#refs#/0", data=np.ones(10))
        for level in range(1, 12):
            references = np.array([inner.ref] * 10, h5py.ref_dtype)
            inner = file.create_dataset(f"#refs#/{level}", data=references)
            inner.attrs["MATLAB_class"] = np.bytes_("cell")
        file["cell"] = np.array([inner.ref], h5py.ref_dtype)
        file["cell"].attrs["MATLAB_class"] = np.bytes_("cell")
    with limited(), pytest.raises(LogError, match="structures in structures"):
        read(path)


def test_another_file_with_the_ending_is_refused(path):
    path.write_bytes(b"t,x\n" * 100)
    with pytest.raises(LogError, match="byte 124: must be a MAT file"):
        read_log(path)


def variable_of_no_bytes(kind, *dimensions):
    body = struct.pack("<4I2I2i", 6, 8, kind, 0, 5, 8, *dimensions)
    body += struct.pack("<2H4s2Hi2I", 1, 1, b"s", 5, 4, 32, 1, 0)  # its name, and no fields
    return struct.pack("<2I", 14, len(body)) + body


def test_dimensions_that_the_file_cannot_hold_are_refused(path):
    """2^31 structures without a field, and 2^31 empty texts, in 200 bytes."""
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"
    path.write_bytes(head + variable_of_no_bytes(2, 2**31 - 1, 1))
    with limited(), pytest.raises(LogError, match="too few for the dimensions"):
        read(path)
    texts = variable_of_no_bytes(4, 2**31 - 1, 0)[:-8]
    texts = texts[:4] + struct.pack("<I", len(texts) - 8) + texts[8:-8] + struct.pack("<2I", 1, 0)
    with open(save(path, VARIABLES), "ab") as file:
        file.write(texts)
    with limited():
        assert read(path).facts["s"] == ""


def test_a_file_that_is_cut_off_gives_the_variables_that_are_whole(path):
    save(path, VARIABLES)
    path.write_bytes(path.read_bytes()[:-100])
    log = read(path)
    assert set(log.signals) == {"imu.gyro"}
    begin = next(words for words in log.assumed if words.startswith("The file ends in the middle"))
    assert begin.endswith("1 variables were read.")


def test_the_other_order_of_bytes(path):
    """As `save` wrote on computers of other kinds: by its layout."""
    numbers = TIMES.astype(">f8").tobytes()

    def variable(name):
        body = struct.pack(">4I2I2i", 6, 8, 6, 0, 5, 8, 1, 50)
        body += struct.pack(">2H4s", 1, 1, name) + struct.pack(">2I", 9, len(numbers)) + numbers
        return struct.pack(">2I", 14, len(body)) + body

    content = b"MATLAB 5.0 MAT-file".ljust(124) + b"\1\0MI"
    path.write_bytes(content + variable(b"t") + variable(b"x"))
    np.testing.assert_array_equal(read(path).signals["x"].values, TIMES)


def test_the_package_that_is_missing_is_named(path, monkeypatch):
    save_new(path, VARIABLES)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match="need h5py: pip install"):
        read(path)


@pytest.mark.parametrize(
    ("write", "least"),
    [
        (lambda path: save(path, VARIABLES), 50),
        (lambda path: save(path, VARIABLES, do_compression=True), 5),
        (lambda path: save_new(path, VARIABLES), 20),
    ],
    ids=["5", "7", "7.3"],
)
def test_damaged_files(path, write, least):
    write(path)
    logs = check_damages(read, path)
    assert len(logs) > least
