"""Fits on eight virtual devices against the same fits on one: it prints one line of JSON.

Devices are made when JAX starts, which `tests.sharding` tells how many.
"""

import json
from typing import Any, cast

import equinox as eqx
import jax
import numpy as np
import pytest

import lgvi
from lgvi.identification import Model, identify, identify_jointly
from lgvi.identification.least_squares import linearise, pieces
from lgvi.identification.least_squares.window_qr import factorise as compiled_factorise
from lgvi.identification.windows import group

from ..sharding import COUNT, collectives
from .recorded import ISOTROPIC, MODEL, trajectories

factorise = cast(Any, compiled_factorise).__wrapped__
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
    """What devices tell each other in the programs of a fit, and how many windows each has."""
    told, parts = [], []

    def looked_at(*arguments, few):
        program: Any = eqx.filter_jit(factorise)
        told.extend(collectives(program.lower(*arguments).compile().compiled))
        found = program(*arguments)
        parts.append([len(shard.data) for shard in found.triangle.addressable_shards])
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linearise, "factorise", looked_at)
        identify(MODEL, recordings, iterations=1, mesh=MESH)
    return {"told": told, "parts": parts[0]}


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
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(group, "SMALL", 0)
        patch.setattr(pieces, "PIECE", 12)
        found["pieces"] = differences(lambda mesh: identify(MODEL, recordings, mesh=mesh))
    return found


if __name__ == "__main__":
    print(json.dumps(main()))
