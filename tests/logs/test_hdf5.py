"""HDF5 files: datasets become signals, and neither damage nor false sizes do harm."""

import struct
import sys

import h5py
import numpy as np
import pytest

from lgvi.logs import LogError
from lgvi.logs import read as read_log
from lgvi.logs.hdf5 import read

from .damages import check_damages, limited

TIMES = 0.01 * np.arange(50)
RATES = np.random.default_rng(0).normal(size=(50, 3))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log.h5"


def write(path, **options):
    with h5py.File(path, "w") as file:
        file.attrs["device"] = "logger 7"
        file["imu/t"] = TIMES
        file.create_dataset("imu/gyro", data=RATES, **options)
        file["imu/gyro"].attrs["units"] = "deg/s"
        file["imu/gyro"].attrs["frame"] = np.bytes_(b"FRD")
        file["mocap/time_us"] = np.arange(30, dtype=np.int64) * 5000
        file["mocap/q"] = np.ones((4, 30), np.float32)
    return path


@pytest.mark.parametrize("options", [{}, {"chunks": (10, 3), "compression": "gzip"}])
def test_datasets_are_signals_with_their_attributes(path, options):
    log = read_log(write(path, **options))
    assert log.kind == "HDF5"
    gyroscope = log.signals["imu.gyro"]
    np.testing.assert_array_equal(gyroscope.times, TIMES)
    np.testing.assert_array_equal(gyroscope.values, RATES)
    assert (gyroscope.unit, gyroscope.frame, gyroscope.quantity) == ("deg/s", "FRD", "")
    np.testing.assert_allclose(log.signals["mocap.q"].times, 0.005 * np.arange(30), rtol=1e-15)
    assert log.signals["mocap.q"].values.shape == (30, 4)
    assert log.facts == {"device": "logger 7"}
    assert "The times are `imu.t`, in s, `mocap.time_us`, in us." in log.assumed


@pytest.mark.parametrize("version", ["earliest", "latest"])
@pytest.mark.parametrize("userblock", [0, 512])
def test_attributes_of_all_kinds(path, version, userblock):
    """Texts of fixed and of any length, numbers, many and later ones, in old and new heads."""
    with h5py.File(path, "w", libver=version, userblock_size=userblock) as file:
        file["t_s"], file["x"] = TIMES, TIMES
        for i in range(7):
            file["x"].attrs[f"note{i}"] = "no unit" * (1 + 10 * i)
        file.attrs["device"], file.attrs["serial"] = "logger", np.int32(7)
        file.attrs["limits"] = [1.0, 2.0]
    with h5py.File(path, "a", libver=version) as file:
        file["x"].attrs["unit"] = "µT"
        file["x"].attrs["frame"] = np.bytes_(b"FRD")
    log = read(path)
    assert (log.signals["x"].unit, log.signals["x"].frame) == ("µT", "FRD")
    assert log.facts == {"device": "logger", "serial": "7"}


@pytest.mark.parametrize("length", [2**31, 2**32 - 1])
def test_the_length_of_a_text_is_not_trusted(path, length):
    write(path)
    content = path.read_bytes()
    heap = content.index(b"GCOL")
    descriptor = struct.pack("<IQI", 5, heap, 2)  # of deg/s
    assert content.count(descriptor) == 1
    path.write_bytes(content.replace(descriptor, struct.pack("<I", length) + descriptor[4:]))
    with limited():
        assert read(path).signals["imu.gyro"].unit == "deg/s"


def test_texts_without_size_are_refused(path):
    content = bytearray(write(path).read_bytes())
    heap = content.index(b"GCOL")
    content[heap + 16 : heap + 100] = bytes(84)
    path.write_bytes(bytes(content))
    with limited(), pytest.raises(LogError, match="byte 2048: is damaged: a text in a collection"):
        read(path)


def test_times_and_their_unit_may_be_told(path):
    with h5py.File(path, "w") as file:
        file["imu/clock"] = np.arange(50)
        file["imu/gyro"] = RATES
    log = read_log(path, time="clock", time_unit="ms")
    np.testing.assert_array_equal(log.signals["imu.gyro"].times, np.arange(50) / 1000)
    with pytest.raises(LogError, match="say which are the times"):
        read(path)


def test_the_unit_of_times_may_be_an_attribute(path):
    with h5py.File(path, "w") as file:
        file["t"] = np.arange(50)
        file["t"].attrs["unit"] = "ms"
        file["x"] = np.arange(50)
    np.testing.assert_array_equal(read(path).signals["x"].times, np.arange(50) / 1000)


