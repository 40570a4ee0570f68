"""What all tests share: a cache of their own, the shared data, and the installed command in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from mv3d_cli.diffusion.model.config import ModelConfig

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


FORKING = """
import gc, json, os, resource, sys
import torch.utils.tensorboard
import mv3d_cli.cli.train, mv3d_cli.steps.train.course
from mv3d_cli.__main__ import main
gc.freeze()
while True:
    line = sys.stdin.readline() or sys.exit()
    child = os.fork()
    if child == 0:
        break
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
words, env, limit, *places = json.loads(line)
for descriptor, place in enumerate(places):
    os.dup2(os.open(place, os.O_RDWR | os.O_CREAT | os.O_TRUNC), descriptor)
os.environ.clear()
os.environ.update(env)
if limit: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
sys.argv = ["mv3d", *words]
main()
"""


@pytest.fixture(scope="session")
def forked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Ran]]:
    """As `mv3d`, in a copy of a process that has torch loaded already, which saves six seconds a call.

    forked(*args, env=None, limit=0, until=None) -> Ran; `limit`: greatest size of a file, bytes; `until`: when this
    becomes true, the process is killed. Its threads: one.
    """
    said = tmp_path_factory.mktemp("said")
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", FORKING], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, text=True
    ) as server:
        assert server.stdin is not None
        assert server.stdout is not None

        def run(
            *args: object,
            env: Mapping[str, str] | None = None,
            limit: int = 0,
            until: Callable[[], object] | None = None,
        ) -> Ran:
            places = [os.devnull, str(said / "out"), str(said / "err")]
            job = [[*map(str, args)], {**os.environ, **(env or {})}, limit, *places]
            print(json.dumps(job), file=server.stdin, flush=True)
            child = int(server.stdout.readline())
            with suppress(ProcessLookupError):
                while until is not None:
                    os.kill(child, signal.SIGKILL if until() else 0)
                    time.sleep(0.01)
            code = int(server.stdout.readline())
            return Ran(code, *(Path(place).read_text() for place in places[1:]))

        yield run
        server.stdin.close()


@pytest.fixture(scope="session")
def smallest() -> ModelConfig:
    """A whole model for pictures of 8 x 8 pixels: no autoencoder, latents of 12 x 4 x 4, two levels."""
    from mv3d_cli.diffusion.model.config import ModelConfig

    network = {
        "sample_size": 4,
        "in_channels": 24,
        "out_channels": 12,
        "block_out_channels": (8, 16),
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
        "layers_per_block": 1,
        "attention_head_dim": 2,
        "cross_attention_dim": 8,
        "norm_num_groups": 4,
        "use_linear_projection": True,
    }
    tokens = {"size": 8, "patch": 4, "width": 8, "layers": 1, "heads": 2}
    return ModelConfig(network, patch_tokens=tokens, patch=2, positions=True, picture_size=8)


@pytest.fixture(scope="session")
def little(smallest: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a model that knows nothing, for pictures of 8 x 8 pixels: its steps take milliseconds."""
    import torch

    from mv3d_cli.diffusion.model import Model
    from mv3d_cli.diffusion.model.checkpoint import save_model

    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("little") / "model"
    save_model(Model(smallest), folder)
    return folder


@pytest.fixture(scope="session")
def refused(mv3d: Callable[..., Ran]) -> Callable[..., Ran]:
    """Runs a command that must fail: empty stdout, one `error:` line, one `hint:` line, and this exit code.

    `by` runs it, if not `mv3d`.
    """

    def run(*args: object, code: int = 2, by: Callable[..., Ran] = mv3d, **how: object) -> Ran:
        ran = by(*args, **how)
        assert (ran.code, ran.stdout) == (code, ""), ran
        lines = ran.stderr.splitlines()
        assert [line.split(":")[0] for line in lines] == ["error", "hint"], ran.stderr
        assert all(len(line.split(": ", 1)[1]) > 8 for line in lines), ran.stderr
        return ran

    return run
