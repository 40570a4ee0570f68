"""The operating system: durable writes, cheap copies, advisory locks, and its errors in our words."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

from mv3d_cli.errors import Mv3dError, OutOfSpace, OutputRefused

try:
    import fcntl
except ImportError:  # Windows: copies are plain, folders are not locked
    fcntl = None

FICLONE = 0x40049409
SYNC_ONE_BY_ONE = 1000  # files; beyond, one sync of everything is faster
NO_SPACE = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG)
NO_SPACE_TEXTS = tuple(os.strerror(code) for code in NO_SPACE)
SPACE_HINT = """Free some space, move the cache elsewhere with MV3D_CACHE_DIR, or shrink it with
`mv3d cache prune --max-size 1G`."""


def ran_out_of_space(error: BaseException) -> bool:
    """Whether an exception, or one that it came from, says that the disk is full or a size limit was met.

    Libraries written in C++ and Rust often keep only the system's words, so those are recognised too.
    """
    cause: BaseException | None = error
    seen: set[int] = set()
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, OSError) and cause.errno in NO_SPACE:
            return True
        if not isinstance(cause, Mv3dError) and any(text in str(cause) for text in NO_SPACE_TEXTS):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


@contextmanager
def space_watched(place: Path) -> Iterator[None]:
    """Turn whatever says that there is no space left at `place` into OutOfSpace; leave other errors alone."""
    try:
        yield
    except OutOfSpace:
        raise
    except Exception as error:
        if ran_out_of_space(error):
            raise OutOfSpace(f"no space left, or a size limit was met, while writing {place}", SPACE_HINT) from error
        raise


@contextmanager
def writing_to(place: Path, hint: str) -> Iterator[None]:
    """Turn the system's refusals at `place` into OutOfSpace or OutputRefused with this hint."""
    with space_watched(place):
        try:
            yield
        except OSError as error:
            if ran_out_of_space(error):
                raise
            raise OutputRefused(f"cannot write to {place}: {error.strerror or error}", hint) from error


def sync_tree(folder: Path) -> None:
    """Wait until every file and folder below `folder`, and it, are on the disk."""
    paths = [Path(root) / name for root, _, names in os.walk(folder) for name in (*names, ".")]
    if len(paths) > SYNC_ONE_BY_ONE:
        os.sync()
    elif paths:
        with ThreadPoolExecutor(min(8, len(paths))) as pool:  # they wait for the disk, not for a processor
            list(pool.map(sync, paths))


def sync(path: Path) -> None:
    """Wait until one file, or one folder's list of names, is on the disk."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that has no fsync for folders
            raise
    finally:
        os.close(descriptor)


def copy_file(source: Path, target: Path) -> None:
    """Copy bytes to a new file, sharing blocks until one side is written where the file system can."""
    if not _reflink(source, target):
        shutil.copyfile(source, target)


def _reflink(source: Path, target: Path) -> bool:
    if fcntl is None:
        return False
    with open(source, "rb") as old, open(target, "wb") as new:
        try:
            fcntl.ioctl(new.fileno(), FICLONE, old.fileno())
        except OSError:
            return False
    return True


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all it holds; no error when it is gone already."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        with suppress(FileNotFoundError):
            if path.exists():
                shutil.rmtree(path)  # once more, to say what is in the way
    else:
        path.unlink(missing_ok=True)


def lock_now(path: Path, *, shared: bool = False) -> int | None:
    """A descriptor that holds an advisory lock on a path until it is closed; None when others hold one.

    Raises OSError when the path cannot be opened or its file system has no locks.
    """
    descriptor = os.open(path, os.O_RDONLY)
    if fcntl is None:
        return descriptor
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        same = os.fstat(descriptor).st_ino == os.stat(path).st_ino
    except BlockingIOError:
        same = False
    except OSError:
        os.close(descriptor)
        raise
    if same:
        return descriptor
    os.close(descriptor)
    return None


def token() -> str:
    """A name that no other process has."""
    return secrets.token_hex(4)