def test_fields_of_compound_datasets(path):
    inner = [("count", "u1"), ("word", "S4")]
    records = np.zeros(50, [("t", "f8"), ("gyro", "f4", (3,)), ("word", "S4"), ("state", inner)])
    records["t"], records["gyro"], records["state"]["count"] = TIMES, RATES, range(50)
    with h5py.File(path, "w") as file:
        file["imu"] = records
    log = read(path)
    assert set(log.signals) == {"imu.gyro", "imu.state.count"}
    np.testing.assert_array_equal(log.signals["imu.gyro"].values, RATES.astype("f4"))
    np.testing.assert_array_equal(log.signals["imu.state.count"].values, range(50))


def test_text_and_what_is_in_other_files_are_left_out(path, tmp_path):
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["x"] = TIMES
    (tmp_path / "raw").write_bytes(TIMES.tobytes())
    layout = h5py.VirtualLayout(shape=(50,), dtype=float)
    layout[:] = h5py.VirtualSource(other, "x", shape=(50,))
    with h5py.File(write(path), "a") as file:
        file["linked"] = h5py.ExternalLink(other, "x")
        file["soft"] = h5py.SoftLink("/imu/t")
        file["circle"] = file["/"]
        file.create_virtual_dataset("imu/virtual", layout)
        raw = str(tmp_path / "raw"), 0, 400
        file.create_dataset("imu/external", shape=(50,), dtype="f8", external=[raw])
        file["imu/words"] = ["a"] * 50
        file["imu/none"] = h5py.Empty("f8")
    log = read(path)
    assert set(log.signals) == {"imu.gyro", "mocap.q"}
    (words,) = (words for words in log.assumed if words.startswith("Datasets without num"))
    for name in ("imu.virtual", "imu.external", "imu.words", "imu.none", "linked"):
        assert name in words


def test_a_file_that_declares_too_much_is_refused(path):
    with h5py.File(write(path), "a") as file:
        options = {"chunks": (1000, 1000), "compression": 9}
        file.create_dataset("imu/bomb", (10**6, 10**6), "f8", **options)[0, 0] = 1
    with limited(), pytest.raises(LogError, match="must have arrays of less than"):
        read(path)


def test_a_chunk_that_is_larger_than_its_dataset_is_refused(path, monkeypatch):
    options = {"maxshape": (None,), "chunks": (10**7,), "compression": 9}
    with h5py.File(write(path), "a") as file:
        file.create_dataset("imu/few", data=TIMES, **options)
    monkeypatch.setattr("lgvi.logs.columns.MOST_BYTES", 10**7)
    with limited(), pytest.raises(LogError, match="must have arrays of less than"):
        read(path)


def test_numbers_that_were_never_written_are_missing(path):
    with h5py.File(write(path), "a") as file:
        options = {"shape": (50, 3), "chunks": (20, 2)}
        file.create_dataset("imu/begun", dtype=float, **options)[:20] = RATES[:20]
        file.create_dataset("imu/never", dtype=float, **options)
        file.create_dataset("imu/empty", (50,), float)
    log = read(path)
    np.testing.assert_array_equal(log.signals["imu.begun"].values[:20], RATES[:20])
    assert np.isnan(log.signals["imu.begun"].values[20:]).all()
    assert {"imu.never", "imu.empty"}.isdisjoint(log.signals)
    assert any("not in the file, were left out: imu.empty, imu.never" in s for s in log.assumed)


def test_packed_numbers_of_netcdf_are_unpacked(path):
    packed = np.round(RATES / 0.001).astype(np.int16)
    packed[3] = -32768
    with h5py.File(write(path), "a") as file:
        file["imu/packed"] = packed
        described = {"scale_factor": 0.001, "add_offset": np.array([0.5]), "units": "rad/s"}
        file["imu/packed"].attrs.update(described | {"_FillValue": np.array([-32768], np.int16)})
    signal = read(path).signals["imu.packed"]
    present = np.arange(50) != 3
    np.testing.assert_allclose(signal.values[present], RATES[present] + 0.5, atol=0.00051)
    assert np.isnan(signal.values[3]).all()
    assert signal.unit == "rad/s"


def test_an_array_that_the_file_cannot_hold_is_left_out(path):
    with h5py.File(write(path), "a") as file:
        file.create_dataset("imu/nowhere", (10**6, 10**6), "f8")
    with limited():
        log = read(path)
    assert set(log.signals) == {"imu.gyro", "mocap.q"}


def test_a_damaged_dataset_is_left_out(path):
    write(path, chunks=(50, 3), compression="gzip", fletcher32=True)
    with h5py.File(path, "r") as file:
        begin = file["imu/gyro"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[begin + 20] ^= 255
    path.write_bytes(bytes(content))
    log = read(path)
    assert set(log.signals) == {"mocap.q"}
    assert any("damaged were left out: `imu.gyro`" in words for words in log.assumed)


def test_the_package_that_is_missing_is_named(path, monkeypatch):
    write(path)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match="need h5py: pip install"):
        read(path)


def test_damaged_files(path):
    logs = check_damages(read, write(path, chunks=(10, 3), compression="gzip"))
    assert len(logs) > 20
