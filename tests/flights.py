"""Flights of a quadrotor under thrust and drag, by Runge and Kutta's method in NumPy.

All flights are side by side (flights, ...). The speeds of the rotors are linear between samples,
and sensors read in the middle between these, where speeds have no kinks.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .systems import rng

J = np.array([[3.1, 0.1, -0.05], [0.1, 3.6, 0.08], [-0.05, 0.08, 5.9]]) * 1e-3  # kg m²
MASS, GRAVITY = 0.5, np.array([0.0, 0.0, -9.81])  # kg, m/s²
ARMS = 0.12 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]], float)
CENTRE = np.array([0.002, -0.001, 0.0])  # m, of mass from the middle of the rotors
UP, SPIN = np.array([0.0, 0.0, 1.0]), np.array([1, -1, 1, -1])
THRUST, DRAG, SPUN, IN_PLANE = 3e-6, 4.5e-8, 2e-5, 3e-5  # N s², N m s², kg m², N s²/m
FRAME = np.array([0.1, 0.15, 0.2])  # N s/m, linear drag
PLACE = np.array([0.03, -0.02, 0.01])  # m, of the accelerometer
MARKER = np.array([0.02, 0.0, 0.05])  # m
PARTS = 4  # steps from sample to sample


class Flights(NamedTuple):
    """What sensors without noise read (flights, readings, ...)."""

    t_speeds: np.ndarray
    speeds: np.ndarray  # (flights, samples, rotors)
    t: np.ndarray  # of readings
    R: np.ndarray
    omega: np.ndarray
    specific_force: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def fly(key, flights=12, samples=100, dt=0.01, wind=None, drag=True, spun=SPUN):
    """Flights from random states.

    `wind` (3,) is a function of time, m/s, zero by default; `spun` is the spin inertia of a rotor.
    """
    random, t = rng(171, key), dt * np.arange(samples)
    frequencies, phases = random.uniform(5, 25, (2, flights, 1, 12))
    waves = np.sin(frequencies * t[:, None] + phases)
    speeds = 640 + 20 * waves @ random.normal(size=(flights, 12, 4))
    R = Rotation.from_rotvec(0.2 * random.normal(size=(flights, 3))).as_matrix()
    x, v, omega = random.normal(size=(3, flights, 3))
    J_inverse = np.linalg.inv(J)

    def forces(t, R, v, speed):
        u = np.einsum("nji,nj->ni", R, v - (0 if wind is None else wind(t)))
        of_rotors = THRUST * np.sum(speed**2, axis=1)[:, None] * UP
        if not drag:
            return of_rotors
        through_air = np.einsum("nji,nj->ni", R, v) * [1.0, 1.0, 0.0]
        return of_rotors - IN_PLANE * np.sum(speed, axis=1)[:, None] * through_air - FRAME * u

    def angular_acceleration(omega, speed, speed_rate):
        torque = THRUST * speed**2 @ np.cross(ARMS - CENTRE, UP)
        torque -= (DRAG * speed**2 + spun * speed_rate) @ SPIN[:, None] * UP
        pi = omega @ J + spun * speed @ SPIN[:, None] * UP
        return (np.cross(pi, omega) + torque) @ J_inverse

    def derivative(t, state, speed, speed_rate):
        R, _, v, omega = state
        hat = np.cross(np.eye(3), omega[:, None])  # rows e_i x omega
        acceleration = GRAVITY + np.einsum("nij,nj->ni", R, forces(t, R, v, speed)) / MASS
        return R @ hat, v, acceleration, angular_acceleration(omega, speed, speed_rate)

    def moved(state, rate, h):
        return tuple(x + h * dx for x, dx in zip(state, rate, strict=True))

    state, readings, h = (R, x, v, omega), [], dt / PARTS
    for k in range(samples - 1):
        change = (speeds[:, k + 1] - speeds[:, k]) / dt
        for part in range(PARTS):
            begin = part * h
            if 2 * part == PARTS:
                readings.append((*state, speeds[:, k] + begin * change, change))
            stages = [derivative(t[k] + begin, state, speeds[:, k] + begin * change, change)]
            for fraction in (0.5, 0.5, 1.0):
                now = begin + fraction * h
                middle = moved(state, stages[-1], fraction * h)
                stages.append(derivative(t[k] + now, middle, speeds[:, k] + now * change, change))
            for stage, weight in zip(stages, (1, 2, 2, 1), strict=True):
                state = moved(state, stage, weight * h / 6)
    t_readings = t[:-1] + dt / 2
    R, x, v, omega, speed, change = (
        np.stack(column, axis=1) for column in zip(*readings, strict=True)
    )
    force = np.stack(
        [
            forces(time, R[:, k], v[:, k], speed[:, k]) / MASS
            + np.cross(angular_acceleration(omega[:, k], speed[:, k], change[:, k]), PLACE)
            + np.cross(omega[:, k], np.cross(omega[:, k], PLACE))
            for k, time in enumerate(t_readings)
        ],
        axis=1,
    )
    return Flights(t, speeds, t_readings, R, omega, force, x + R @ MARKER, v)
