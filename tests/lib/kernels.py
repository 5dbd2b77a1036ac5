"""Machine code of any function of one member, called without JAX: so that thousands of random functions run in time.

All arrays end at a page that can be neither read nor written: on Linux a kernel that goes beyond one ends the process.
"""

import collections
import ctypes
import mmap
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from lieint_jax.native._arrays import computed_before
from lieint_jax.native._primitives.abstract_walk import unsupported_if_it_fails
from lieint_jax.native._traced import Traced

_PARTS = 4  # of the members for each thread


class Kernel:
    """A function of one member, as machine code for many.

    Args:
        function: of trees of arrays.
        kinds: see `Traced`, for each argument or for its parts.
        examples: the arguments of one member and one row, as arrays or shapes.
        lanes: members in a vector; by default it follows from the machine.
    """

    @unsupported_if_it_fails()
    def __init__(self, function, kinds, examples, lanes=0):
        from lieint_jax.native import _machine
        from lieint_jax.native._pieces import modules

        shapes = jax.tree.map(_shape_of, tuple(examples))
        closed, results = jax.make_jaxpr(function, return_shape=True)(*shapes)
        each = jax.tree.map(lambda kind, part: [kind] * len(jax.tree.leaves(part)), tuple(kinds), shapes)
        traced = Traced(closed, jax.tree.leaves(each))
        self._outside, self.length = traced.outside, traced.length
        self._leaves, self._structure = traced.leaves, jax.tree.structure(results)
        self._results = jax.tree.leaves(results)
        self._carried = sum(leaf.kind == "carry" for leaf in self._leaves)
        self.lanes = lanes or _machine.lanes(self._leaves, traced.program.pressure())
        sizes = [int(np.prod(x.shape)) for x in self._results[self._carried :]]
        texts, self.shared = modules(traced.program, self._leaves, sizes, self.lanes)
        self._run = MachineFunction(*texts)

    def __call__(self, arguments, members, rows=1, threads=1):
        """The results of all members, with the axes (members, …) of carries and (rows, members, …) of others."""
        given = [np.asarray(x) for part in arguments for x in jax.tree.leaves(part)]
        given += map(np.asarray, computed_before(self._outside, self._leaves, given, members))
        given = [guarded(np.shape(x), leaf.dtype, x) for x, leaf in zip(given, self._leaves, strict=True)]
        for x, leaf in zip(given, self._leaves, strict=True):
            copies = collections.defaultdict(lambda: 1, carry=members, member=members, row=rows)[leaf.kind]
            assert x.size == copies * leaf.size, leaf
        outputs = [
            guarded((members, *x.shape) if n < self._carried else (rows, members, *x.shape), x.dtype)
            for n, x in enumerate(self._results)
        ]
        parts = 1 if threads == 1 else _PARTS * threads
        ends = np.linspace(0, -(-members // self.lanes), parts + 1).astype(int)
        with ThreadPoolExecutor(threads) as pool:
            run = pool.map(lambda a, b: self._run(int(a), int(b), members, rows, 1, [*given, *outputs]), ends, ends[1:])
            list(run)
        return jax.tree.unflatten(self._structure, outputs)


def _shape_of(x):
    return jax.ShapeDtypeStruct(np.shape(x), jax.dtypes.canonicalize_dtype(jax.numpy.result_type(x)))


class MachineFunction:
    """The function `run` of modules that are compiled together; it takes five integers and a list of arrays."""

    def __init__(self, *texts):
        from lieint_jax.native import _machine

        self._engine = _machine._engine(_machine._key(texts), [x for x in texts if x], ["run"])
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 5, ctypes.c_void_p)
        self._call = kind(self._engine.get_function_address("run"))

    def __call__(self, *arguments):
        *numbers, arrays = arguments
        self._call(*numbers, (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays)))


def guarded(shape, dtype, values=0):
    """An array that ends where memory can be neither read nor written."""
    count, dtype = int(np.prod(shape)), np.dtype(dtype)
    pages = -(-count * dtype.itemsize // mmap.PAGESIZE) + 1
    region = mmap.mmap(-1, pages * mmap.PAGESIZE)
    end = (pages - 1) * mmap.PAGESIZE
    if sys.platform == "linux":
        last = ctypes.addressof(ctypes.c_char.from_buffer(region)) + end
        assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(last), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
    found = np.frombuffer(region, dtype, count, end - count * dtype.itemsize).reshape(shape)
    found[...] = values
    return found
