"""Fits on eight virtual devices against the same fits on one: it prints one line of JSON.

Devices are made when JAX starts, which `tests.sharding` tells how many.
"""

import json
from typing import Any

import equinox as eqx
import jax
import numpy as np

import lgvi
from lgvi.identification import Model, identify, identify_jointly
from lgvi.identification.model.free_leaves import ravel
from lgvi.identification.running.compilation import as_mesh
from lgvi.identification.segments.programs import advance_batch, differentiate_batch
from lgvi.identification.segments.segment import lay_out, whole_trajectories

from ...sharding import COUNT, collectives
from ..recorded import ISOTROPIC, MODEL, trajectories

MESH = jax.make_mesh((COUNT,), ("bodies",))


def differences(fit) -> list[float]:
    """Of the estimate, its information and residuals on all devices from those on one."""
    alone, together = fit(None), fit(MESH)
    pairs = [
        (alone.free.theta, together.free.theta),
        (alone.information.singular_values(), together.information.singular_values()),
        *(
            (residuals, together.parts[name].residuals["attitude"])
            for name, part in alone.parts.items()
            for residuals in [part.residuals["attitude"]]
        ),
    ]
    return [float(np.max(abs(a - b)) / np.max(abs(a))) for a, b in pairs]


def programs(recordings) -> dict[str, Any]:
    """What devices tell each other in the programs of a fit, and how many segments each has."""
    told, parts = [], []
    segments = table_of(recordings)
    R, count = np.array(segments.readings["attitude"][:, 0]), len(segments.dt)
    leaves = np.tile(ravel(eqx.filter(MODEL, eqx.is_inexact_array)), (count, 1))
    method = lgvi.MoserVeselovIntegrator(1.0, throw=False)
    mesh = as_mesh(MESH)
    given = MODEL, leaves, R, np.ones((count, 3)), segments, method, mesh
    motion = program(advance_batch, told, *given).motion
    local = program(differentiate_batch, told, MODEL, leaves, R, segments, motion, method, mesh)
    for found in (motion.c.x, local.by_momentum):
        parts.append([len(shard.data) for shard in found.addressable_shards])
    return {"told": told, "parts": parts}


def program(function, told, *arguments):
    """What a program gives, and what it makes devices tell each other."""
    compiled: Any = eqx.filter_jit(function.__wrapped__)
    told.extend(collectives(compiled.lower(*arguments).compile().compiled))
    return compiled(*arguments)


def table_of(recordings):
    """A whole number of segments for each device."""
    (chains,) = lay_out(
        recordings, [whole_trajectories(recordings)], np.full(len(recordings), 0.05), MODEL
    )
    segments = chains.table(np.zeros(1)).segments
    count = len(segments.dt) // COUNT * COUNT
    return jax.tree.map(lambda x: x[:count], segments)


def main() -> dict[str, Any]:
    recordings = trajectories(10)
    robust = Model(ISOTROPIC, lgvi.AttitudeSensor(1e-3, loss=lgvi.Huber(2.0)))
    one, other = recordings.select(recordings.names[:3]), recordings.select(recordings.names[3:])

    def with_sensor(body):
        return Model(body, lgvi.AttitudeSensor(1e-3))

    def jointly(mesh):
        parts = {"a": (with_sensor, one), "b": (with_sensor, other)}
        return identify_jointly(ISOTROPIC, parts, mesh=mesh)

    found: dict[str, Any] = {
        "segments": differences(lambda mesh: identify(robust, one, segment=0.6, mesh=mesh)),
        "joint": differences(jointly),
        "program": programs(recordings),
    }
    with jax.set_mesh(MESH):
        found["mesh of all"] = differences(lambda mesh: identify(robust, one, mesh=mesh))
    return found


if __name__ == "__main__":
    print(json.dumps(main()))
