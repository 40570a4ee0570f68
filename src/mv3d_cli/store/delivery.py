"""The user's `-o`: a copy of an artifact, or of its main file, that replaces only what is ours.

Files that lie beside the main file and share its stem are its companions (of mesh.obj: mesh.mtl, mesh.png,
mesh.2.png). The main file may refer to them by name, so they are delivered beside the output under their own names.
All are looked at before any is replaced; each is replaced at once, the main file last; after an error those that
were replaced are put back.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath

from mv3d_cli.errors import OutOfSpace, OutputRefused
from mv3d_cli.store.artifact import Artifact, damage_of
from mv3d_cli.store.cache import LAYOUT, cache_dir, locked, recall_product, remember_product
from mv3d_cli.store.digest import MANIFEST, in_threads, sha256_of
from mv3d_cli.store.disk import copy_file, ran_out_of_space, remove, sync, sync_tree, token
from mv3d_cli.store.manifest import read_manifest, record_of

RENAME_HINT = "Give another name with -o, or move it away first."


def check_output(output: Path, main: str | None = None) -> None:
    """Refuse, before any work, an output that could not or must not be written. Missing parents will be made.

    `main` is the name of the artifact's main file, if it has one: an output with its suffix is a file, any
    other a folder. Raises OutputRefused.
    """
    target = _resolved(output)
    with _alone_at(target):
        _check(target, main, expected=None)


def deliver(artifact: Artifact, output: Path) -> Path:
    """Copy an artifact, or its main file and companions when `output` has that suffix, to where the user wants it.

    What is there already is replaced when it is ours and untouched, and left alone when it is the same.
    Returns the output's path as given. Raises OutputRefused or OutOfSpace.
    """
    target = _resolved(output)
    try:
        with _alone_at(target):
            if _is_file_wanted(target, artifact.manifest["main"]):
                _deliver_file(artifact, target)
            else:
                _deliver_folder(artifact, target)
    except OSError as error:
        if ran_out_of_space(error):
            hint = "Free some space there, or give an -o on another disk; the result is kept in the cache."
            raise OutOfSpace(f"no space left, or a size limit was met, while writing {output}", hint) from error
        raise OutputRefused(f"cannot write {output}: {error.strerror or error}", RENAME_HINT) from error
    return output


def _resolved(output: Path) -> Path:
    """Where an output really lies: a link is followed, and what it points to is replaced."""
    try:
        return output.resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputRefused(f"{output} is not a usable path: {error}", "Give another name with -o.") from error


def _is_file_wanted(target: Path, main: str | None) -> bool:
    """Whether the main file is wanted. Raises OutputRefused for a suffix that the main file does not have."""
    if main is None or not target.suffix or target.is_dir():
        return False
    suffix = Path(main).suffix
    if target.suffix.lower() != suffix.lower():
        raise OutputRefused(
            f"this command writes {suffix} files, not {target.suffix}",
            f"Give -o a name that ends in {suffix}, or a folder.",
        )
    return True


def _check(target: Path, main: str | None, expected: str | None) -> None:
    """Raise OutputRefused unless `target` can be written and holds nothing that is not ours."""
    try:
        _check_place(target)
        if _is_file_wanted(target, main):
            if os.path.lexists(target):
                _check_file(target, expected)
        elif os.path.lexists(target):
            _check_folder(target, main)
    except OSError as error:
        raise OutputRefused(f"cannot look at {target}: {error.strerror or error}", RENAME_HINT) from error


def _check_place(target: Path) -> None:
    cache = cache_dir().resolve()
    if target == cache or cache in target.parents:
        raise OutputRefused(f"{target} lies in the cache", "Give an -o outside MV3D_CACHE_DIR.")
    if target == Path.cwd() or target in Path.cwd().parents:
        raise OutputRefused(f"{target} is the folder you are in, or holds it", "Give -o a new name, such as result/.")
    with suppress(FileNotFoundError, NotADirectoryError):
        target.lstat()  # says whether such a name can be
    above = next(folder for folder in target.parents if os.path.lexists(folder))
    if not above.is_dir():
        raise OutputRefused(f"{above} is a file, so {target} cannot be made in it", "Give another name with -o.")
    if not os.access(above, os.W_OK | os.X_OK):
        raise OutputRefused(f"{above} cannot be written to", "Give an -o in a folder that you can write to.")


def _check_file(target: Path, expected: str | None) -> None:
    if not target.is_file():
        raise OutputRefused(f"{target} is not a file that can be replaced", RENAME_HINT)
    sha256 = sha256_of(target)
    if sha256 != expected and recall_product(sha256) is None:
        raise OutputRefused(f"{target} is there already and is not an untouched file of ours", RENAME_HINT)


def _check_folder(target: Path, main: str | None) -> None:
    if not target.is_dir():
        suffixes = f" or a name that ends in {Path(main).suffix}" if main else ""
        raise OutputRefused(f"{target} is a file, and a folder is to be written", f"Give -o a folder{suffixes}.")
    if not any(target.iterdir()):
        return
    manifest = read_manifest(target)
    if manifest is None:
        raise OutputRefused(f"{target} holds files that are not ours", RENAME_HINT)
    damage = damage_of(Artifact(target, manifest))
    if damage:
        raise OutputRefused(f"{target} was changed since it was written: {damage[0]}", RENAME_HINT)


def _deliver_file(artifact: Artifact, target: Path) -> None:
    """Copy the main file and its companions beside the target, then rename them into place."""
    main, files = artifact.manifest["main"], artifact.manifest["files"]
    sources = {target.with_name(PurePosixPath(name).name): name for name in _companions(artifact)} | {target: main}
    for place, name in sources.items():
        _check(place, name, expected=files[name][0])
    changed = {place: name for place, name in sources.items() if not _holds(place, files[name][0])}
    if not changed:
        return
    for name in changed.values():
        remember_product(files[name][0], {**record_of(artifact.manifest), "part": name, "edited": False})
    target.parent.mkdir(parents=True, exist_ok=True)
    with _workplace(target) as workplace:
        new, old = workplace / "new", workplace / "old"
        new.mkdir()
        old.mkdir()
        for place, name in changed.items():
            copy_file(artifact.path / name, new / place.name)
            sync(new / place.name)
        _replace(new, old, list(changed))
        sync(target.parent)


def _companions(artifact: Artifact) -> list[str]:
    """The artifact's files that belong to its main file."""
    main = PurePosixPath(artifact.manifest["main"])
    beside = [path for path in map(PurePosixPath, artifact.manifest["files"]) if path.parent == main.parent]
    return [str(path) for path in beside if path != main and path.name.startswith(f"{main.stem}.")]


