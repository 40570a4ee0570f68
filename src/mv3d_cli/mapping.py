"""Map over independent items: here, over worker processes whose crash takes nobody along, or over a Ray cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from mv3d_cli.errors import MissingDependency, WorkFailed

AHEAD = 2  # items queued per worker, so that none waits and a crash leaves few to try again


@dataclass(frozen=True)
class Outcome:
    """What became of one item: a result, or the exception that its work raised."""

    item: Any
    result: Any = None
    error: Exception | None = None


def map_items(
    function: Callable[[Any], Any],
    items: Sequence[Any],
    jobs: int = 1,
    initializer: Callable[[], None] | None = None,
) -> Iterator[Outcome]:
    """Outcomes in the order in which they are ready.

    jobs         1: here, one after another; more: that many worker processes (function and items must pickle)
    initializer  called once in each worker process

    An exception is the item's outcome, and so is the death of its worker (WorkFailed): the other items go on.
    An item whose worker died may have been done already when it is tried again.
    """
    if jobs == 1 or len(items) < 2:
        for item in items:
            yield _attempt(function, item)
        return
    suspects = yield from _in_pool(function, items, jobs, initializer)
    for item in suspects:  # a worker died: each item in flight gets a worker of its own, to find the culprit
        if (yield from _in_pool(function, [item], 1, initializer)):
            yield Outcome(item, error=WorkFailed("its worker process died", "it may need more memory; try --jobs 1"))


def map_on_ray(
    function: Callable[[Any], Any], items: Sequence[Any], initializer: Callable[[], None] | None = None
) -> Iterator[Outcome]:
    """As `map_items`, on the cluster that RAY_ADDRESS names, else on a Ray of this machine's own.

    Workers elsewhere need mv3d installed and the same file system. Raises MissingDependency.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
        from ray.exceptions import RayError, RayTaskError  # pyright: ignore[reportMissingImports]
    except ImportError:
        hint = "pip install 'mv3d-cli[ray]', or take --workers processes"
        raise MissingDependency("the package ray is not installed", hint) from None
    ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    try:
        attempt = ray.remote(max_retries=0)(_begin_and_attempt)
        waiting, flying = list(reversed(items)), {}
        room = AHEAD * max(int(ray.cluster_resources().get("CPU", 1)), 1)
        while waiting or flying:
            while waiting and len(flying) < room:
                item = waiting.pop()
                flying[attempt.remote(function, item, initializer)] = item
            (ready,), _ = ray.wait(list(flying), num_returns=1)
            item = flying.pop(ready)
            try:
                yield ray.get(ready)
            except RayTaskError as error:  # an error of the work itself is an outcome: this is one before it
                hint = "mv3d must be installed there, the same version, and see the same files"
                yield Outcome(item, error=WorkFailed(f"its Ray worker could not begin: {error.cause}", hint))
            except RayError:
                yield Outcome(item, error=WorkFailed("its Ray worker died", "it may need more memory"))
    finally:
        ray.shutdown()


def _begin_and_attempt(function: Callable[[Any], Any], item: Any, initializer: Callable[[], None] | None) -> Outcome:
    if initializer is not None:
        initializer()
    return _attempt(function, item)


def _attempt(function: Callable[[Any], Any], item: Any) -> Outcome:
    try:
        return Outcome(item, function(item))
    except Exception as error:
        return Outcome(item, error=error)


def _in_pool(
    function: Callable[[Any], Any], items: Sequence[Any], jobs: int, initializer: Callable[[], None] | None
) -> Iterator[Outcome]:
    """Outcomes of all items but those in flight when a worker died, which it returns; a new pool takes the rest."""
    waiting, suspects = list(reversed(items)), []
    while waiting:
        pool = _pool(min(jobs, len(waiting)), initializer)
        flying: dict[Future[Outcome], Any] = {}
        try:
            while waiting or flying:
                while waiting and len(flying) < jobs * AHEAD:
                    flying[_submitted(pool, function, waiting[-1])] = waiting[-1]
                    waiting.pop()
                for future in wait(flying, return_when=FIRST_COMPLETED).done:
                    outcome = future.result()
                    del flying[future]
                    yield outcome
        except BrokenProcessPool:
            pool.shutdown()  # from here on every future is settled
            suspects += [item for future, item in flying.items() if future.exception()]
            yield from [future.result() for future in flying if not future.exception()]
        except BaseException:  # interrupted, or nobody wants the rest
            for worker in (pool._processes or {}).values():
                worker.terminate()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    return suspects


def _pool(jobs: int, initializer: Callable[[], None] | None) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, mp_context=context, initializer=partial(_start_worker, initializer))


def _submitted(pool: ProcessPoolExecutor, function: Callable[[Any], Any], item: Any) -> Future[Outcome]:
    with _interrupts_held():  # a worker that this starts inherits it: Ctrl-C is for the parent, which ends them
        return pool.submit(_attempt, function, item)


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C waits until the end of the block."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(initializer: Callable[[], None] | None) -> None:
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    if initializer is not None:
        initializer()


def _leave_with_parent() -> None:
    """Ends this worker when its parent is gone, however it went: nobody would read what it makes."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
