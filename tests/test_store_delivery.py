"""What -o does: a copy, over what is ours and untouched, and over nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mv3d_cli import errors, store
from mv3d_cli.store import Artifact, Recipe, produce


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("MV3D_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def artifact(text: str = "mesh") -> Artifact:
    def build(work: Path) -> None:
        (work / "sub").mkdir()
        (work / "sub" / "view.png").write_text(f"view of {text}")
        (work / "mesh.glb").write_text(text)

    return produce(Recipe("paint", 1, {"text": text}, {}), build, main="mesh.glb")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(output: Path, made: Artifact, word: str) -> None:
    """Both the early and the late check refuse, name a remedy, and change nothing."""
    before = contents(output) if output.is_dir() else output.read_bytes()
    for attempt in (lambda: store.check_output(output, "mesh.glb"), lambda: store.deliver(made, output)):
        with pytest.raises(errors.OutputRefused, match=word) as caught:
            attempt()
        assert "-o" in caught.value.hint
    assert (contents(output) if output.is_dir() else output.read_bytes()) == before
    assert not [*output.parent.glob(".mv3d*")]


def test_a_folder_is_the_whole_artifact_and_its_own_copy(tmp_path):
    made, output = artifact(), tmp_path / "deep" / "er" / "views"
    store.check_output(output, "mesh.glb")
    assert store.deliver(made, output) == output
    assert contents(output) == contents(made.path)
    copy = store.open_artifact(output)
    assert (copy.digest, copy.key) == (made.digest, made.key)
    for path in made.path.rglob("*.png"):
        assert path.stat().st_nlink == 1
    (output / "mesh.glb").write_text("edited")
    assert store.is_intact(made)
    with pytest.raises(errors.DamagedArtifact):
        store.open_artifact(output)
    assert [path.name for path in output.parent.iterdir()] == ["views"]


def test_the_same_again_touches_nothing(tmp_path):
    made, folder, file = artifact(), tmp_path / "views", tmp_path / "mesh.glb"
    for output in (folder, file):
        store.deliver(made, output)
    before = [path.stat() for path in (folder, file)]
    for output in (folder, file):
        store.deliver(made, output)
    assert [path.stat().st_ino for path in (folder, file)] == [status.st_ino for status in before]


def test_ours_is_replaced(tmp_path):
    first, second = artifact("first"), artifact("second")
    for output in (tmp_path / "views", tmp_path / "mesh.glb", tmp_path / "empty"):
        if output.name == "empty":
            output.mkdir()
        else:
            store.deliver(first, output)
        store.check_output(output, "mesh.glb")
        store.deliver(second, output)
        main = output / "mesh.glb" if output.is_dir() else output
        assert main.read_text() == "second"
    assert not [*tmp_path.glob(".mv3d*")]


def test_a_link_is_followed_and_stays(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "real")
    store.deliver(artifact(), tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "mesh.glb").read_text() == "mesh"


@pytest.mark.parametrize(
    ("harm", "word"),
    [
        ("edit", "changed"),
        ("add", "changed"),
        ("add below", "changed"),
        ("remove", "changed"),
        ("forget", "not ours"),
    ],
)
def test_a_folder_that_people_worked_in_is_theirs(tmp_path, harm, word):
    output = tmp_path / "views"
    store.deliver(artifact("first"), output)
    if harm == "edit":
        (output / "sub" / "view.png").write_text("View of first")
    elif harm.startswith("add"):
        (output / ("sub/notes.txt" if harm == "add below" else "notes.txt")).write_text("mine")
    else:
        (output / ("mesh.glb" if harm == "remove" else "artifact.json")).unlink()
    refused(output, artifact("second"), word)


def test_files_that_are_not_ours_are_kept(tmp_path):
    made = artifact()
    foreign = tmp_path / "photos"
    foreign.mkdir()
    (foreign / "a.jpg").write_text("holiday")
    refused(foreign, made, "not ours")
    file = tmp_path / "mesh.glb"
    file.write_text("theirs")
    refused(file, made, "not an untouched file of ours")
    store.deliver(made, tmp_path / "ours.glb")
    (tmp_path / "ours.glb").write_text("mesh, edited")
    refused(tmp_path / "ours.glb", made, "not an untouched file of ours")
    plain = tmp_path / "plain"
    plain.write_text("a file")
    refused(plain, made, "is a file")
    same = tmp_path / "same.glb"
    same.write_text("mesh")
    store.deliver(made, same)


@pytest.mark.parametrize("name", ["mesh.obj", "file/below", "cache/v1/x", ".", "..", "n" * 300, "null\0"])
def test_outputs_that_cannot_be_are_refused_before_the_work(tmp_path, monkeypatch, name):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "file").write_text("")
    monkeypatch.chdir(tmp_path / "here")
    output = tmp_path / name if name.startswith("cache") else Path(name)
    with pytest.raises(errors.OutputRefused):
        store.check_output(output, "mesh.glb")


def test_a_delivery_without_space_leaves_nothing(tmp_path):
    made = produce(
        Recipe("big", 1, {}, {}),
        lambda work: (work / "mesh.glb").write_bytes(bytes(300_000)),
        main="mesh.glb",
    )
    script = f"""
import resource
from pathlib import Path
from mv3d_cli import errors, store
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
for name in ("views", "mesh.glb"):
    try:
        store.deliver(store.open_artifact(Path({str(made.path)!r})), Path({str(tmp_path)!r}) / name)
        print("blocks were shared")
    except errors.OutOfSpace as error:
        print(error.hint)