def _holds(place: Path, sha256: str) -> bool:
    return place.is_file() and sha256_of(place) == sha256


def _replace(new: Path, old: Path, places: Sequence[Path]) -> None:
    """Rename files of the folder `new` to their places, all or, after an error, none; `old` is for what was there."""
    for place in places[:-1]:  # nothing can go wrong after the last
        if place.exists():
            copy_file(place, old / place.name)
    done: list[Path] = []
    try:
        for place in places:
            (new / place.name).replace(place)
            done.append(place)
    except OSError:
        for place in done:
            if (old / place.name).exists():
                (old / place.name).replace(place)
            else:
                place.unlink()
        raise


def _deliver_folder(artifact: Artifact, target: Path) -> None:
    """Copy everything beside the target, then rename it into place."""
    _check(target, artifact.manifest["main"], expected=None)
    if read_manifest(target) == dict(artifact.manifest):  # and intact, or it would have been refused
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with _workplace(target) as workplace:
        new = workplace / "new"
        names = [*artifact.manifest["files"], MANIFEST]
        for folder in sorted({(new / name).parent for name in names}):
            folder.mkdir(parents=True, exist_ok=True)
        in_threads(lambda name: copy_file(artifact.path / name, new / name), names)
        sync_tree(new)
        _install(new, target)
        sync(target.parent)


def _install(new: Path, target: Path) -> None:
    """Rename a folder to its place; one of ours that is there is moved aside first."""
    if not (target.is_dir() and any(target.iterdir())):
        new.rename(target)
        return
    old = target.rename(new.with_name("old"))
    try:
        new.rename(target)
    except OSError:
        old.rename(target)
        raise


@contextmanager
def _workplace(target: Path) -> Iterator[Path]:
    """A folder beside the target for the time of a delivery. What dead processes left there is removed."""
    for leftover in target.parent.glob(f"{_prefix(target)}.*.tmp"):
        remove(leftover)
    folder = target.with_name(f"{_prefix(target)}.{token()}.tmp")
    folder.mkdir()
    try:
        yield folder
    finally:
        with suppress(OSError):
            remove(folder)


def _prefix(target: Path) -> str:
    return f".mv3d-{hashlib.sha256(os.fsencode(target.name)).hexdigest()[:12]}"


@contextmanager
def _alone_at(target: Path) -> Iterator[None]:
    """Let one process at a time look at an output, or one of the same stem, or write it."""
    place = cache_dir() / LAYOUT / ".outputs" / hashlib.sha256(os.fsencode(target.parent / target.stem)).hexdigest()
    with ExitStack() as stack:
        with suppress(OutputRefused):  # a cache that can only be read gives no locks
            stack.enter_context(locked(place, on_wait=lambda: None))
            stack.callback(place.with_name(f"{place.name}.lock").unlink, missing_ok=True)
        yield
