"""A batch on eight virtual devices against the same batch on one: it prints one line of JSON.

Devices are made when JAX starts, so this is a program of its own.
"""

import json
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import lgvi

COUNT = 8
jax.config.update("jax_num_cpu_devices", COUNT)
jax.config.update("jax_enable_x64", True)
BODIES, STEPS = 8 * COUNT, 50
COLLECTIVES = r" (all-gather|all-reduce|all-to-all|collective-\w+|reduce-scatter)(?:-start)?\("


def simulate_freely(J, pi0):
    body = lgvi.RigidBody(jnp.diag(J))
    integrator = lgvi.MoserVeselovIntegrator(dt=0.1, order=6)
    return integrator.simulate(body, jnp.eye(3), pi0, steps=STEPS)


def simulate_pendulum(J, pi0):
    body, weight = lgvi.RigidBody(jnp.diag(J)), lgvi.UniformGravity(1.0, jnp.array([0.1, 0.0, 0.2]))
    integrator = lgvi.MoserVeselovIntegrator(dt=0.1)
    return integrator.simulate(body, jnp.eye(3), pi0, steps=STEPS, torque=weight)


def with_gradient(simulate):
    """The gradient of a sum over the batch, and the trajectories."""

    def loss(J, pi0):
        trajectories = jax.vmap(simulate)(J, pi0)
        return jnp.sum(trajectories.R[:, -1, 0, 1]), trajectories

    return jax.jit(jax.grad(loss, (0, 1), has_aux=True))


def bytes_of(program) -> int:
    memory = program.memory_analysis()
    return memory.temp_size_in_bytes + memory.output_size_in_bytes


def collectives(program) -> list[tuple[str, int]]:
    """What devices tell each other: the kinds of operations, with the most numbers of one array."""
    found: dict[str, int] = {}
    for line in (program.as_text() or "").splitlines():
        if match := re.search(COLLECTIVES, line):
            shapes = re.findall(r"\w\[([\d,]*)\]", line[: match.start()])
            sizes = [int(np.prod([int(n) for n in shape.split(",") if n])) for shape in shapes]
            found[match[1]] = max(found.get(match[1], 0), *sizes)
    return sorted(found.items())


def compare(simulate, arguments, sharded) -> dict[str, Any]:
    function = with_gradient(simulate)
    programs = [function.lower(*given).compile() for given in (arguments, sharded)]
    alone, together = (
        jax.tree.leaves(run(*given))
        for run, given in zip(programs, (arguments, sharded), strict=True)
    )
    differences = [
        np.max(abs(1.0 * np.asarray(a) - b)) / max(1.0, np.max(abs(a * 1.0)))
        for a, b in zip(alone, together, strict=True)
    ]
    return {
        "difference": float(np.max(differences)),
        "collectives": collectives(programs[1]),
        "memory": bytes_of(programs[1]) / bytes_of(programs[0]),
    }


def main() -> dict[str, Any]:
    random = np.random.default_rng(0)
    J = random.uniform(1.0, 1.3, (BODIES, 3))
    pi0 = random.normal(size=(BODIES, 3))
    mesh = jax.make_mesh((COUNT,), ("batch",), axis_types=(AxisType.Auto,))
    along = NamedSharding(mesh, PartitionSpec("batch"))
    arguments = jnp.asarray(J), jnp.asarray(pi0)
    sharded = tuple(jax.device_put(x, along) for x in arguments)
    found: dict[str, Any] = {
        "free": compare(simulate_freely, arguments, sharded),
        "pendulum": compare(simulate_pendulum, arguments, sharded),
    }

    by_device = jax.shard_map(
        jax.vmap(simulate_freely),
        mesh=mesh,
        in_specs=PartitionSpec("batch"),
        out_specs=PartitionSpec("batch"),
        check_vma=False,
    )
    found["by_device"] = collectives(jax.jit(by_device).lower(*sharded).compile())

    # One body spins too fast; also where the other devices wait for a sum, and on one device alone.
    too_fast = jnp.asarray(pi0).at[-3].set(jnp.array([40.0, 0.0, 0.0]))
    fast = sharded[0], jax.device_put(too_fast, along)
    found["errors"] = {
        "batch": error_of(jax.jit(jax.vmap(simulate_freely)), *fast),
        "gradient": error_of(with_gradient(simulate_freely), *fast),
        "one device": error_of(jax.jit(jax.vmap(simulate_freely)), arguments[0], too_fast),
        "not compiled": error_of(jax.vmap(simulate_freely), *fast),
    }
    found["eager_error"] = error_of(simulate_freely, J[-3], too_fast[-3])
    found["cause"] = f"|h J^-1 pi| is {0.1 * 40.0 / J[-3, 0]:.3g}"
    return found


def error_of(function, *arguments) -> str | None:
    try:
        jax.block_until_ready(function(*arguments))
    except RuntimeError as error:
        return str(error)
    return None


if __name__ == "__main__":
    print(json.dumps(main()))
