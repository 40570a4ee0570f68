"""The store: the same recipe is made once, whole or not at all, and every changed byte is found."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mv3d_cli import errors, store
from mv3d_cli.store import Recipe, produce
from mv3d_cli.store.disk import copy_file
from mv3d_cli.store.production import Build

# A step in a process of its own: argv = [log, slow seconds, resumable]; every build adds a line to the log.
SCRIPT = """
import sys, time
from pathlib import Path
from mv3d_cli.store import Recipe, produce
log, slow, resumable = Path(sys.argv[1]), float(sys.argv[2]), sys.argv[3] == "resumable"
def build(work):
    with log.open("a") as file: file.write("built\\n")
    for part in range(8):
        if not (work / f"{part}.bin").exists():
            time.sleep(slow / 8)
            (work / f"{part}.part").write_bytes(bytes([part]) * 400_000)
            (work / f"{part}.part").rename(work / f"{part}.bin")
print(produce(Recipe("slow", 1, {"parts": 8}, {}), build, resumable=resumable).path)
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def start(log: Path, slow: float = 0.0, resumable: bool = False) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", SCRIPT, str(log), str(slow), "resumable" if resumable else "once"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def writes(**files: str) -> Build:
    def build(work: Path) -> None:
        for name, text in files.items():
            path = work / name.replace("__", "/").replace("_", ".")
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)

    return build


def recipe(step: str = "paint", **config: object) -> Recipe:
    return Recipe(step, 1, config, {"photo": "0" * 64})


def everything_in(folder: Path) -> set[str]:
    """What lies in the cache, locks aside: some versions of filelock leave them and some do not."""
    found = {path.name for path in folder.rglob("*") if not path.is_dir() or path.suffix in (".tmp", ".work")}
    return {name for name in found if not name.endswith(".lock")}


def test_made_once_then_found_with_its_whole_manifest():
    hits = []
    first = produce(recipe(size=(1, 2)), writes(sub__b_txt="b", mesh_glb="m"), main="mesh.glb", device="cpu")
    again = produce(recipe(size=[1, 2]), writes(), main="mesh.glb", on_hit=hits.append)
    assert again == first
    assert hits == [again]
    assert first.main == first.path / "mesh.glb"
    assert first.digest == store.digest_of_folder(first.path)
    assert first.manifest["files"]["sub/b.txt"] == [hashlib.sha256(b"b").hexdigest(), 1]
    assert first.manifest["config"] == {"size": [1, 2]}
    assert first.manifest["versions"]["numpy"]
    assert store.open_artifact(first.path) == first
    assert store.find_artifact(first.path / "sub") == store.find_artifact(first.path / "sub" / "b.txt") == first


def test_two_processes_do_the_work_once(tmp_path):
    racers = [start(tmp_path / "log", slow=0.3) for _ in range(3)]
    results = {racer.communicate()[0] for racer in racers}
    assert len(results) == 1
    assert (tmp_path / "log").read_text() == "built\n"
    assert store.is_intact(store.open_artifact(Path(results.pop().strip())))


@pytest.mark.parametrize("resumable", [False, True])
def test_killed_at_any_moment_leaves_a_whole_artifact_or_none(tmp_path, cache, resumable):
    chance = random.Random(5)
    for _ in range(6):
        process = start(tmp_path / "log", slow=0.1, resumable=resumable)
        time.sleep(0.12 + 0.25 * chance.random())
        process.send_signal(signal.SIGKILL)
        process.communicate()
        for manifest in cache.glob("v1/slow/*/*/artifact.json"):
            if manifest.parent.suffix == "":
                assert store.is_intact(store.open_artifact(manifest.parent))
    output, said = start(tmp_path / "log", resumable=resumable).communicate()
    assert store.is_intact(store.open_artifact(Path(output.strip()))), said
    assert everything_in(cache) == {*(f"{part}.bin" for part in range(8)), "artifact.json"}


@pytest.mark.parametrize("harm", ["flip", "shorten", "remove", "add", "manifest", "no manifest", "a file instead"])
def test_damage_is_found_said_and_made_again(harm):
    made = produce(recipe(), writes(a_txt="hello", b_txt="world"))
    if harm in ("flip", "shorten"):
        (made.path / "a.txt").write_text("jello" if harm == "flip" else "hell")
    elif harm == "add":
        (made.path / "c.txt").write_text("")
    elif harm == "manifest":
        (made.path / "artifact.json").write_text(
            (made.path / "artifact.json").read_text().replace('"paint"', '"point"')
        )
    else:
        victim = made.path / ("a.txt" if harm == "remove" else "artifact.json")
        victim.unlink()
    if harm == "a file instead":
        (made.path / "b.txt").unlink()
        (made.path / "a.txt").unlink()
        made.path.rmdir()
        made.path.write_text("?")
    said: list[str] = []
    again = produce(recipe(), writes(a_txt="hello", b_txt="world"), on_notice=said.append)
    assert "damaged" in said[0]
    assert len(said) == 1
    assert store.is_intact(again)
    assert again.digest == made.digest


