"""What a user waits for in a process of its own: programs that are compiled, processor time.

Run as a program it prints one line of JSON; `PARTS` name what it does beside the import.
"""

import json
import sys
from collections.abc import Callable, Sequence
from time import process_time
from typing import Any

PARTS = (
    "forward",
    "gradient",
    "batch gradient",
    "force gradient",
    "identify",
    "identify with a rotor",
    "eager",
)


def main(parts: Sequence[str]) -> dict[str, Any]:
    import equinox  # noqa: F401 - its import is not that of the library
    import jax
    import numpy as np

    start = process_time()
    import lgvi
    import lgvi.identification

    found: dict[str, Any] = {"import": {"seconds": process_time() - start}}
    jax.config.update("jax_enable_x64", True)
    jax.numpy.zeros(3).block_until_ready()
    counts = {"programs": 0, "misses": 0}

    def count_program(event: str, duration_secs: float, **_: Any) -> None:
        counts["programs"] += "backend_compile" in event

    def count_miss(event: str, **_: Any) -> None:
        counts["misses"] += event == "/jax/compilation_cache/cache_misses"

    jax.monitoring.register_event_duration_secs_listener(count_program)
    jax.monitoring.register_event_listener(count_miss)

    def measure(name: str, run: Callable[[], Any]) -> Any:
        before, start = counts["programs"], process_time()
        result = run()
        found[name] = {
            "seconds": process_time() - start,
            "programs": counts["programs"] - before,
        }
        return result

    J, R0, pi0 = np.diag([1.0, 2.0, 2.8]), np.eye(3), np.array([0.1, 0.2, 0.3])

    def forward(J, R0, pi0, dt):
        return lgvi.simulate_free_rigid_body(R0, pi0, J, dt, 100)

    def scalar(*arguments):
        Rs, pis, _ = forward(*arguments)
        return jax.numpy.sum(Rs**3) + jax.numpy.sum(pis**3)

    def under_law(J, R0, pi0, kappa):
        def torque(_, R):
            return kappa * jax.numpy.cross(R[2], jax.numpy.array([0.0, 0.0, 1.0]))

        integrator = lgvi.MoserVeselovIntegrator(0.01, order=4, throw=False)
        body = lgvi.RigidBody(J)
        return jax.numpy.sum(integrator.simulate(body, R0, pi0, steps=100, torque=torque).R ** 3)

    gradient = jax.grad(scalar, argnums=(0, 1, 2, 3))
    of_law = jax.grad(under_law, argnums=(0, 1, 2, 3))
    batch = np.tile(R0, (10, 1, 1)), np.tile(pi0, (10, 1))
    several = jax.vmap(gradient, (None, 0, 0, None))
    for name, function, arguments in (
        ("forward", forward, (J, R0, pi0, 0.01)),
        ("gradient", gradient, (J, R0, pi0, 0.01)),
        ("batch gradient", several, (J, *batch, 0.01)),
        ("force gradient", of_law, (J, R0, pi0, 1.0)),
    ):
        if name in parts:
            measure(name, jax.jit(function).lower(*arguments).compile)
    if "identify" in parts:
        _identify(measure)
    if "identify with a rotor" in parts:
        _identify_with_a_rotor(measure)
    if "eager" in parts:
        _eager(measure)
    return found | {"misses": counts["misses"]}


def _identify(measure: Callable[..., Any]) -> None:
    """Nine throws of forty attitudes; with one dropped, and with two more."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    import lgvi
    from lgvi.identification import Model, Recordings, identify

    from .systems import euler_equations, inertia, rng, rotation

    random, t = rng(200), 0.02 * np.arange(40)
    J = inertia([2.1e-3, 3.0e-3, 4.2e-3], rotation(200))
    throws = []
    for i in range(11):
        R, _ = euler_equations(np.eye(3), J @ (2.5 * random.normal(size=3)), J, t)
        noisy = Rotation.from_matrix(R) * Rotation.from_rotvec(2e-3 * random.normal(size=(40, 3)))
        throws.append(Recordings.from_arrays(t, attitude=noisy, name=str(i)))
    nine, eleven = Recordings.concatenate(throws[:9]), Recordings.concatenate(throws)
    start = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 1.0, 1.0])
    sensor = lgvi.AttitudeSensor(2e-3)
    first = measure("identify", lambda: identify(Model(start, sensor), nine))
    measure("report", lambda: str(first))
    measure("identify again", lambda: identify(Model(start, sensor), nine))
    dropped = measure(
        "identify, one dropped", lambda: identify(Model(start, sensor), nine.drop("3"))
    )
    measure("report of it", lambda: str(dropped))
    measure("identify, two more", lambda: identify(Model(start, sensor), eleven))


def _identify_with_a_rotor(measure: Callable[..., Any]) -> None:
    """Nine throws of half a second with a rotor that speeds up, and a gyroscope at 500 Hz."""
    import numpy as np

    import lgvi
    from lgvi.identification import Model, Recordings, identify

    from .systems import euler_equations, inertia, rng, rotation

    random, t, spin_inertia = rng(201), 0.002 * np.arange(250), 1.5e-5
    J = inertia([2.1e-3, 3.0e-3, 4.2e-3], rotation(201))

    def speed(t: float) -> np.ndarray:
        return np.array([0.0, 0.0, 100.0 + 200.0 * t])

    def momentum(t: float) -> np.ndarray:
        return spin_inertia * speed(t)

    throws, speeds = [], np.stack([speed(time) for time in t])
    for i in range(9):
        pi0 = J @ (6 * random.normal(size=3)) + momentum(0.0)
        _, pi = euler_equations(np.eye(3), pi0, J, t, None, momentum)
        rates = np.linalg.solve(J, (pi - spin_inertia * speeds).T).T
        rates += 0.02 * random.normal(size=rates.shape)
        throws.append(
            Recordings.from_arrays(t, angular_velocity=rates, rotor_momentum=speeds, name=str(i))
        )
    recordings = Recordings.concatenate(throws)
    start = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 1.0, 1.0])
    sensor = lgvi.Gyroscope(0.02)
    measure(
        "identify with a rotor",
        lambda: identify(Model(start, sensor, rotor_inertia=spin_inertia), recordings),
    )


def _eager(measure: Callable[..., Any]) -> None:
    """Calls outside of `jax.jit`, that raise where a step fails."""
    import jax.numpy as jnp

    import lgvi

    moments = [1.0, 2.0, 2.5]
    body = measure("body", lambda: lgvi.PhysicalRigidBody.from_principal_moments(moments))
    integrator = lgvi.MoserVeselovIntegrator(0.1)
    pi0 = jnp.array([0.1, 0.2, 0.3])

    def fails(run: Callable[[], Any]) -> bool:
        try:
            run()
        except Exception as error:
            return "did not converge" in str(error)
        return False

    def calls() -> None:
        integrator.simulate(body, jnp.eye(3), pi0, steps=20)
        integrator.step(body, jnp.eye(3), pi0)
        assert fails(lambda: integrator.simulate(body, jnp.eye(3), 100 * pi0, steps=20))
        assert fails(lambda: integrator.step(body, jnp.eye(3), 100 * pi0))

    measure("eager", calls)


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
