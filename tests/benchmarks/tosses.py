"""True motions of many bodies at once, from SciPy, and recordings of them with noise."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from lgvi.identification import Recordings

from ..systems import rng


def motions(J, omega0, t, torque=None, rotor=None):
    """Attitudes (n, samples, 3, 3) and rates (n, samples, 3) of bodies (n, 3, 3), in one solve.

    `torque` is a function of the rates (n, 3), `rotor` one of time that gives a momentum (3,).
    """
    count, random = len(omega0), rng(200, len(omega0))
    J = np.broadcast_to(J, (count, 3, 3))
    inverse = np.linalg.inv(J)

    def rates_of(time, pi):
        own = pi if rotor is None else pi - rotor(time)
        return np.einsum("nij,nj->ni", inverse, own)

    def derivative(time, y):
        R, pi = y[: 9 * count].reshape(count, 3, 3), y[9 * count :].reshape(count, 3)
        omega = rates_of(time, pi)
        # Each row of R' = R hat(omega) is the product of that of R with omega.
        dpi = np.cross(pi, omega) + (0 if torque is None else torque(omega))
        return np.concatenate([np.cross(R, omega[:, None]).ravel(), dpi.ravel()])

    pi0 = np.einsum("nij,nj->ni", J, omega0) + (0 if rotor is None else rotor(t[0]))
    start = np.concatenate([Rotation.random(count, rng=random).as_matrix().ravel(), pi0.ravel()])
    y = solve_ivp(derivative, (t[0], t[-1]), start, "DOP853", t_eval=t, rtol=1e-11, atol=1e-12).y.T
    R = y[:, : 9 * count].reshape(-1, count, 3, 3).swapaxes(0, 1)
    pi = y[:, 9 * count :].reshape(-1, count, 3)
    omega = [rates_of(time, each) for time, each in zip(t, pi, strict=True)]
    return R, np.stack(omega, 1)


def recorded(t, R, omega, random, sigma_R=None, sigma_omega=None, lengths=None, **inputs):
    """Recordings with noise of what has a size; zero is none."""
    found = []
    for i in range(len(omega)):
        part, values = slice(None if lengths is None else lengths[i]), dict(inputs)
        if sigma_R is not None:
            turn = Rotation.from_rotvec(sigma_R * random.normal(size=omega[i, part].shape))
            values["attitude"] = Rotation.from_matrix(R[i, part]) * turn
        if sigma_omega is not None:
            noise = sigma_omega * random.normal(size=omega[i, part].shape)
            values["angular_velocity"] = omega[i, part] + noise
        found.append(Recordings.from_arrays(t[part], **values, name=str(i)))
    return Recordings.concatenate(found)


def directions(random, count):
    v = random.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def text(values, form=".2f"):
    return ", ".join(f"{value:{form}}" for value in values)
