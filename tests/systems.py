"""Bodies and states with known properties, and references that do not use the library.

Everything here is NumPy and SciPy in double precision.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

SEED = 20240611


def rng(*key):
    return np.random.default_rng([SEED, *key])


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def vee(S):
    return np.array([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]]) / 2


def rotation(*key):
    """A rotation matrix drawn uniformly."""
    return Rotation.random(rng=rng(7, *key)).as_matrix()


def inertia(moments, axes=None):
    axes = np.eye(3) if axes is None else axes
    J = axes @ np.diag(np.asarray(moments, float)) @ axes.T
    return (J + J.T) / 2


GENERIC = inertia([1.0, 2.0, 2.5], rotation(0))
SPHERE = inertia([2.0, 2.0, 2.0])
SYMMETRIC_TOP = inertia([1.5, 1.5, 0.7], rotation(1))
# One moment is a millionth of the other two: a rod, nearly without a third inertia.
ROD = inertia([1.0, 1.0, 1e-6])
# The same with its axis in no special direction; thinner ones are beyond the reach of float32.
TILTED_ROD = inertia([1.0, 1.0, 1e-4], rotation(4))
# The boundary of the triangle inequality: all mass in a plane.
FLAT = inertia([1.0, 2.0, 3.0], rotation(2))
BODIES = {
    "generic": GENERIC,
    "sphere": SPHERE,
    "symmetric top": SYMMETRIC_TOP,
    "rod": ROD,
    "tilted rod": TILTED_ROD,
    "flat": FLAT,
}

R0 = rotation(3)
PI0 = GENERIC @ np.array([0.7, -0.4, 0.5])


def physical_inertias(count, *key, ratio=1e-2):
    """Inertias (count, 3, 3) whose second moments of mass spread over `ratio`..1."""
    draw = rng(11, *key)
    second = np.exp(draw.uniform(np.log(ratio), 0, (count, 3)))
    axes = Rotation.random(count, rng=draw).as_matrix()
    moments = second.sum(1, keepdims=True) - second
    J = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
    return (J + np.swapaxes(J, 1, 2)) / 2


def momenta(Js, largest, *key, h=0.1):
    """Momenta (count, 3) with |h J^-1 pi| between nothing and `largest`, in any direction."""
    draw = rng(13, *key)
    direction = draw.normal(size=(len(Js), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    omega = draw.uniform(0, largest, (len(Js), 1)) / h * direction
    return np.einsum("nij,nj->ni", Js, omega)


def discrete_inertia(J):
    return np.trace(J) / 2 * np.eye(3) - J


def residual(F, pi, J, h):
    """vee(F Jd - Jd F^T) - h pi, with matrices as the equation is written."""
    F, pi, J = (np.asarray(x, float) for x in (F, pi, J))
    Jd = discrete_inertia(J)
    return vee(F @ Jd - Jd @ F.T) - float(h) * pi


def euler_equations(R0, pi0, J, times, torque=None, rotor=None):
    """Attitudes and momenta of the continuous body at `times`, to about 1e-12.

    `torque` is a function of time, attitude and angular velocity that gives the body-frame
    torque, and `rotor` one of time that gives the momentum of rotors.
    """
    invJ = np.linalg.inv(J)

    def rates(t, y):
        R, pi = y[:9].reshape(3, 3), y[9:]
        omega = invJ @ (pi if rotor is None else pi - rotor(t))
        forced = np.cross(pi, omega) + (0 if torque is None else torque(t, R, omega))
        return np.concatenate([(R @ hat(omega)).ravel(), forced])

    start = np.concatenate([np.ravel(R0), pi0])
    span = (times[0], times[-1])
    y = solve_ivp(rates, span, start, "DOP853", t_eval=times, rtol=1e-13, atol=1e-14).y.T
    return y[:, :9].reshape(-1, 3, 3), y[:, 9:]


def order_of(errors, ratio=2):
    """Order of accuracy that errors at steps of which each is the last over `ratio` show."""
    return np.log(np.divide(errors[:-1], errors[1:])) / np.log(ratio)
