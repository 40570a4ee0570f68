"""How kernels run: Warp started quietly, arrays of either family taken in, CPU launches split over threads.

Warp runs a CPU launch on the calling thread and lets go of the interpreter lock, so a launch is split by handing
parts of its domain to a pool of threads. CUDA launches take the whole domain at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from functools import cache
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp


@contextlib.contextmanager
def discarded(descriptor: int) -> Iterator[None]:
    """What libraries write to a file descriptor past Python goes nowhere: 1 belongs to results, 2 to our words."""
    kept, nowhere = os.dup(descriptor), os.open(os.devnull, os.O_WRONLY)
    _flush()
    os.dup2(nowhere, descriptor)
    try:
        yield
    finally:
        _flush()
        os.dup2(kept, descriptor)
        os.close(kept)
        os.close(nowhere)


def _flush() -> None:
    """Empties the buffers of Python's standard output and of the C library."""
    sys.stdout.flush()
    ctypes.CDLL("ucrtbase" if os.name == "nt" else None).fflush(None)


def _start_quietly() -> None:
    """Starts Warp, whose C side writes to standard error where there is no CUDA driver."""
    wp.config.log_level = wp.LOG_WARNING
    with contextlib.suppress(OSError), discarded(2):
        wp.init()


_start_quietly()


def cpu_count() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_limit: ContextVar[int] = ContextVar("threads", default=0)
_fixed = 0


def use_threads(count: int) -> None:
    """Limits CPU kernels of this process to `count` threads (0: one per processor); for worker processes."""
    global _fixed
    _fixed = count


def threads() -> int:
    """Threads that CPU kernels may use here and now; 1 inside a task that already runs beside others."""
    return _limit.get() or _fixed or cpu_count()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    del process  # a forked child needs threads of its own
    return ThreadPoolExecutor(cpu_count(), thread_name_prefix="mv3d-kernel", initializer=_limit.set, initargs=(1,))


def in_threads(tasks: Iterable[Callable[[], Any]]) -> list[Any]:
    """Results of the tasks, in order, run beside each other on up to `threads()` threads."""
    tasks = list(tasks)
    if len(tasks) < 2 or threads() == 1:
        return [task() for task in tasks]
    return list(_pool(os.getpid()).map(lambda task: task(), tasks))


def is_torch(array: Any) -> bool:
    """Whether `array` is a torch tensor (asked without importing torch)."""
    return type(array).__module__.partition(".")[0] == "torch"


def to_warp(array: Any, dtype: Any, device: str) -> wp.array:
    """A Warp array over `array` (NumPy or torch), shared where it already lies on `device`."""
    if is_torch(array):
        return wp.from_torch(array.contiguous(), dtype=dtype)
    return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device, copy=False)


def like(result: wp.array, model: Any) -> Any:
    """`result` as the family of `model`: a torch tensor or a NumPy array, without a copy on the CPU."""
    return wp.to_torch(result) if is_torch(model) else result.numpy()


def empty(shape: tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """Room on a device. On the CPU NumPy finds it, which asks for huge pages: a quarter of the page faults' time."""
    if device != "cpu":
        return wp.empty(shape, dtype=dtype, device=device)
    inner = getattr(dtype, "_shape_", ())
    scalar = wp.dtype_to_numpy(getattr(dtype, "_wp_scalar_type_", dtype))
    return wp.array(np.empty((*shape, *inner), scalar), dtype=dtype, device=device, copy=False)


def device_of(array: Any) -> str:
    """The Warp name of the device that `array` lies on."""
    return str(array.device) if is_torch(array) and array.device.type == "cuda" else "cpu"


_loading = Lock()


def load(module: ModuleType, device: str) -> None:
    """Compiles (or fetches from Warp's cache) the kernels of a Python module, once, before threads launch them."""
    with _loading:
        wp.load_module(module, device=device)
