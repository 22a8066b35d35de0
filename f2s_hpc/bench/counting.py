"""Operations and memory traffic of the kernels, counted, not estimated.

A real step is taken in plain Python (numba switched off) with arrays that note which of their elements are read and
written, and numbers that count what is done to them. This follows any change of a kernel, and needs no table to keep.

Counted as one operation each: addition, subtraction, multiplication, division, power, square root and other
functions of :mod:`math`. Not counted: comparisons, minima and maxima, absolute values, signs, and all arithmetic of
indices. A bulk kernel compiled with vectors computes both sides of a choice; only the side taken counts here.
Traffic: what a cache that holds a kernel's whole stencil must load and store in one call: every element read or
written is loaded once (a store loads its line first), every element written is stored once, 8 bytes each.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import sys
import textwrap
import types
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from f2s_hpc.bench.hook import KERNELS
from f2s_hpc.materials import elementary

_operations = [0]


class Counted(float):
    """A number that counts the operations done with it."""

    __slots__ = ()

    def __neg__(self):
        return Counted(-float(self))

    def __abs__(self):
        return Counted(abs(float(self)))


def _counting(name: str) -> Callable:
    plain = getattr(float, name)

    def operation(self, other):
        _operations[0] += 1
        try:
            value = plain(self, other)
        except ZeroDivisionError:
            # as compiled: infinity or no number
            with np.errstate(all="ignore"):
                value = float(getattr(np.float64(self), name)(np.float64(other)))
        except OverflowError:
            value = math.inf
        return value if value is NotImplemented else Counted(value)

    return operation


for _sign in ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "pow", "rpow"):
    setattr(Counted, f"__{_sign}__", _counting(f"__{_sign}__"))
# a numpy number to the left leaves the operation to this class
Counted.__array_ufunc__ = None


class Buffer:
    """The memory behind traced arrays: the numbers, and which of them were read and written."""

    def __init__(self, array: np.ndarray, counts: bool = True) -> None:
        self.numbers = memoryview(array)
        self.counts = counts
        self.read = bytearray(array.size if counts else 0)
        self.wrote = bytearray(array.size if counts else 0)

    def clear(self) -> None:
        """Forget what was read and written."""
        self.read = bytearray(len(self.read))
        self.wrote = bytearray(len(self.wrote))

    def touched(self) -> tuple[int, int]:
        """Return how many elements were loaded, and how many stored."""
        read, wrote = np.frombuffer(self.read, np.uint8), np.frombuffer(self.wrote, np.uint8)
        return int((read | wrote).sum()), int(wrote.sum())


class Traced:
    """An array of float64 over a :class:`Buffer`, with the indexing that kernels use."""

    __slots__ = ("buffer", "offset", "shape", "steps")

    def __init__(self, buffer: Buffer, offset: int, shape: tuple[int, ...], steps: tuple[int, ...]) -> None:
        self.buffer, self.offset, self.shape, self.steps = buffer, offset, shape, steps

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def ndim(self) -> int:
        """Number of indices."""
        return len(self.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def _place(self, index) -> tuple[int, tuple[int, ...], tuple[int, ...]]:
        """Return offset, shape and steps of what ``index`` selects."""
        offset, shape, steps = self.offset, [], []
        index = index if isinstance(index, tuple) else (index,)
        for axis, one in enumerate(index):
            if isinstance(one, slice):
                first, last, step = one.indices(self.shape[axis])
                offset += first * self.steps[axis]
                shape.append(max(0, -(-(last - first) // step)))
                steps.append(step * self.steps[axis])
            else:
                one = int(one)
                if not -self.shape[axis] <= one < self.shape[axis]:
                    raise IndexError(f"index {one} of an axis of {self.shape[axis]}")
                offset += (one % self.shape[axis]) * self.steps[axis]
        return offset, (*shape, *self.shape[len(index):]), (*steps, *self.steps[len(index):])

    def __getitem__(self, index):
        offset, shape, steps = self._place(index)
        if shape:
            return Traced(self.buffer, offset, shape, steps)
        if self.buffer.counts:
            self.buffer.read[offset] = 1
        return Counted(self.buffer.numbers[offset])

    def __setitem__(self, index, value) -> None:
        offset, shape, steps = self._place(index)
        places = offset + sum(step * np.indices(shape)[axis] for axis, step in enumerate(steps)) if shape else offset
        for number, place in enumerate(np.ravel(places).tolist()):
            self.buffer.numbers[place] = float(value[number] if isinstance(value, Traced) else value)
            if self.buffer.counts:
                self.buffer.wrote[place] = 1


def _one_operation(function: Callable) -> Callable:
    def counted(*arguments):
        _operations[0] += 1
        try:
            return Counted(function(*arguments))
        except ValueError:
            return Counted(math.nan)

    return counted


def _scratch(shape, dtype=float, **named):
    """Stand for ``np.empty`` and ``np.zeros`` in a kernel: scratch, in the first cache, is no traffic."""
    array = np.zeros(shape, dtype, **named)
    return trace(array, counts=False) if array.dtype == float else array


def trace(array: np.ndarray, counts: bool = True) -> Traced:
    """Return a traced array over a C-contiguous float64 array."""
    steps = tuple(s // array.itemsize for s in array.strides)
    return Traced(Buffer(array.reshape(-1), counts), 0, array.shape, steps)


def _elementary(function: Callable) -> Callable:
    """Return a function of one number that counts as many operations as the source of ``function`` writes.

    The elementary functions take numbers apart bit by bit, which only a real float64 allows.
    """
    source = ast.parse(textwrap.dedent(inspect.getsource(function)))
    arithmetic = (ast.Add, ast.Sub, ast.Mult, ast.Div)
    cost = sum(isinstance(node, ast.BinOp) and isinstance(node.op, arithmetic) for node in ast.walk(source))

    def counted(x):
        _operations[0] += cost
        return Counted(function(float(x)))

    return counted


def stand_in_for_libraries() -> None:
    """Give the modules of kernels and materials a ``math`` and a ``np`` that count; for the rest of the process."""
    whole = {function: _elementary(function) for function in (elementary.exponential, elementary.logarithm)}
    counted = {name: _one_operation(getattr(math, name))
               for name in ("sqrt", "exp", "log", "log1p", "expm1", "pow", "atan2", "acos", "cos", "sin")}
    arithmetic = types.SimpleNamespace(**{**vars(math), **counted})
    arrays = types.SimpleNamespace(**{**{n: getattr(np, n) for n in dir(np) if not n.startswith("_")},
                                      "empty": _scratch, "zeros": _scratch})
    for name, module in list(sys.modules.items()):
        if name.startswith((KERNELS, "f2s_hpc.materials.")):
            for alias, library, stand_in in (("math", math, arithmetic), ("np", np, arrays)):
                if getattr(module, alias, None) is library:
                    setattr(module, alias, stand_in)
            for alias, thing in list(vars(module).items()):
                if isinstance(thing, types.FunctionType) and thing in whole:
                    setattr(module, alias, whole[thing])


@dataclass
class Tally:
    """What a kernel did in one step: operations, bytes loaded and stored, cells or nodes it was asked for, calls.

    ``bulk``: the kernel walks runs or columns of active cells; else it works on sides, blocks or planes.
    """

    operations: float = 0.0
    bytes: float = 0.0
    cells: float = 0.0
    calls: int = 0
    bulk: bool = True


@dataclass
class Counter:
    """Counts the kernels of a step on a pool of fields; give :meth:`wrap` to :func:`f2s_hpc.bench.hook.hooked`.

    ``memory``: the pool; ``active``: active cells of this rank, taken for kernels that say not which they visit.
    """

    memory: np.ndarray
    active: int
    tallies: dict[str, Tally] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._pool = Buffer(self.memory)
        self._start = self.memory.__array_interface__["data"][0]

    def wrap(self, name: str, function: Callable) -> Callable:
        """Return ``function`` with what it does entered under ``name``."""
        def counted(*arguments, **named):
            others: list[Buffer] = []
            self._pool.clear()
            before = _operations[0]
            result = function(*(self._traced(a, others) for a in arguments), **named)
            loaded, stored = np.sum([b.touched() for b in (self._pool, *others)], axis=0)
            tally = self.tallies.setdefault(name, Tally())
            tally.operations += _operations[0] - before
            tally.bytes += 8.0 * (loaded + stored)
            cells = visited(arguments)
            tally.bulk = tally.bulk and cells is not None
            tally.cells += self.active if cells is None else cells
            tally.calls += 1
            return result

        return counted if not name.startswith("halo") else function

    def _traced(self, argument, others: list[Buffer]):
        if isinstance(argument, tuple):
            values = [self._traced(a, others) for a in argument]
            return type(argument)(*values) if hasattr(argument, "_fields") else tuple(values)
        if not isinstance(argument, np.ndarray) or argument.dtype != float:
            return argument
        steps = tuple(s // 8 for s in argument.strides)
        if np.may_share_memory(argument, self.memory):
            offset = (argument.__array_interface__["data"][0] - self._start) // 8
            return Traced(self._pool, offset, argument.shape, steps)
        traced = trace(argument)
        others.append(traced.buffer)
        return traced


def visited(arguments: tuple) -> int | None:
    """Return how many cells or nodes a call visits: those of its runs or columns inside its window; None without any.

    Runs are rows (k, j, first, end), columns (fixed, first, end, first cell, end cell) of int32, followed by how many
    count; the window is the first tuple of six integers (k0, k1, j0, j1, i0, i1).
    """
    window = next((a for a in arguments if isinstance(a, tuple) and len(a) == 6 and all(
        isinstance(n, (int, np.integer)) for n in a)), None)
    listed = next(((a, int(n)) for a, n in itertools.pairwise(arguments) if isinstance(a, np.ndarray)
                   and a.dtype == np.int32 and a.ndim == 2 and isinstance(n, (int, np.integer))), None)
    if listed is None:
        return None
    rows = listed[0][:listed[1]].astype(np.int64)
    bounds = np.array(window) if window is not None else np.array([-2**40, 2**40] * 3)
    if rows.shape[1] == 4:
        low = np.maximum(rows[:, [0, 1, 2]], bounds[[0, 2, 4]])
        high = np.minimum(np.stack([rows[:, 0] + 1, rows[:, 1] + 1, rows[:, 3]], 1), bounds[[1, 3, 5]])
    elif rows.shape[1] == 5:
        low = np.maximum(rows[:, [0, 1, 3]], bounds[[0, 2, 4]])
        high = np.minimum(np.stack([rows[:, 0] + 1, rows[:, 2], rows[:, 4]], 1), bounds[[1, 3, 5]])
    else:
        return None
    return int(np.prod(np.maximum(high - low, 0), axis=1).sum())
