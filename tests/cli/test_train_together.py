"""`mv3d train` in two processes is as in one with twice the batch; one of them speaks."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = ("-m", "mv3d_cli", "train")
FEW = ("--procedural", "3", "--views", "front,right", "--steps", "4", "--reuse", "2", "--warmup", "1")
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2")
ACCELERATE = (
    *(str(Path(sys.executable).parent / "accelerate"), "launch", "--cpu", "--num_processes", "1"),
    *("--num_machines", "1", "--mixed_precision", "no", "--dynamo_backend", "no"),
)


def launched(launcher: tuple[str, ...], *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*launcher, *PROGRAM, *map(str, words)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=200,
    )


def losses(folder: Path) -> list[float]:
    with (folder / "curve.csv").open(newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def test_two_processes_learn_as_one_with_twice_the_batch(forked, little: Path, tmp_path: Path) -> None:
    words = ("--from", little, *FEW, "--precision", "fp32", "--jobs", "0")
    done = launched(TORCHRUN, *words, "--batch", "2", "-o", tmp_path / "two")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [str(tmp_path / "two")]
    assert "warning: " not in done.stderr
    one = forked("train", *words, "--batch", "4").path
    assert losses(tmp_path / "two") == pytest.approx(losses(one), rel=1e-4)
    assert len({*losses(one)}) == 4
    with (tmp_path / "two" / "curve.csv").open(newline="") as file:
        assert [row["objects"] for row in csv.DictReader(file)] == ["4", "8", "12", "16"]
    (log,) = (tmp_path / "two" / "logs").iterdir()
    assert log.stat().st_size > 0


def test_under_accelerate_it_learns_as_alone(forked, little: Path, tmp_path: Path) -> None:
    """On CPUs, accelerate starts one process; more of them need MPI there."""
    words = ("--from", little, *FEW, "--precision", "fp32", "--jobs", "0", "--batch", "2")
    done = launched(ACCELERATE, *words, "-o", tmp_path / "model")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [str(tmp_path / "model")]
    assert losses(tmp_path / "model") == pytest.approx(losses(forked("train", *words).path), rel=1e-4)


def test_an_error_is_told_once(little: Path) -> None:
    done = launched(TORCHRUN, "--from", little, *FEW, "--views", "fron")
    lines = done.stderr.splitlines()
    assert done.returncode != 0
    assert done.stdout == ""
    assert [line for line in lines if line.startswith("error: ")] == ["error: there is no view called fron."]
    assert len([line for line in lines if line.startswith("hint: ")]) == 1
