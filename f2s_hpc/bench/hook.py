"""Stand between the solver and its kernels: every call of a real step passes through a wrapper.

The wrapper is put where the Python modules of the solver look kernels up, so kernels that call each other stay
compiled as they are, and a kernel may change its arguments without a change here.
"""

from __future__ import annotations

import sys
import time
import types
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from f2s_hpc import mpi
from f2s_hpc.grid.halo import Pool

KERNELS = "f2s_hpc.kernels."
CALLERS = ("f2s_hpc.solver.", "f2s_hpc.grid.", "f2s_hpc.state")
EXCHANGE = "halo exchange"

Wrapper = Callable[[str, Callable], Callable]


def _is_kernel(thing: object) -> bool:
    """Tell whether ``thing`` is a kernel: compiled, or a plain function where compilation is switched off."""
    function = getattr(thing, "py_func", thing)
    return isinstance(function, types.FunctionType) and function.__module__.startswith(KERNELS)


def _name(kernel: Callable) -> str:
    function = getattr(kernel, "py_func", kernel)
    return f"{function.__module__.removeprefix(KERNELS)}.{function.__name__}"


def _stand_in(module: types.ModuleType, wrap: Wrapper) -> types.SimpleNamespace:
    """Return a namespace with all that ``module`` has, its kernels wrapped."""
    return types.SimpleNamespace(**{
        name: wrap(_name(thing), thing) if _is_kernel(thing) else thing for name, thing in vars(module).items()})


@contextmanager
def hooked(wrap: Wrapper) -> Iterator[None]:
    """Let every kernel that the solver calls, and every exchange of ghosts, be ``wrap(name, function)``.

    Kernels should be compiled before: the first call of a kernel compiles it.
    """
    replaced: list[tuple[object, str, object]] = []
    for caller, module in list(sys.modules.items()):
        if module is None or not caller.startswith(CALLERS):
            continue
        for name, thing in list(vars(module).items()):
            if isinstance(thing, types.ModuleType) and thing.__name__.startswith(KERNELS):
                replaced.append((module, name, thing))
                setattr(module, name, _stand_in(thing, wrap))
            elif _is_kernel(thing):
                replaced.append((module, name, thing))
                setattr(module, name, wrap(_name(thing), thing))
    replaced.append((Pool, "exchange", Pool.exchange))
    Pool.exchange = wrap(EXCHANGE, Pool.exchange)
    try:
        yield
    finally:
        for owner, name, thing in replaced:
            setattr(owner, name, thing)


@contextmanager
def waiting(wrap: Wrapper) -> Iterator[None]:
    """Let what waits for other ranks, exchanges and reductions, be ``wrap(name, function)``."""
    kept = Pool.exchange, mpi.maximum
    Pool.exchange, mpi.maximum = wrap(EXCHANGE, kept[0]), wrap("reduction", kept[1])
    try:
        yield
    finally:
        Pool.exchange, mpi.maximum = kept


class Stopwatches:
    """CPU time of each kernel in each step.

    CPU time, not wall time: on a shared machine the least over some steps then says what a kernel costs.
    """

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)

    def wrap(self, name: str, function: Callable) -> Callable:
        """Return ``function`` with its time and its calls entered under ``name``."""
        def timed(*arguments, **named):
            start = time.thread_time()
            try:
                return function(*arguments, **named)
            finally:
                self.spent[name] += time.thread_time() - start
                self.calls[name] += 1

        return timed

    def read(self) -> tuple[dict[str, float], dict[str, int]]:
        """Return the seconds and the calls since the last reading, and start anew."""
        seconds, calls = dict(self.spent), dict(self.calls)
        self.spent.clear()
        self.calls.clear()
        return seconds, calls
