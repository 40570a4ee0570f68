"""`mv3d export`: meshes and fits into mesh files.

A fit's mesh is made from its field again, as the settings ask; the mesh of a file stays as it is but for what is
asked. OBJ and PLY refer to their pictures by name, so they are made under the name that they will have.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from mv3d_cli.errors import BadMesh, DamagedArtifact, MissingInput, OutputRefused, UsageError
from mv3d_cli.steps.settings import Between, Doc, Runtime, Tell, Warned, check, key_config, silent
from mv3d_cli.store import Artifact, Recipe, digest_of_file, find_artifact, maker_of, open_artifact, produce
from mv3d_cli.store.cache import folder_of, hold

if TYPE_CHECKING:
    from mv3d_cli.formats.meshes import MeshFile
    from mv3d_cli.scene.mesh import Mesh

VERSION = 1  # bumped when the same settings and inputs give other bytes
FIT = "fit-sdf"
FIT_FACES = 30_000
LEAST_FACES = 4
SUFFIXES = (".glb", ".obj", ".ply", ".stl")
REFERRING = (".obj", ".ply")  # their pictures are files of their own

Format = Literal["auto", "glb", "obj", "ply", "stl"]
Up = Literal["auto", "y", "z"]


@dataclass(frozen=True)
class Config:
    """Settings of `mv3d export`."""

    format: Annotated[Format, Doc("Of the file; auto: as -o ends, else glb."), Runtime()] = "auto"
    faces: Annotated[
        int, Doc("About this many faces; 0: a mesh file's own, 30000 of a fit."), Between(0, 10_000_000)
    ] = 0
    texture: Annotated[int, Doc("Texels a side, of a fit or a simplified mesh."), Between(16, 8192)] = 1024
    vertex_colors: Annotated[bool, Doc("Colours at the vertices instead of a texture.")] = False
    resolution: Annotated[int | None, Doc("Of a fit: cells along the longest edge."), Between(32, 1024)] = None
    height_mm: Annotated[
        float | None, Doc("Height of the object, millimetres; glb is then in metres."), Between(1e-3, 1e6)
    ] = None
    up: Annotated[Up, Doc("Up axis of the file to write; auto: y in glb and obj, z in ply and stl.")] = "auto"
    input_up: Annotated[Up, Doc("Up axis of the mesh to read; auto: the same, z also in scanned sets.")] = "auto"


def main_file(config: Config, output: Path | None = None) -> str:
    """The name of the mesh in the artifact. Raises OutputRefused for an `output` that ends in another format."""
    suffix = f".{config.format}"
    named = output if output is not None and output.suffix and not output.is_dir() else None
    if config.format == "auto":
        suffix = named.suffix.lower() if named is not None else ".glb"
    if suffix not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise OutputRefused(f"{suffix} is not a format that we write", f"End -o in one of {known}, or give a folder.")
    return f"{named.stem}{suffix}" if named is not None and suffix in REFERRING else f"mesh{suffix}"


def run(config: Config, inputs: Sequence[Path], tell: Tell = silent, main: str | None = None) -> Artifact:
    """The mesh of a file or of a fit as the file `main`.

    Raises UsageError, MissingInput, BadMesh, OutputRefused for what the format cannot say, WorkFailed where it cannot
    be simplified, DamagedArtifact.
    """
    check(config)
    main = main or main_file(config)
    if len(inputs) != 1:
        raise UsageError(f"one mesh or fit is wanted, not {len(inputs)}", "run the command once for each")
    if 0 < config.faces < LEAST_FACES:
        raise UsageError(f"--faces {config.faces} is not enough for a solid", f"take {LEAST_FACES} or more")
    settings = key_config(config) | {"main": main}
    source = _source(inputs[0], tell)
    if isinstance(source, Artifact):
        recipe = Recipe("export", VERSION, settings, {"fit": source.digest}, sources={"fit": str(source.path)})
        build = partial(_write_fit, config, source.path, main)
    else:
        files = _files(source)
        digests = {label: digest_of_file(path) for label, path in files.items()}
        sources = {label: str(path) for label, path in files.items()}
        recipe = Recipe("export", VERSION, settings, digests, sources=sources)
        build = partial(_write_mesh, config, source, main, tell)
    return produce(recipe, build, main=main, on_notice=lambda text: tell(Warned(text)))


def _source(path: Path, tell: Tell) -> Artifact | MeshFile:
    """The fit that a path is, is a part of or was delivered from; or else the mesh that it is."""
    made = maker_of(path) if path.exists() else None
    if made is not None and made["step"] == FIT:
        if made["edited"]:
            tell(Warned(f"{path} was changed since it was made; its mesh is exported, not the fit"))
            return _mesh_file(path)
        try:
            return _fit_of(path, made["key"])
        except (MissingInput, DamagedArtifact):
            tell(Warned(f"the fit that {path} came from is not in the cache any more; its mesh is exported as it is"))
    return _mesh_file(path)


def _fit_of(path: Path, key: str) -> Artifact:
    """The artifact around a path, or in the cache. Raises MissingInput or DamagedArtifact."""
    around = find_artifact(path)
    if around is not None:
        return open_artifact(around.path)
    folder = folder_of(FIT, key)
    hold(folder)
    return open_artifact(folder)


def _mesh_file(path: Path) -> MeshFile:
    """The one mesh that a path is or holds. Raises MissingInput or UsageError."""
    from mv3d_cli.formats.meshes import SUFFIXES as READ
    from mv3d_cli.formats.meshes import MeshFile, find_meshes

    artifact = find_artifact(path) if path.is_dir() else None
    if artifact is not None and artifact.main is not None and artifact.main.suffix in READ:
        return MeshFile(artifact.main.stem, artifact.main)
    if (path / "transforms.json").is_file():
        raise UsageError(f"{path} holds views, not a mesh", f"make a mesh of them first: mv3d {FIT} {path}")
    if artifact is not None and artifact.step == "render":
        raise UsageError(f"{path} is a data set of views, not a mesh", "give a mesh file")
    found = find_meshes(path)
    if len(found) != 1:
        raise UsageError(f"{path} holds {len(found)} meshes", f"give one of them, such as {found[0].path}")
    return found[0]


def _files(file: MeshFile) -> dict[str, Path]:
    """The files that a mesh is read from, by their places seen from it."""
    from mv3d_cli.formats.meshes import mesh_sources

    first, *others = mesh_sources(file)
    return {"mesh": first} | {Path(os.path.relpath(path, first.parent)).as_posix(): path for path in others}


def _write_fit(config: Config, fit: Path, main: str, folder: Path) -> None:
    from mv3d_cli.steps.sdf_fit import MeshSettings, mesh_of_fit

    asked = MeshSettings(
        faces=config.faces or FIT_FACES,
        texture=config.texture,
        vertex_colors=config.vertex_colors or main.endswith(".stl"),  # which are quick to make, and left out
        resolution=config.resolution,
    )
    _write(config, mesh_of_fit(fit, asked), folder / main, "scene unit (unit-sphere radius = 1)")


def _write_mesh(config: Config, file: MeshFile, main: str, tell: Tell, folder: Path) -> None:
    from mv3d_cli.formats.meshes import read_mesh
    from mv3d_cli.meshes.appearance import is_plain

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = read_mesh(file, config.input_up)
    for warning in caught:
        tell(Warned(str(warning.message)))
    path = folder / main
    if path.suffix == ".stl" and not is_plain(mesh):
        tell(Warned(f"{file.path}: an STL has no colours; they are left out"))
    _write(config, _as_asked(config, mesh, path.suffix, tell), path, "that of the mesh it was made from")


def _as_asked(config: Config, mesh: Mesh, suffix: str, tell: Tell) -> Mesh:
    """The mesh simplified, and its look where the settings want it. Raises WorkFailed."""
    from mv3d_cli.meshes import appearance
    from mv3d_cli.meshes.simplify import simplified

    fewer = 0 < config.faces < len(mesh.faces)
    if not fewer and not (config.vertex_colors and suffix != ".stl"):
        return mesh
    if suffix != ".stl" and not appearance.is_opaque(mesh):
        tell(Warned("the mesh has transparent parts; they become opaque"))
    if not fewer:
        return appearance.with_vertex_colors(mesh)
    bare = simplified(mesh, config.faces)
    if suffix == ".stl" or appearance.is_plain(mesh):
        return appearance.plain_as(bare, mesh) if appearance.is_plain(mesh) else bare
    if config.vertex_colors or (mesh.colors is not None and not appearance.is_textured(mesh)):
        return appearance.carried_to_vertices(bare, mesh)
    return appearance.carried_to_texture(bare, mesh, config.texture)


def _write(config: Config, mesh: Mesh, path: Path, unit: str) -> None:
    """Write the mesh at its size. Raises BadMesh for one without a height, OutputRefused."""
    from mv3d_cli.formats.meshes import write_mesh

    scale = 1.0
    if config.height_mm is not None:
        heights = mesh.vertices[mesh.faces][..., 2].astype(float)
        height = float(heights.max() - heights.min())
        if height <= 0:
            raise BadMesh("the mesh is flat along its up axis, so it has no height", "name its up axis: --input-up")
        glb = path.suffix == ".glb"
        scale, unit = config.height_mm / height / (1000 if glb else 1), "metre" if glb else "millimetre"
    try:
        write_mesh(path, mesh, up=config.up, scale=scale, unit=unit)
    except OutputRefused as refusal:
        if config.vertex_colors or path.suffix not in REFERRING:
            raise
        raise OutputRefused(str(refusal), f"{refusal.hint} Or give --vertex-colors.") from refusal
