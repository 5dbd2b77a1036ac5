"""The C file for authors of engines, compiled and called here."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

SOURCE = Path(__file__).parents[2] / "benchmarks" / "baseline" / "engine.c"
VECTOR = ctypes.POINTER(ctypes.c_double)
TORQUE = ctypes.CFUNCTYPE(None, ctypes.c_double, VECTOR, VECTOR, VECTOR, ctypes.c_void_p)
FLAGS = ["-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-O2", "-shared", "-fPIC"]


class Body(ctypes.Structure):
    _fields_ = (("q", ctypes.c_double * 4), ("pi", ctypes.c_double * 3))

    @classmethod
    def of_state(cls, state):
        return cls((ctypes.c_double * 4)(*state.q), (ctypes.c_double * 3)(*state.p))


@functools.cache
def library():
    """The compiled file; the test is skipped where there is no C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    folder = tempfile.mkdtemp()
    subprocess.run([compiler, *FLAGS, str(SOURCE), "-o", f"{folder}/engine.so", "-lm"], check=True)
    loaded = ctypes.CDLL(f"{folder}/engine.so")
    number, body = ctypes.c_double, ctypes.POINTER(Body)
    loaded.so3_midpoint.argtypes = [VECTOR, body, number]
    loaded.so3_prepare.argtypes = [VECTOR, body, number, VECTOR]
    loaded.so3_explicit.argtypes = [VECTOR, number, body, number]
    loaded.torqued_midpoint.argtypes = [VECTOR, TORQUE, ctypes.c_void_p, body, number, number, VECTOR]
    return loaded


def vector(values):
    return (ctypes.c_double * len(values))(*values)


def midpoint(J, state, dt, steps):
    """q, π and whether every step was solved."""
    body = Body.of_state(state)
    solved = [library().so3_midpoint(vector(J), body, dt) for _ in range(steps)]
    return np.array(body.q), np.array(body.pi), all(solved)


def explicit(J, state, dt, steps):
    """q, π and whether every step was solved."""
    body, m = Body.of_state(state), ctypes.c_double()
    solved = [library().so3_prepare(vector(J), body, dt, ctypes.byref(m))]
    solved += [library().so3_explicit(vector(J), m, body, dt) for _ in range(steps)]
    return np.array(body.q), np.array(body.pi), all(solved)


def torqued(J, law, state, dt, steps):
    """q, π, the work, and whether every step was solved, under law(t, q, Ω) ↦ (3,) in the body."""

    def call(t, q, Omega, torque, _):
        for i, value in enumerate(law(t, np.array(q[:4]), np.array(Omega[:3]))):
            torque[i] = value

    body, work = Body.of_state(state), ctypes.c_double(0.0)
    solved = [
        library().torqued_midpoint(vector(J), TORQUE(call), None, body, n * dt, dt, ctypes.byref(work))
        for n in range(steps)
    ]
    return np.array(body.q), np.array(body.pi), work.value, all(solved)
