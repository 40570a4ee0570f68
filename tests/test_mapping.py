"""map_items: the same outcomes in process and in processes, and a worker's death is one item's failure."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from mv3d_cli.errors import BadMesh, Mv3dError, WorkFailed
from mv3d_cli.mapping import map_items, map_on_ray

# Workers import what they run by name, so these are spelled as files that they can find.
WORK = """
import os, signal, time
from pathlib import Path
from mv3d_cli.errors import BadMesh

started = []

def start():
    started.append(os.getpid())

def square(x):
    if x < 0: raise ValueError(f"{x} is negative")
    if x == 13: raise BadMesh("thirteen", "take another")
    return x * x

def fatal(item):
    x, log = item
    with open(log, "a") as file: file.write(f"{x}\\n")
    if x == 3: os._exit(1)
    return x

def fatal_kill(item):
    if item == 2: os.kill(os.getpid(), signal.SIGKILL)
    return item

def counted(item):
    return started.count(os.getpid())

def pid(item):
    time.sleep(0.2)
    return os.getpid()

def slow(folder):
    Path(folder, str(os.getpid())).touch()
    time.sleep(60)
"""


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    (folder / "work_to_map.py").write_text(WORK)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.setenv("PYTHONPATH", str(folder))  # for workers that are not ours to start
        import work_to_map  # pyright: ignore[reportMissingImports]

        yield work_to_map


def summary(outcomes):
    return {o.item: (o.result, type(o.error), str(o.error), getattr(o.error, "hint", None)) for o in outcomes}


def test_processes_give_what_one_process_gives(work):
    items = [3, -1, 13, 0, 5, -7]
    here = summary(map_items(work.square, items))
    assert here[3] == (9, type(None), "None", None)
    assert here[-1] == (None, ValueError, "-1 is negative", None)
    assert here[13] == (None, BadMesh, "thirteen", "take another")
    assert summary(map_items(work.square, items, jobs=2)) == here
    assert summary(map_items(work.square, items[::-1], jobs=2)) == here


def test_in_process_the_order_is_kept(work):
    assert [o.item for o in map_items(work.square, [5, -1, 2])] == [5, -1, 2]


@pytest.mark.parametrize("jobs", [1, 4])
def test_nothing_to_do(work, jobs):
    assert [*map_items(work.square, [], jobs)] == []
    assert [o.result for o in map_items(work.square, [4], jobs)] == [16]


def test_the_work_is_spread_and_workers_are_prepared_once(work):
    assert len({o.result for o in map_items(work.pid, range(4), 2)} - {os.getpid()}) == 2
    assert {o.result for o in map_items(work.counted, range(4), 2, work.start)} == {1}


def test_a_worker_that_exits_is_one_failure(work, tmp_path):
    log = tmp_path / "log"
    items = [(x, str(log)) for x in range(8)]
    outcomes = {o.item[0]: o for o in map_items(work.fatal, items, jobs=2)}
    assert sorted(outcomes) == list(range(8))
    assert {x: o.result for x, o in outcomes.items() if o.error is None} == {x: x for x in range(8) if x != 3}
    assert isinstance(outcomes[3].error, WorkFailed)
    assert outcomes[3].error.hint
    tries = log.read_text().split()
    assert set(tries) == {str(x) for x in range(8)}
    assert tries.count("3") == 2


def test_a_worker_that_is_killed_is_one_failure(work):
    outcomes = {o.item: o for o in map_items(work.fatal_kill, range(4), jobs=2)}
    assert [type(outcomes[x].error) for x in range(4)] == [type(None), type(None), WorkFailed, type(None)]


def test_stopping_early_ends_the_workers(work, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    start = time.perf_counter()
    try:
        signal.setitimer(signal.ITIMER_REAL, 2.5)
        with pytest.raises(KeyboardInterrupt):
            [*map_items(work.slow, [str(tmp_path)] * 3, jobs=2)]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert time.perf_counter() - start < 20
    assert (workers := os.listdir(tmp_path))
    assert not [pid for pid in workers if Path("/proc", pid).exists()]


def test_errors_travel_between_processes():
    import pickle

    for kind in [Mv3dError, *Mv3dError.__subclasses__(), BadMesh]:
        error = pickle.loads(pickle.dumps(kind("what is wrong", "what to do")))
        assert (type(error), str(error), error.hint) == (kind, "what is wrong", "what to do")


def test_ray_gives_the_same_outcomes(work) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    outcomes = {outcome.item: outcome for outcome in map_on_ray(work.square, [3, -1, 13, 4])}
    assert (outcomes[3].result, outcomes[4].result) == (9, 16)
    assert isinstance(outcomes[-1].error, ValueError)
    assert isinstance(outcomes[13].error, BadMesh)
    assert outcomes[13].error.hint == "take another"


def test_ray_survives_a_worker_that_dies(work) -> None:
    pytest.importorskip("ray", reason="ray is not installed")
    outcomes = {outcome.item: outcome for outcome in map_on_ray(work.fatal_kill, [1, 2, 3])}
    assert (outcomes[1].result, outcomes[3].result) == (1, 3)
    assert isinstance(outcomes[2].error, WorkFailed)
