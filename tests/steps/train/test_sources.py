"""Objects found in what a user gives, told apart by their content, and drawn."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mv3d_cli.capture.examples import EVALUATION, Drawing, composited, example_from_mesh
from mv3d_cli.capture.rendering import render
from mv3d_cli.capture.shapes import procedural_mesh
from mv3d_cli.errors import BadCameras, BadMesh, BadViews, MissingInput, UsageError
from mv3d_cli.formats.cameras import load_cameras, select
from mv3d_cli.formats.images import read_image, write_png
from mv3d_cli.formats.views_folder import read_views, write_views
from mv3d_cli.scene.views import Views
from mv3d_cli.steps.train.sources import Source, digest_of_sources, example_of, sources_of, split

CLEAN = Drawing(size=8, **EVALUATION)


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A rendered data set of two objects, 8 px, with more views than are learnt."""
    rig = select(load_cameras(), ("front", "left", "right"))
    for seed in range(2):
        write_views(tmp_path / "dataset" / f"object_{seed}", render(procedural_mesh(seed), rig, 8, None))
    (tmp_path / "dataset" / "index.json").write_text("{}")
    return tmp_path / "dataset"


def test_objects_of_all_kinds_in_their_order(settings, dataset: Path, meshes: Path) -> None:
    found = sources_of(settings(procedural=2), [dataset, meshes, dataset / "object_1"])
    names = ["object_0", "object_1", "object_1", "box", "cone", "procedural_000000", "procedural_000001"]
    assert [source.name for source in found] == names
    kinds = [(source.views is not None, source.mesh is not None) for source in found]
    assert kinds == [(True, False)] * 3 + [(False, True)] * 2 + [(False, False)] * 2
    assert found[5].seed != found[6].seed
    assert found[5].seed != sources_of(settings(procedural=1, seed=1), [])[0].seed


def test_nothing_to_learn_from_is_told(settings, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to learn from") as caught:
        sources_of(settings(procedural=0), [])
    assert "--procedural" in caught.value.hint
    with pytest.raises(MissingInput, match="no mesh"):
        sources_of(settings(), [tmp_path])
    with pytest.raises(MissingInput, match="nowhere"):
        sources_of(settings(), [tmp_path / "nowhere"])


@pytest.mark.parametrize(("views", "advice"), [(("front", "lft"), "left"), (("front", "front"), "once")])
def test_views_that_are_not_in_the_rig_are_told_at_once(settings, views: tuple[str, ...], advice: str) -> None:
    with pytest.raises(BadCameras) as caught:
        sources_of(settings(procedural=1, views=views), [])
    assert advice in caught.value.hint
    with pytest.raises(UsageError, match="--views"):
        sources_of(settings(procedural=1, views=()), [])


def test_a_digest_is_of_content_and_names_and_not_of_places(settings, dataset: Path, meshes: Path) -> None:
    def digest(*inputs: Path, procedural: int = 1) -> str:
        return digest_of_sources(sources_of(settings(procedural=procedural), inputs))

    first = digest(dataset, meshes)
    moved = [Path(shutil.copytree(folder, folder.with_name("moved") / folder.name)) for folder in (dataset, meshes)]
    assert digest(*moved) == first
    digests = {first, digest(dataset, meshes, procedural=2), digest(dataset)}
    picture = moved[0] / "object_1" / "color" / "front.png"
    write_png(picture, 255 - read_image(picture))
    digests.add(digest(*moved))
    (moved[1] / "box.ply").write_bytes((meshes / "box.ply").read_bytes() + b"\n")
    digests.add(digest(*moved))
    (moved[1] / "cone.glb").rename(moved[1] / "horn.glb")
    digests.add(digest(*moved))
    assert len(digests) == 6


def test_some_are_held_out_by_their_names() -> None:
    sources = [Source(f"object_{i}", str(i)) for i in range(60)]
    training, spared = split(sources, 4)
    assert len(spared) == 4
    assert [s for s in sources if s not in spared] == training
    assert {s.name for s in split(sources[::-1], 4)[1]} == {s.name for s in spared}
    changed = [replace(source, digest="other") for source in sources]
    assert {s.name for s in split(changed, 4)[1]} == {s.name for s in spared}
    more = split([*sources, *(Source(f"new_{i}", str(i)) for i in range(6))], 4)[1]
    assert len({s.name for s in more} & {s.name for s in spared}) >= 2


@pytest.mark.parametrize("count", [1, 3, 31])
def test_few_objects_are_all_learnt_from(count: int) -> None:
    sources = [Source(f"object_{i}", str(i)) for i in range(count)]
    training, spared = split(sources, 4)
    assert training == sources
    assert len(spared) == min(count, 4)
    assert set(spared) <= set(sources)


def test_an_object_of_ours_is_its_mesh(settings) -> None:
    drawing = Drawing(size=8)
    ours = example_of(Source("a", "", seed=7), settings(), drawing, rng())
    by_hand = example_from_mesh(procedural_mesh(7), select(load_cameras(), ("front", "right")), drawing, rng())
    other = example_of(Source("a", "", seed=8), settings(), drawing, rng())
    assert all(np.array_equal(a, b) for a, b in zip(vars(ours).values(), vars(by_hand).values(), strict=True))
    assert not np.array_equal(ours.color, other.color)


def test_an_object_of_a_data_set_is_its_pictures(settings, dataset: Path) -> None:
    source = sources_of(settings(procedural=0), [dataset])[1]
    example = example_of(source, settings(views=("right", "front")), CLEAN, rng())
    views = {view.camera.name: view for view in read_views(dataset / "object_1").frames}
    for place, name in enumerate(("right", "front")):
        assert np.array_equal(example.color[place], composited(views[name].color, 255))
        assert np.array_equal(example.depth[place], views[name].depth)
        assert example.world_from_camera[place] == pytest.approx(views[name].camera.world_from_camera)
    assert np.array_equal(example.photo, example.color[0])


def test_a_data_set_that_does_not_fit_is_told(settings, dataset: Path) -> None:
    source = Source("object_0", "", views=dataset / "object_0")
    with pytest.raises(BadViews, match="no view back"):
        example_of(source, settings(views=("front", "back")), CLEAN, rng())
    with pytest.raises(BadViews, match="8 x 8 pixels, the model 16 x 16") as caught:
        example_of(source, settings(), replace(CLEAN, size=16), rng())
    assert "--size 16" in caught.value.hint
    views = read_views(source.views)
    write_views(dataset / "flat", Views(tuple(replace(view, depth=None) for view in views.frames)))
    with pytest.raises(BadViews, match="colour and depth"):
        example_of(Source("flat", "", views=dataset / "flat"), settings(), CLEAN, rng())


def test_a_broken_mesh_is_told(settings, broken: Source) -> None:
    with pytest.raises(BadMesh, match="broken"):
        example_of(broken, settings(), CLEAN, rng())
