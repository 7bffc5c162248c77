"""From a file to a log: which reader reads it."""

from collections.abc import Callable
from importlib import import_module
from inspect import signature
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from .log import Log
from .recorded import join_components
from .signal import LogError

HEAD = 65536  # first bytes of a file, by which its format is recognised
TEXT = "text"


class Reader(NamedTuple):
    """A reader of one format: a file here with a function `read(path, **options)`."""

    module: str
    kind: str
    recognises: Callable[[Path, bytes], bool]  # by the path and the first bytes


def _is_bag_folder(path: Path, head: bytes) -> bool:
    return path.suffix == ".db3" or (path / "metadata.yaml").is_file()


# In the order in which they are asked.
READERS = {
    "parquet": Reader("columns", "Parquet", lambda path, head: head.startswith(b"PAR1")),
    "ulog": Reader("ulog", "PX4 ULog", lambda path, head: head.startswith(b"ULog\x01\x12\x35")),
    "dataflash": Reader(
        "dataflash", "ArduPilot dataflash", lambda path, head: head.startswith(b"\xa3\x95")
    ),
    "betaflight": Reader(
        "betaflight.reading_blackbox",
        "Betaflight blackbox",
        lambda path, head: b"H Product:Blackbox flight data recorder" in head,
    ),
    "bag": Reader(
        "bags",
        "ROS bag",
        lambda path, head: (
            head.startswith((b"#ROSBAG V", b"\x89MCAP0\r\n")) or _is_bag_folder(path, head)
        ),
    ),
    "matlab": Reader(
        "matlab",
        "MATLAB",
        lambda path, head: head.startswith(b"MATLAB") or path.suffix.lower() == ".mat",
    ),
    "hdf5": Reader("hdf5", "HDF5", lambda path, head: head.startswith(b"\x89HDF\r\n\x1a\n")),
    TEXT: Reader("delimited.reading_text", "delimited text", lambda path, head: True),
}


def read(path: str | PathLike[str], reader: str | None = None, **options: Any) -> Log:
    """Read a log.

    Parameters
    ----------
    path
        The file, or the folder of a log in several files.
    reader
        The format: `"text"` for delimited text, `"betaflight"`, `"ulog"`, `"dataflash"`, `"bag"`,
        `"matlab"`, `"hdf5"` or `"parquet"`. By default it is recognised by the first bytes.
    **options
        Options of the reader; see the page on the format.

    Returns
    -------
    Log
        The signals, as they are in the file, and what was recognised.

    Raises
    ------
    LogError
        For a file that is damaged, or of another format; the message names the place.
    FileNotFoundError, PermissionError
        If the file cannot be read.
    ImportError
        If the package that reads the format is not installed; the message says how to install it.
    """
    path = Path(path)
    if reader is not None and reader not in READERS:
        raise ValueError(
            f"Argument `reader` must be one of {', '.join(READERS)}, but is {reader!r}."
        )
    head = b""
    if not path.is_dir():
        with open(path, "rb") as file:
            head = file.read(HEAD)
        if not head:
            raise LogError(path, "must be a log, but is empty")
    if reader is None:
        reader = next(name for name, known in READERS.items() if known.recognises(path, head))
    read_format = import_module(f".{READERS[reader].module}", __package__).read
    _, *known = signature(read_format).parameters
    for name in options:
        if name not in known:
            words = f"options of the reader `{reader}` are {', '.join(known) or 'none'}"
            raise TypeError(f"There is no option `{name}`: {words}.")
    return join_components(read_format(path, **options))
