"""The motion in the recordings beside the examples, as their first lines say it was made."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation


def attitudes(J, q, omega, t):
    """Of a body without torque, from a quaternion, scalar first, and an angular velocity."""

    def derivative(_, state):
        q, omega = state[:4], state[4:]
        turning = np.append(-q[1:] @ omega, q[0] * omega + np.cross(q[1:], omega)) / 2
        return np.append(turning, np.linalg.solve(J, np.cross(J @ omega, omega)))

    start, span = np.append(q / np.linalg.norm(q), omega), (t[0], t[-1])
    states = solve_ivp(derivative, span, start, "DOP853", t_eval=t, rtol=1e-12, atol=1e-12).y.T
    return Rotation.from_quat(states[:, :4], scalar_first=True)
