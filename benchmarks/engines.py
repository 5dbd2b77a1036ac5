"""Which integrator should an engine with contacts and fluids use for a free rigid body?

Two cases of one box: MuJoCo's own test FreeBodyConservation (no force; a box of half lengths 0.1, 0.2, 0.3 and density
1000, ω = (1, 2, 3), Δt = 0.01, 500 steps), and the same box in a viscous fluid, whose torque is linear in ω. The
integrators are MuJoCo's, and the three steps of baseline/engine.c. The exact motion is scipy's DOP853 at 1e-13.

    python benchmarks/engines.py            (needs mujoco, scipy and a C compiler; a minute)
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from lib.command import results_folder
from lib.report import publish

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "lib"))
