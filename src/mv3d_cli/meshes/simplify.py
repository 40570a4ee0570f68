"""Fewer triangles: quadric edge collapse that stays closed and checks the count it reached."""

# pymeshlab defines its classes where type checkers do not look:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import numpy as np

from mv3d_cli.errors import WorkFailed
from mv3d_cli.meshes.repair import repaired, watertight, welded
from mv3d_cli.meshes.surface import mesh_of, with_normals
from mv3d_cli.scene.mesh import Mesh

TOLERANCE = 0.05
"""How far the count of faces may be from the one asked for."""


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """The bare surface with about `faces` faces, watertight if `mesh` is; a smaller mesh is returned as it is.

    Quadric edge collapse (Garland & Heckbert, 1997). Where the collapse ties the surface into itself, it is
    repaired; where that fails, MeshLab's slower collapse, which keeps the topology, takes its place.
    Raises WorkFailed where the count cannot be reached within 5 %.
    """
    if len(mesh.faces) <= faces:
        return mesh
    whole = watertight(mesh)
    bare = welded(mesh)
    made = _collapsed(bare, faces)
    if whole and not watertight(made):
        made = repaired(made)
    if whole and not watertight(made):
        made = _collapsed_with_topology(bare, faces)
    if len(made.faces) > faces * (1 + TOLERANCE):
        raise WorkFailed(
            f"the mesh has {len(mesh.faces)} faces and could be simplified to {len(made.faces)}, not to {faces}.",
            "Ask for more faces.",
        )
    return with_normals(made) if mesh.normals is not None else made


def _collapsed(bare: Mesh, faces: int) -> Mesh:
    import fast_simplification

    vertices, made, *_ = fast_simplification.simplify(bare.vertices, bare.faces, target_count=faces)
    return welded(mesh_of(vertices, np.asarray(made)))


def _collapsed_with_topology(bare: Mesh, faces: int) -> Mesh:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(bare.vertices.astype(np.float64), bare.faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=faces, preservetopology=True, preservenormal=True, optimalplacement=True, qualitythr=0.5
    )
    done = meshes.current_mesh()
    return mesh_of(done.vertex_matrix(), done.face_matrix())
