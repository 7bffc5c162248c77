"""Sensors of attitudes."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core import so3
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by
from ..loss import AbstractLoss
from .sensor import AbstractSensor, InvalidReadingError, MotionState
from .shared_fields import as_loss, as_sigma, as_time_offset, vector_or_default

TOLERANCE = 1e-3  # how far a quaternion or a matrix may be from a rotation


class AttitudeSensor(AbstractSensor):
    r"""A star tracker, camera or motion capture: attitudes with noise in the sensor's frame.

    It reads $R_\text{m} = R\,\operatorname{Exp}(a)\operatorname{Exp}(\sigma n)$ with standard
    normal $n$.

    Parameters
    ----------
    sigma
        Standard deviation of the noise about each axis of the sensor, rad: a scalar or (3,).
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf; zero
        by default.
    time_offset
        Time of a reading minus its time stamp, s, which is below zero where time stamps are late: a
        learnable leaf if given as a number, such as 0.0. `None` is no offset, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    channel = "attitude"
    unit = "rad"
    axes = ("x", "y", "z")
    shapes = ((4,), (3, 3))
    depends_on_attitude = True

    sigma: Float[Array, "*axes"]
    alignment: Float[Array, "3"] = eqx.field(metadata=described_by("rad", "a second sensor"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        sigma: Float[ArrayLike, "*axes"],
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = as_sigma(sigma)
        self.alignment = vector_or_default("alignment", alignment, 0.0, self.sigma)
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    def predict(self, state: MotionState) -> Float[Array, "3 3"]:
        r"""What it reads without noise (3, 3), $R\,\operatorname{Exp}(a)$, sensor to space."""
        R, a = as_floats(R=(state.R, (3, 3)), alignment=(self.alignment, (3,)))
        return matmul(R, so3.exp(a))

    def compute_residual(
        self, predicted: Float[Array, "3 3"], measured: Float[Array, "3 3"]
    ) -> Float[Array, "3"]:
        r"""Whitened residual (3,), $\operatorname{Log}(R_\text{pred}^T R_\text{m})/\sigma$."""
        error = so3.log(matmul(predicted.T, measured.astype(predicted.dtype)))
        return error / self.sigma.astype(error.dtype)

    def add_noise(
        self, predicted: Float[Array, "3 3"], noise: Float[Array, "3"]
    ) -> Float[Array, "3 3"]:
        r"""The attitude $R_\text{pred}\operatorname{Exp}(\sigma n)$ (3, 3)."""
        return matmul(predicted, so3.exp((self.sigma * noise).astype(predicted.dtype)))

    def guess_state(
        self, readings: Float[np.ndarray, "samples 3 3"]
    ) -> tuple[Float[np.ndarray, "samples 3 3"], None]:
        r"""The attitudes $R_\text{m}\operatorname{Exp}(a)^T$."""
        # SciPy is imported here: it is needed for recordings alone, and takes long.
        from scipy.spatial.transform import Rotation

        return readings @ Rotation.from_rotvec(np.array(self.alignment, float)).as_matrix().T, None

    @staticmethod
    def from_columns(columns: Float[np.ndarray, "samples columns"]) -> np.ndarray:
        """Rotations (samples, 3, 3) of unit quaternions, scalar first, or of matrices, row by row.

        They may be off by 1e-3, and are normalised.

        Raises
        ------
        InvalidReadingError
            If they are off by more.
        """
        from scipy.spatial.transform import Rotation

        if len(columns) == 0:
            return np.zeros((0, 3, 3))  # which SciPy refuses
        if columns.shape[1] == 4:
            length = np.sqrt(np.einsum("si,si->s", columns, columns))
            if (wrong := abs(length - 1) > TOLERANCE).any():
                i = int(np.argmax(wrong))
                raise InvalidReadingError(i, f"must have length 1, but has {length[i]:.6g}")
            return Rotation.from_quat(columns, scalar_first=True).as_matrix()
        R = columns.reshape(-1, 3, 3)
        defect = abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max((1, 2))
        if (wrong := (defect > TOLERANCE) | (np.linalg.det(R) < 0)).any():
            i = int(np.argmax(wrong))
            raise InvalidReadingError(i, f"must be a rotation matrix, but is {R[i].tolist()}")
        left, _, right = np.linalg.svd(R)
        return left @ right

    @staticmethod
    def as_curves(readings: np.ndarray) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components of quaternions, each with the sign that is nearest to the one before."""
        from scipy.spatial.transform import Rotation

        q = Rotation.from_matrix(readings).as_quat(scalar_first=True)
        flips = np.sum(q[1:] * q[:-1], axis=1) < 0
        q[1:] *= np.cumprod(np.where(flips, -1, 1))[:, None]
        return "quaternion of the attitude", dict(zip("wxyz", q.T, strict=True))