"""
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    if "shared" not in said.stdout:
        assert said.stdout.count("another disk") == 2, said.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["cache"]


def test_killed_deliveries_leave_the_old_or_the_new_and_are_cleaned_up(tmp_path):
    def build(work: Path) -> None:
        for index in range(300):
            (work / f"{index}.bin").write_bytes(os.urandom(2000))

    made = [produce(Recipe("many", version, {}, {}), build) for version in (1, 2)]
    output = tmp_path / "out" / "views"
    script = f"""
from pathlib import Path
from mv3d_cli import store
made = [store.open_artifact(Path(path)) for path in {[str(each.path) for each in made]!r}]
print("ready", flush=True)
while True:
    for each in made: store.deliver(each, Path({str(output)!r}))
"""
    for pause in (0.02, 0.05, 0.09, 0.14):
        process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(pause)
        process.kill()
        process.communicate()
        if output.exists():
            assert store.open_artifact(output).digest in {each.digest for each in made}
    store.deliver(made[0], output)
    store.deliver(made[1], output)
    assert [path.name for path in output.parent.iterdir()] == ["views"]


def test_processes_delivering_to_one_place_do_not_harm_each_other(tmp_path):
    made = [artifact("first"), artifact("second")]
    script = """
import sys
from pathlib import Path
from mv3d_cli import store
for _ in range(15):
    store.deliver(store.open_artifact(Path(sys.argv[1])), Path(sys.argv[2]))
"""
    for output in (tmp_path / "out" / "views", tmp_path / "out" / "mesh.glb"):
        racers = [
            subprocess.Popen([sys.executable, "-c", script, str(each.path), str(output)], stderr=subprocess.PIPE)
            for each in made
        ]
        for racer in racers:
            said = racer.communicate()[1]
            assert racer.returncode == 0, said.decode()
    assert store.is_intact(store.open_artifact(tmp_path / "out" / "views"))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["mesh.glb", "views"]


COMPANIONS = ("mesh.mtl", "mesh.png", "mesh.2.png")


def companied(text: str, *names: str) -> Artifact:
    """An artifact whose main file refers to its companions; other files do not belong to it."""

    def build(work: Path) -> None:
        (work / "mesh").mkdir()
        for name in ("mesh.obj", *names, "meshes.mtl", "other.png", "mesh/mesh.png"):
            (work / name).write_text(f"{name} of {text}")

    return produce(Recipe("export", 1, {"text": text, "names": names}, {}), build, main="mesh.obj")


def test_companions_are_delivered_beside_the_main_file(tmp_path):
    made, output = companied("first", *COMPANIONS), tmp_path / "deep" / "mesh.obj"
    assert store.deliver(made, output) == output
    assert contents(output.parent) == {n: f"{n} of first".encode() for n in ("mesh.obj", *COMPANIONS)}
    before = {path: path.stat().st_ino for path in output.parent.iterdir()}
    store.deliver(made, output)
    assert {path: path.stat().st_ino for path in output.parent.iterdir()} == before
    store.deliver(companied("second", *COMPANIONS), output)
    assert contents(output.parent) == {n: f"{n} of second".encode() for n in ("mesh.obj", *COMPANIONS)}
    for name in ("mesh.obj", *COMPANIONS):
        made_by = store.maker_of(output.parent / name)
        assert made_by is not None
        assert (made_by["step"], made_by["part"]) == ("export", name)


def test_companions_keep_the_names_by_which_they_are_referred_to(tmp_path):
    store.deliver(companied("first", *COMPANIONS), tmp_path / "out" / "car.obj")
    assert sorted(contents(tmp_path / "out")) == sorted(["car.obj", *COMPANIONS])
    store.deliver(companied("first", *COMPANIONS), tmp_path / "folder")
    assert "other.png" in contents(tmp_path / "folder")


@pytest.mark.parametrize("name", ["mesh.obj", *COMPANIONS])
@pytest.mark.parametrize("first", [False, True])
def test_one_foreign_companion_refuses_all(tmp_path, name, first):
    folder = tmp_path / "out"
    folder.mkdir()
    if first:
        store.deliver(companied("first", *COMPANIONS), folder / "mesh.obj")
    (folder / name).write_text("theirs")
    before = contents(folder)
    with pytest.raises(errors.OutputRefused, match="not an untouched file of ours") as caught:
        store.deliver(companied("second", *COMPANIONS), folder / "mesh.obj")
    assert name in str(caught.value)
    assert contents(folder) == before


def test_a_failed_replacement_is_undone(tmp_path, monkeypatch):
    output = tmp_path / "out" / "mesh.obj"
    store.deliver(companied("first", "mesh.mtl"), output)
    before, replace, replaced = contents(output.parent), Path.replace, []

    def failing(path: Path, target: Path) -> Path:
        if target == output:  # the last
            raise OSError(5, "Input/output error")
        replaced.append(target.name)
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", failing)
    with pytest.raises(errors.OutputRefused, match="Input/output"):
        store.deliver(companied("second", "mesh.mtl", "mesh.png"), output)
    assert {"mesh.mtl", "mesh.png"} <= set(replaced)
    assert contents(output.parent) == before
    assert sorted(path.name for path in output.parent.iterdir()) == ["mesh.mtl", "mesh.obj"]


def test_companions_that_are_folders_or_links_are_theirs(tmp_path):
    (tmp_path / "a" / "mesh.png").mkdir(parents=True)
    (tmp_path / "a" / "mesh.png" / "mine").write_text("mine")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mesh.png").symlink_to(tmp_path / "nowhere")
    for folder in ("a", "b"):
        with pytest.raises(errors.OutputRefused):
            store.deliver(companied("first", *COMPANIONS), tmp_path / folder / "mesh.obj")
        assert os.listdir(tmp_path / folder) == ["mesh.png"]
