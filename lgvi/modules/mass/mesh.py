"""Volume, centre and inertia of the solid inside a mesh, by trimesh."""

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np


def measure_mesh(mesh: Any) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, m³, its centre (3,), m, and inertia (3, 3) about it at a density of 1, m⁵.

    Raises
    ------
    ValueError, TypeError
        If it is not a closed mesh.
    FileNotFoundError, ImportError
        If the file or trimesh is missing.
    """
    try:
        import trimesh
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'A mesh needs the package trimesh: `pip install trimesh`, or the extra "mesh".'
        ) from error

    path = mesh
    if isinstance(mesh, (str, PathLike)):
        path = Path(mesh)
        if not path.is_file():
            raise FileNotFoundError(
                f"Argument `mesh` must be the path of a file that exists, but is {str(path)!r}."
            )
        try:
            mesh = trimesh.load(path, force="mesh")
        except (ValueError, NotImplementedError) as error:
            raise ValueError(
                f"Argument `mesh` must be the path of a mesh that trimesh reads, but {str(path)!r} "
                f"is not: {error}"
            ) from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise TypeError(
            f"Argument `mesh` must be a `trimesh.Trimesh` or the path of a file, but is {path!r}."
        )
    if not mesh.is_volume:
        raise ValueError(
            "Argument `mesh` must be closed, with all faces turned outwards, but is not: trimesh's "
            f"`is_watertight` is {mesh.is_watertight}, `is_winding_consistent` is "
            f"{mesh.is_winding_consistent}, and the volume {mesh.volume:.6g}."
        )
    # Of the surface alone: a mesh may carry a centre or a density that somebody has set.
    properties = trimesh.triangles.mass_properties(mesh.triangles, density=1.0)
    return float(properties.volume), np.array(properties.center_mass), np.array(properties.inertia)
