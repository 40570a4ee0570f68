"""What all tests share: a cache of their own, the shared data, and the installed command in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

MV3D = Path(sys.executable).parent / "mv3d"
ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Ran:
    """How a process ended and what it said."""

    code: int
    stdout: str
    stderr: str

    @property
    def path(self) -> Path:
        """The one path on standard output."""
        assert self.code == 0, self.stderr
        (line,) = self.stdout.splitlines()
        return Path(line)


@pytest.fixture(scope="session")
def caches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("caches")


@pytest.fixture(autouse=True)
def cache_folder(caches: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache for each test."""
    folder = caches / str(len([*caches.iterdir()]))
    folder.mkdir()
    monkeypatch.setenv("MV3D_CACHE_DIR", str(folder))
    return folder


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared data: $MV3D_SHARED, or `shared` beside the repository."""
    folder = Path(os.environ.get("MV3D_SHARED") or ROOT.parent / "shared")
    if not folder.is_dir():
        pytest.skip(f"the shared data is not at {folder}; MV3D_SHARED says where it is")
    return folder


@pytest.fixture(scope="session")
def mv3d() -> Callable[..., Ran]:
    """Runs the installed command: mv3d(*args, stdin=None, env=None, cwd=None, before=None) -> Ran."""

    def run(
        *args: object,
        stdin: str | None = None,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
        before: Callable[[], None] | None = None,
    ) -> Ran:
        done = subprocess.run(
            [str(MV3D), *map(str, args)],
            input=stdin if stdin is not None else "",
            env={**os.environ, **(env or {})},
            cwd=cwd,
            preexec_fn=before,
            capture_output=True,
            text=True,
            timeout=280,
        )
        return Ran(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture(scope="session")
def refused(mv3d: Callable[..., Ran]) -> Callable[..., Ran]:
    """Runs a command that must fail: empty stdout, one `error:` line, one `hint:` line, and this exit code."""

    def run(*args: object, code: int = 2, **how: object) -> Ran:
        ran = mv3d(*args, **how)
        assert (ran.code, ran.stdout) == (code, ""), ran
        lines = ran.stderr.splitlines()
        assert [line.split(":")[0] for line in lines] == ["error", "hint"], ran.stderr
        assert all(len(line.split(": ", 1)[1]) > 8 for line in lines), ran.stderr
        return ran

    return run
