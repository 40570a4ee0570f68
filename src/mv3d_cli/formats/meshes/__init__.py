"""Mesh files: finding, reading and writing them, whatever their format."""

from mv3d_cli.formats.meshes.finding import SUFFIXES, MeshFile, Up, find_meshes
from mv3d_cli.formats.meshes.reading import mesh_sources, read_mesh
from mv3d_cli.formats.meshes.writing import WRITTEN_SUFFIXES, write_mesh
from mv3d_cli.formats.textures import MeshWarning

__all__ = [
    "SUFFIXES",
    "WRITTEN_SUFFIXES",
    "MeshFile",
    "MeshWarning",
    "Up",
    "find_meshes",
    "mesh_sources",
    "read_mesh",
    "write_mesh",
]
