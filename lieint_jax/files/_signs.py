"""The sign of quaternions along a file, which is free."""

from __future__ import annotations

import numpy as np


def join_signs(q: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4), each with the sign that is nearer to the one before."""
    signs = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return np.concatenate([q[:1], q[1:] * np.cumprod(signs)[:, None]])
