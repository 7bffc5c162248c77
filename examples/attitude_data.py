"""Recorded attitudes for `fit_inertia.py`: read from a CSV file, or made by SciPy."""

import csv
import math
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

REQUIRED = ("t", "qw", "qx", "qy", "qz")
RATES = ("wx", "wy", "wz")


class Recording(NamedTuple):
    """Trajectories of different lengths, padded to the longest.

    A padded sample repeats the last time stamp, so the step that leads to it has size zero.
    """

    t: Float[Array, "tosses samples"]  # s
    R: Float[Array, "tosses samples 3 3"]  # body to space
    mask: Bool[Array, "tosses samples"]  # False where padded
    omega0: Float[Array, "tosses 3"]  # rough initial body rates, rad/s
    names: tuple[str, ...]

    def select(self, kept: np.ndarray) -> "Recording":
        """The tosses where `kept`."""
        names = tuple(name for name, keep in zip(self.names, kept, strict=True) if keep)
        t, R, mask, omega0, _ = self
        return Recording(t[kept], R[kept], mask[kept], omega0[kept], names)


def pad(tosses: list[tuple[np.ndarray, np.ndarray, np.ndarray | None]], names) -> Recording:
    """Put tosses `(t, wxyz, omega0 or None)` side by side."""
    longest = max(len(t) for t, _, _ in tosses)
    rows = []
    for t, wxyz, omega0 in tosses:
        rotations = Rotation.from_quat(wxyz, scalar_first=True)
        if omega0 is None:
            omega0 = (rotations[0].inv() * rotations[1]).as_rotvec() / (t[1] - t[0])
        kept = np.minimum(np.arange(longest), len(t) - 1)
        mask = np.arange(longest) < len(t)
        rows.append((t[kept], rotations.as_matrix()[kept], mask, omega0))
    t, R, mask, omega0 = (jnp.asarray(np.stack(column)) for column in zip(*rows, strict=True))
    return Recording(t, R, mask, omega0, tuple(names))


def synthetic_tosses(
    tosses: int, noise: float, seed: int, duration: float = 2.0, samples: int = 100
) -> tuple[Recording, Array]:
    """Attitudes of a tumbling body from Euler's equations, integrated by DOP853.

    Returns the recording, with `noise` (rad per axis) on every attitude, and the true
    inertia, of unit trace.
    """
    random = np.random.default_rng(seed)
    axes = Rotation.from_rotvec([0.4, -0.7, 0.5]).as_matrix()
    J = axes @ np.diag([0.20, 0.36, 0.44]) @ axes.T
    inverse = np.linalg.inv(J)

    def motion(_, state):
        w, v, omega = state[0], state[1:4], state[4:]
        rates = inverse @ np.cross(J @ omega, omega)
        return np.concatenate([[-v @ omega / 2], (w * omega + np.cross(v, omega)) / 2, rates])

    recorded = []
    t = np.linspace(0, duration, samples)
    for _ in range(tosses):
        omega = random.normal(size=3)
        omega *= random.uniform(2, 4) / np.linalg.norm(omega)
        start = np.concatenate([Rotation.random(rng=random).as_quat(scalar_first=True), omega])
        states = solve_ivp(
            motion, (0, duration), start, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-12
        ).y.T
        disturbance = Rotation.from_rotvec(noise * random.normal(size=(samples, 3)))
        attitudes = Rotation.from_quat(states[:, :4], scalar_first=True) * disturbance
        recorded.append((t, attitudes.as_quat(scalar_first=True), None))
    return pad(recorded, map(str, range(tosses))), jnp.asarray(J)


def read_csv(file: Path) -> Recording:
    """Read a recording.

    Raises
    ------
    ValueError
        For anything that is not a recording, naming the file, the line and the column.
    """

    def fail(line: int, column: str, problem: str):
        raise ValueError(f"{file}, line {line}, column `{column}`: {problem}")

    tosses: dict[str, list[tuple[int, list[float]]]] = {}
    try:
        file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file}: must be text in UTF-8, but {error}") from error
    with file.open(newline="", encoding="utf-8-sig") as handle:
        reader = csv.DictReader(handle, skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or []]
        reader.fieldnames = header
        rates = RATES if any(name in header for name in RATES) else ()
        for name in REQUIRED + rates:
            if header.count(name) != 1:
                fail(1, name, f"must be there once; the header is {','.join(header) or 'empty'}")
        if header.count("trajectory") > 1:
            fail(1, "trajectory", "must be there at most once")
        for row in reader:
            if None in row:
                fail(reader.line_num, str(len(header) + 1), "has no name in the header")
            values = []
            for name in REQUIRED + rates:
                if row[name] is None:
                    fail(reader.line_num, name, "is missing: the line ends before it")
                try:
                    values.append(float(row[name]))
                except ValueError:
                    fail(reader.line_num, name, f"must be a number, but is {row[name]!r}")
                if not math.isfinite(values[-1]):
                    fail(reader.line_num, name, f"must be finite, but is {row[name]!r}")
            length = math.hypot(*values[1:5])
            if abs(length - 1) > 1e-3:
                fail(reader.line_num, "qw,qx,qy,qz", f"must have length 1, but has {length:.6g}")
            toss = tosses.setdefault(row.get("trajectory") or "", [])
            if toss and values[0] <= toss[-1][1][0]:
                before = toss[-1]
                fail(
                    reader.line_num, "t",
                    f"must increase within a trajectory, but {values[0]:g} follows "
                    f"{before[1][0]:g} of line {before[0]}",
                )  # fmt: skip
            toss.append((reader.line_num, values))
    if not tosses:
        fail(2, "t", "there is no sample")
    for name, toss in tosses.items():
        if len(toss) < 3:
            fail(toss[0][0], "t", f"trajectory {name!r} has {len(toss)} samples, needs at least 3")
    tables = [np.array([values for _, values in toss]) for toss in tosses.values()]
    return pad([(x[:, 0], x[:, 1:5], x[0, 5:] if rates else None) for x in tables], tosses)
