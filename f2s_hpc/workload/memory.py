"""Memory of a rank, predicted: the interpreter with its libraries, and what grows with the cells."""

from __future__ import annotations

import math

from f2s_hpc import fields
from f2s_hpc.config.schema import Scene
from f2s_hpc.grid.box import Part

BASELINE = 150 * 2**20
"""Interpreter, numpy, numba, PETSc, MPI, HDF5 and the compiled kernels, before any field is allocated (bytes)."""


def of_fields(scene: Scene, part: Part) -> int:
    """Return the bytes of all fields of a rank, ghosts included."""
    needed = fields.needed(scene.mie_grueneisen, scene.numerics.loss_heating, scene.output.origin)
    cells, nodes = math.prod(part.cell_shape), math.prod(part.node_shape)
    return 8 * sum(nodes if f.location == fields.NODE else cells for f in needed)


def of_rank(scene: Scene, part: Part, ranks: int) -> int:
    """Return the largest memory (bytes) of a rank that owns ``part`` while it runs."""
    return BASELINE + of_fields(scene, part)
