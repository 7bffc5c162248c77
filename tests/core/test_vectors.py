"""Vectors, matrices and quaternions by component agree with NumPy and SciPy on arrays."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from lgvi.core.kernels.quaternions import Quaternion, rotate_rows
from lgvi.core.kernels.vectors import Mat3, Vec3

from ..systems import rng

COUNT = 5


@jax.jit
def every_operation(a, b, M, N, k, q, r):
    """For vectors (n, 3), matrices (n, 3, 3), numbers (n,) and quaternions (n, 4)."""
    rows = rotate_rows(M, Quaternion.of(q))
    back = {
        "M from its second axis": Mat3.of(M, 1).array(1),
        "b from its first axis": Vec3.of(b.T, 0).array(0),
        "q from its first axis": Quaternion.of(q.T, 0).array(0),
    }
    a, b, M, N = Vec3.of(a), Vec3.of(b), Mat3.of(M), Mat3.of(N)
    q, r = Quaternion.of(q), Quaternion.of(r)
    of_arrays = {
        "a + b": a + b,
        "a - b": a - b,
        "k a": k * a,
        "a k": a * k,
        "a / k": a / k,
        "2 a of NumPy": np.float64(2) * a,
        "a x b": a.cross(b),
        "M a": M @ a,
        "solve": M.solve(a),
        "M + N": M + N,
        "M - N": M - N,
        "k M": k * M,
        "M k": M * k,
        "a b^T": a.outer(b),
        "M + k I": M.plus_identity(k),
        "M + hat(a)": M.plus_hat(a),
        "M hat(a)": M.cross(a),
        "M^T": M.T,
        "adjugate": M.adjugate(),
        "inverse": M.inverse(),
        "M + M^T from six": Mat3.of_six((M + M.T).six()),
        "M + M^T from six on another axis": Mat3.of_six((M + M.T).six(0), 0),
        "Q a": q.rotate(a),
        "Q^T a": q.rotate_back(a),
        "Q S a": (q * r).rotate(a),
        "conjugate": q.conjugate().rotate(a),
    }
    numbers = {"a[1]": a[1], "a.b": a.dot(b), "|a|": a.norm(), "trace": M.trace()}
    return back | {name: x.array() for name, x in of_arrays.items()} | numbers | {"M Q": rows}


def test_every_operation_agrees_with_numpy_and_scipy():
    random = rng(40)
    a, b = random.normal(size=(2, COUNT, 3))
    M, N = random.normal(size=(2, COUNT, 3, 3))
    k = random.uniform(1, 2, COUNT)
    q, r = random.normal(size=(2, COUNT, 4))  # of any norm
    of_vector, of_matrix = k[:, None], k[:, None, None]
    hat, MT, inverse = np.cross(np.eye(3), a[:, None]), np.swapaxes(M, 1, 2), np.linalg.inv(M)
    Q, S = Rotation.from_quat(q, scalar_first=True), Rotation.from_quat(r, scalar_first=True)
    expected = {
        "M from its second axis": M,
        "b from its first axis": b.T,
        "q from its first axis": q.T,
        "a + b": a + b,
        "a - b": a - b,
        "k a": of_vector * a,
        "a k": of_vector * a,
        "a / k": a / of_vector,
        "2 a of NumPy": 2 * a,
        "a x b": np.cross(a, b),
        "M a": np.einsum("nij,nj->ni", M, a),
        "solve": np.einsum("nij,nj->ni", inverse, a),
        "M + N": M + N,
        "M - N": M - N,
        "k M": of_matrix * M,
        "M k": of_matrix * M,
        "a b^T": a[:, :, None] * b[:, None],
        "M + k I": M + of_matrix * np.eye(3),
        "M + hat(a)": M + hat,
        "M hat(a)": M @ hat,
        "M^T": MT,
        "adjugate": np.linalg.det(M)[:, None, None] * inverse,
        "inverse": inverse,
        "M + M^T from six": M + MT,
        "M + M^T from six on another axis": M + MT,
        "Q a": Q.apply(a),
        "Q^T a": Q.inv().apply(a),
        "Q S a": (Q * S).apply(a),
        "conjugate": Q.inv().apply(a),
        "a[1]": a[:, 1],
        "a.b": np.sum(a * b, axis=1),
        "|a|": np.linalg.norm(a, axis=1),
        "trace": np.trace(M, axis1=1, axis2=2),
        "M Q": M @ Q.as_matrix(),
    }
    results = every_operation(a, b, M, N, k, q, r)
    assert set(results) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(results[name], value, rtol=1e-12, atol=1e-12, err_msg=name)
