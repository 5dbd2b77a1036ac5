"""The C++ baselines, compiled here and called in this process: the same schemes on the same states."""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from lib.contest import Contestant

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")
_SOURCES = Path(__file__).parents[1] / "baseline"
_PACE = 1.5e8


class Bodies(NamedTuple):
    """States as a structure of arrays: q (4, B), p (3, B), and per body the largest residual and a converged flag."""

    q: np.ndarray
    p: np.ndarray
    residual: np.ndarray
    converged: np.ndarray


@functools.cache
def library(name: str) -> tuple[ctypes.CDLL, float]:
    """The compiled baseline/NAME.cpp and the seconds its compilation took; ImportError without g++."""
    if shutil.which("g++") is None:
        raise ImportError("no g++")
    binary = _SOURCES / "bin" / f"{name}.so"
    binary.parent.mkdir(exist_ok=True)
    start = time.perf_counter()
    subprocess.run(["g++", *FLAGS, str(_SOURCES / f"{name}.cpp"), "-o", str(binary)], check=True)
    return ctypes.CDLL(str(binary)), time.perf_counter() - start


def notes(name: str) -> list[str]:
    """A line for the report on the build of baseline/NAME.cpp."""
    if shutil.which("g++") is None:
        return []
    version = subprocess.run(["g++", "--version"], check=True, capture_output=True, text=True).stdout.splitlines()[0]
    return [f"C++ by {version}, {' '.join(FLAGS)}, in {library(name)[1]:.1f} s"]


def symplectic(
    form: Literal["newton", "scalar"], inertia: Sequence[float], dt: float, dtype: str = "float64"
) -> Contestant:
    """The free body's step with the symplectic κ, by Newton on the vector h or by the scalar form."""
    function = getattr(library("free_rigid_body")[0], f"{form}_{dtype}")
    narrow = form == "scalar"
    return _contestant(f"C++ symplectic, {form} form", function, inertia, dt, dtype, narrow)


def in_blocks(scheme: Literal["midpoint", "explicit"], inertia: Sequence[float], dt: float) -> Contestant:
    """The same step, or the one that computes m once, vectorized over blocks of bodies that make all steps at once."""
    function = getattr(library("free_rigid_body_blocks")[0], f"{scheme}_float64")
    return _contestant(f"C++ in blocks, {scheme}", function, inertia, dt, "float64", narrow=True)


def top(
    scheme: Literal["splitting", "energy_momentum"], inertia: Sequence[float], weight: Sequence[float], dt: float
) -> Contestant:
    """A scheme for heavy tops with the axis e₃: the splitting, or the energy-momentum scheme with the Cayley κ."""
    function = getattr(library("heavy_top")[0], f"{scheme}_float64")
    name = "C++ splitting" if scheme == "splitting" else "C++ energy-momentum"
    return _contestant(name, function, [*inertia, *weight], dt, "float64", narrow=scheme == "splitting")


def _contestant(
    name: str, function: Any, constants: Sequence[float], dt: float, dtype: str, narrow: bool
) -> Contestant:
    """A contestant of a C++ function. Its flags have one byte if `narrow`, else the size of a number."""
    function.restype = None
    flag = np.dtype("u1" if narrow else f"i{np.dtype(dtype).itemsize}")
    numbers = np.asarray(constants, np.float64)

    def load(q: np.ndarray, p: np.ndarray) -> Bodies:
        q, p = (np.ascontiguousarray(x.T, dtype) for x in (q, p))
        return Bodies(q, p, np.zeros(len(q.T), dtype), np.ones(len(q.T), flag))

    def advance(bodies: Bodies, num_steps: int) -> Bodies:
        bodies = Bodies(*(x.copy() for x in bodies))
        count = bodies.residual.size
        pointers = [ctypes.c_void_p(x.ctypes.data) for x in (*bodies, numbers)]
        function(*pointers[:4], ctypes.c_int64(count), ctypes.c_int64(num_steps), ctypes.c_double(dt), pointers[4])
        return bodies

    def read(bodies: Bodies) -> tuple[np.ndarray, np.ndarray]:
        return bodies.q.T, bodies.p.T

    def info(bodies: Bodies) -> tuple[float, bool]:
        return float(bodies.residual.max()), bool(bodies.converged.all())

    return Contestant(name, dtype, _PACE, load, advance, read, info)