def test_many_files_are_hashed_too():
    made = produce(recipe(), lambda work: [(work / str(i)).write_text(str(i)) for i in range(300)])
    assert store.is_intact(made)
    (made.path / "217").write_text("712")
    assert store.damage_of(made) == ("217 has other bytes",)


def test_a_build_that_fails_leaves_nothing(cache):
    def fail(work: Path) -> None:
        (work / "half").write_text("written")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        produce(recipe(), fail)
    with pytest.raises(ValueError, match=r"promised mesh\.glb"):
        produce(recipe(), writes(a_txt="a"), main="mesh.glb")
    assert everything_in(cache) == set()


def test_resumable_work_is_handed_again_until_it_is_done(cache):
    def fail(work: Path) -> None:
        (work / "checkpoint").write_text("epoch 3")
        raise KeyboardInterrupt

    def resume(work: Path) -> None:
        assert (work / "checkpoint").read_text() == "epoch 3"
        (work / "checkpoint").rename(work / "model")

    with pytest.raises(KeyboardInterrupt):
        produce(recipe(), fail, resumable=True)
    made = produce(recipe(), resume, resumable=True)
    assert [*made.manifest["files"]] == ["model"]
    assert made.manifest["resumed"] is True
    assert not [*cache.rglob("*.work")]


@pytest.mark.parametrize("wrapped", [False, True])
def test_a_size_limit_is_out_of_space_and_leaves_nothing(cache, wrapped):
    script = f"""
import resource
from mv3d_cli import errors
from mv3d_cli.store import Recipe, produce
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
def build(work):
    try:
        (work / "big").write_bytes(bytes(200_000))
    except OSError as error:
        if {wrapped}:
            raise RuntimeError(f"encoder: {{error.strerror}}") from None
        raise
try:
    produce(Recipe("paint", 1, {{}}, {{}}), build)
except errors.OutOfSpace as error:
    print(error.hint)
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert "MV3D_CACHE_DIR" in said.stdout, said.stderr
    assert "mv3d cache prune" in said.stdout
    assert everything_in(cache) == set()


def test_a_cache_that_cannot_be_written_is_refused_with_its_name(cache):
    cache.write_text("a file where the folder should be")
    with pytest.raises(errors.OutputRefused, match="cannot write to") as caught:
        produce(recipe(), writes(a_txt="a"))
    assert "MV3D_CACHE_DIR" in caught.value.hint


def test_an_error_of_the_build_is_not_taken_for_the_cache():
    def fail(work: Path) -> None:
        raise PermissionError(13, "Permission denied", "photo.jpg")

    with pytest.raises(PermissionError, match=r"photo\.jpg"):
        produce(recipe(), fail)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[1]",
        "null",
        '{"schema": 1}',
        "[" * 100_000,
        "\xff",
        '{"checksum": "", "files": 3, "schema": 1}',
    ],
)
def test_a_strange_manifest_crashes_nothing(tmp_path, text):
    (tmp_path / "artifact.json").write_text(text, encoding="latin-1")
    (tmp_path / "photo.jpg").write_text("jpeg")
    assert store.find_artifact(tmp_path / "photo.jpg") is None
    assert store.maker_of(tmp_path) is None
    with pytest.raises(errors.DamagedArtifact):
        store.open_artifact(tmp_path)
    with pytest.raises(errors.OutputRefused):
        store.check_output(tmp_path)


@pytest.mark.parametrize("name", ["-", "x" * 5000, "null\0character"])
def test_a_strange_source_has_no_maker(name):
    made = produce(Recipe("paint", 1, {}, {"photo": "0"}, sources={"photo": name}), writes(a_txt="a"))
    assert made.manifest["inputs"][0]["made_by"] is None
    assert made.manifest["inputs"][0]["source"] == name


def test_copies_are_copies_where_blocks_cannot_be_shared(tmp_path):
    source = tmp_path / "source"
    source.write_bytes(os.urandom(300_000))
    places = [
        tmp_path / "copy",
        *(Path("/dev/shm") / f"mv3d-{os.getpid()}" for _ in "1" if Path("/dev/shm").is_dir()),
    ]
    for place in places:  # another file system never shares
        copy_file(source, place)
        assert place.read_bytes() == source.read_bytes()
        assert place.stat().st_ino != source.stat().st_ino or place.stat().st_dev != source.stat().st_dev
        place.write_bytes(b"edited")
        assert source.stat().st_size == 300_000
        place.unlink()
