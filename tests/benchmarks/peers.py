"""Free motion of one body by what a user would take instead: each peer by its documented way.

Each method gives attitudes and angular velocities, body frame, at even times. Quaternions have the
scalar first. A peer that is not installed has no methods.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lgvi

# No types are known of these, and some may be missing.
MUJOCO: Any = import_module("mujoco") if find_spec("mujoco") else None

MOMENTS = np.array([1.0, 2.0, 2.8])  # kg m²
OMEGA0 = np.array([0.01, 5.0, 0.01])  # rad/s, about the middle axis
STEPS = 0.01, 0.002  # s
TOLERANCES = 1e-6, 1e-9, 1e-12
# Of peers that may be missing.
PACKAGES = {"MuJoCo": "mujoco", "MJX": "mujoco.mjx", "brax": "brax", "Basilisk": "Basilisk"}

Motion = tuple[np.ndarray, np.ndarray]  # attitudes (n, 3, 3) and rates (n, 3)
Gradient = Callable[[], Any]  # a call of value and gradient by moments and initial rates


class Method(NamedTuple):
    """One way to simulate the body."""

    peer: str
    name: str
    setting: float  # step, s, or relative tolerance
    is_adaptive: bool
    prepare: Callable[[float, int], Callable[[], Motion]]  # for a time and a number of samples
    prepare_gradient: Callable[[float], Gradient] | None  # for a time

    def __str__(self) -> str:
        kind = "tolerance" if self.is_adaptive else "step, s"
        return f"{self.peer}, {self.name}, {kind} {self.setting:g}"


def is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def missing_peers() -> list[str]:
    """Peers that are not installed."""
    return [peer for peer, package in PACKAGES.items() if not is_installed(package)]


def methods(
    steps: Sequence[float] = STEPS, tolerances: Sequence[float] = TOLERANCES
) -> Iterator[Method]:
    """All methods of the peers that are installed."""
    for step in steps:
        for order in (2, 4, 8):
            run, gradient = (
                partial(_variational, step, order),
                partial(_variational_gradient, step, order),
            )
            yield Method("lgvi", f"order {order}", step, False, run, gradient)
        if is_installed(PACKAGES["MuJoCo"]):
            for name in ("Euler", "implicit", "implicitfast", "RK4"):
                yield Method("MuJoCo", name, step, False, partial(_mujoco, name, step), None)
        if is_installed(PACKAGES["MJX"]):
            for name in ("Euler", "implicitfast", "RK4"):
                run, gradient = partial(_mjx, name, step), partial(_mjx_gradient, name, step)
                yield Method("MJX", name, step, False, run, gradient)
        if is_installed(PACKAGES["brax"]):
            yield Method("brax", "generalized", step, False, partial(_brax, step), None)
        if is_installed(PACKAGES["Basilisk"]):
            yield Method("Basilisk", "RK4", step, False, partial(_basilisk, step), None)
    for tolerance in tolerances:
        for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
            run, gradient = (
                partial(_diffrax, solver, tolerance),
                partial(_diffrax_gradient, solver, tolerance),
            )
            yield Method("diffrax", type(solver).__name__, tolerance, True, run, gradient)
        yield Method("SciPy", "DOP853", tolerance, True, partial(_scipy, tolerance), None)


def _even(span: float, samples: int) -> np.ndarray:
    return np.linspace(0, span, samples + 1)


def _matrices(q: Any) -> np.ndarray:
    """Attitudes of quaternions, which are normalised; NaN where there are none."""
    q = np.array(q, float)
    is_lost = ~np.isfinite(q).all(axis=1) | (np.linalg.norm(q, axis=1) == 0)
    q[is_lost] = 1
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    R[is_lost] = np.nan
    return R


# lgvi


def _steps(step: float, span: float) -> int:
    return round(span / step)


def _variational(step: float, order: int, span: float, samples: int) -> Callable[[], Motion]:
    integrator = lgvi.MoserVeselovIntegrator(step, order=order)
    each = _steps(step, span) // samples

    @jax.jit
    def run(moments):
        body = lgvi.RigidBody(jnp.diag(moments))
        trajectory = integrator.simulate(
            body, jnp.eye(3), omega0=OMEGA0, steps=each * samples, save_every=each
        )
        return trajectory.R, trajectory.pi / moments[None]

    return lambda: run(MOMENTS)


def _variational_gradient(step: float, order: int, span: float) -> Gradient:
    integrator = lgvi.MoserVeselovIntegrator(step, order=order)

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def run(moments, omega0):
        body = lgvi.RigidBody(jnp.diag(moments))
        steps = _steps(step, span)
        end = integrator.simulate(body, jnp.eye(3), omega0=omega0, steps=steps, save_every=steps)
        return end.R[-1, 0, 1]

    return lambda: run(MOMENTS, OMEGA0)


# MuJoCo and MJX


def _mjcf(integrator: str, step: float) -> str:
    return f"""
    <mujoco>
      <option gravity="0 0 0" timestep="{step}" integrator="{integrator}"/>
      <worldbody><body>
        <freejoint/><inertial pos="0 0 0" mass="1" diaginertia="{" ".join(map(str, MOMENTS))}"/>
      </body></worldbody>
    </mujoco>"""


def _mujoco(integrator: str, step: float, span: float, samples: int) -> Callable[[], Motion]:
    model = MUJOCO.MjModel.from_xml_string(_mjcf(integrator, step))
    data, each = MUJOCO.MjData(model), _steps(step, span) // samples

    def run() -> Motion:
        MUJOCO.mj_resetData(model, data)
        data.qvel[3:] = OMEGA0
        q, omega = [data.qpos[3:7].copy()], [data.qvel[3:].copy()]
        for _ in range(samples):
            MUJOCO.mj_step(model, data, nstep=each)
            # Where a motion is lost, MuJoCo warns, and starts again from its first state.
            is_lost = any(warning.number for warning in data.warning)
            q.append(np.nan * data.qpos[3:7] if is_lost else data.qpos[3:7].copy())
            omega.append(np.nan * data.qvel[3:] if is_lost else data.qvel[3:].copy())
        return _matrices(q), np.array(omega)

    return run


def _mjx_start(integrator: str, step: float) -> Any:
    mjx: Any = import_module("mujoco.mjx")

    model = mjx.put_model(MUJOCO.MjModel.from_xml_string(_mjcf(integrator, step)))
    return model, mjx.make_data(model)


def _mjx(integrator: str, step: float, span: float, samples: int) -> Callable[[], Motion]:
    mjx: Any = import_module("mujoco.mjx")

    (model, data), each = _mjx_start(integrator, step), _steps(step, span) // samples

    @jax.jit
    def run(omega0):
        def sample(data, _):
            data = jax.lax.fori_loop(0, each, lambda _, x: mjx.step(model, x), data)
            return data, (data.qpos[3:7], data.qvel[3:])

        start = data.replace(qvel=data.qvel.at[3:].set(omega0))
        _, (q, omega) = jax.lax.scan(sample, start, length=samples)
        first = start.qpos[None, 3:7], start.qvel[None, 3:]
        return jnp.concatenate([first[0], q]), jnp.concatenate([first[1], omega])

    def motion() -> Motion:
        q, omega = run(OMEGA0)
        return _matrices(q), np.asarray(omega)

    return motion


def _mjx_gradient(integrator: str, step: float, span: float) -> Gradient:
    mjx: Any = import_module("mujoco.mjx")

    model, data = _mjx_start(integrator, step)

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def run(moments, omega0):
        body = model.replace(body_inertia=model.body_inertia.at[1].set(moments))
        start = data.replace(qvel=data.qvel.at[3:].set(omega0))
        end, _ = jax.lax.scan(
            lambda x, _: (mjx.step(body, x), None), start, length=_steps(step, span)
        )
        w, x, y, z = end.qpos[3:7]
        return 2 * (x * y - w * z)

    return lambda: run(MOMENTS, OMEGA0)


# brax


def _brax(step: float, span: float, samples: int) -> Callable[[], Motion]:
    pipeline: Any = import_module("brax.generalized.pipeline")
    shape = '<geom size="0.1" mass="0" contype="0" conaffinity="0"/>'  # which it wants
    xml = _mjcf("Euler", step).replace("</body>", f"{shape}</body>")
    system = import_module("brax.io.mjcf").loads(xml)
    each = _steps(step, span) // samples

    @jax.jit
    def run(omega0):
        def sample(state, _):
            advance = partial(pipeline.step, system, act=jnp.zeros(0))
            state = jax.lax.fori_loop(0, each, lambda _, x: advance(x), state)
            return state, (state.q[3:7], state.xd.ang[0])

        start = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        state = pipeline.init(system, start, jnp.concatenate([jnp.zeros(3), omega0]))
        return jax.lax.scan(sample, state, length=samples)[1]

    def motion() -> Motion:
        q, in_space = map(np.asarray, run(jnp.asarray(OMEGA0)))
        R = _matrices(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], q]))
        return R, np.einsum("nji,nj->ni", R, np.concatenate([OMEGA0[None], in_space]))

    return motion


# Basilisk


def _basilisk(step: float, span: float, samples: int) -> Callable[[], Motion]:
    spacecraft: Any = import_module("Basilisk.simulation.spacecraft")
    base: Any = import_module("Basilisk.utilities.SimulationBaseClass")
    macros: Any = import_module("Basilisk.utilities.macros")

    each = _steps(step, span) // samples

    def run() -> Motion:
        simulation = base.SimBaseClass()
        process = simulation.CreateNewProcess("process")
        process.addTask(simulation.CreateNewTask("task", macros.sec2nano(step)))
        body = spacecraft.Spacecraft()  # by default it integrates by RK4
        body.hub.mHub = 1.0
        body.hub.IHubPntBc_B = np.diag(MOMENTS).tolist()
        body.hub.sigma_BNInit = [[0.0], [0.0], [0.0]]
        body.hub.omega_BN_BInit = [[x] for x in OMEGA0]
        simulation.AddModelToTask("task", body)
        states = body.scStateOutMsg.recorder(macros.sec2nano(each * step))
        simulation.AddModelToTask("task", states)
        simulation.InitializeSimulation()
        simulation.ConfigureStopTime(macros.sec2nano(span))
        simulation.ExecuteSimulation()
        sigma, omega = np.array(states.sigma_BN), np.array(states.omega_BN_B)
        # Rotation's modified Rodrigues parameters are those of the turn from body to space.
        return Rotation.from_mrp(sigma).as_matrix(), omega

    return run


# Solvers of differential equations


def _slope(numpy: Any, moments: Any, state: Any) -> Any:
    """The rates of a quaternion and an angular velocity (7,), by NumPy or by JAX."""
    w, x, y, z, p, q, r = state
    turn = numpy.stack(
        [
            -x * p - y * q - z * r,
            w * p + y * r - z * q,
            w * q + z * p - x * r,
            w * r + x * q - y * p,
        ]
    )
    momentum = moments * state[4:]
    return numpy.concatenate([turn / 2, numpy.cross(momentum, state[4:]) / moments])


def _scipy(tolerance: float, span: float, samples: int) -> Callable[[], Motion]:
    def slope(_, state):
        return _slope(np, MOMENTS, state)

    def run() -> Motion:
        start = np.concatenate([[1.0, 0.0, 0.0, 0.0], OMEGA0])
        settings = {"method": "DOP853", "rtol": tolerance, "atol": tolerance}
        y = solve_ivp(slope, (0, span), start, t_eval=_even(span, samples), **settings).y.T
        return _matrices(y[:, :4]), y[:, 4:]

    return run


def _diffrax_solve(solver: Any, tolerance: float, span: float, moments, omega0, saveat: Any) -> Any:
    def slope(_, state, moments):
        return _slope(jnp, moments, state)

    return diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        solver,
        0.0,
        span,
        0.01,
        jnp.concatenate([jnp.array([1.0, 0.0, 0.0, 0.0]), omega0]),
        moments,
        saveat=saveat,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=2**24,
    ).ys


def _diffrax(solver: Any, tolerance: float, span: float, samples: int) -> Callable[[], Motion]:
    saveat = diffrax.SaveAt(ts=jnp.asarray(_even(span, samples)))

    @jax.jit
    def run(moments, omega0):
        return _diffrax_solve(solver, tolerance, span, moments, omega0, saveat)

    def motion() -> Motion:
        y = run(jnp.asarray(MOMENTS), jnp.asarray(OMEGA0))
        return _matrices(y[:, :4]), np.asarray(y[:, 4:])

    return motion


def _diffrax_gradient(solver: Any, tolerance: float, span: float) -> Gradient:
    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def run(moments, omega0):
        y = _diffrax_solve(solver, tolerance, span, moments, omega0, diffrax.SaveAt(t1=True))[-1]
        w, x, y, z = y[:4] / jnp.linalg.norm(y[:4])
        return 2 * (x * y - w * z)

    return lambda: run(jnp.asarray(MOMENTS), jnp.asarray(OMEGA0))
