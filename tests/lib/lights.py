"""Geometries of light on a body."""

import numpy as np


def directions(seed, count=40):
    """Attitudes, and directions to Sun and observer at phase angles below 90°."""
    rng = np.random.default_rng(seed)
    q, sun, observer = (rng.normal(size=(count, k)) for k in (4, 3, 3))
    q, sun = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (q, sun))
    observer = sun + 0.9 * observer / np.linalg.norm(observer, axis=1, keepdims=True)
    return q, sun, observer / np.linalg.norm(observer, axis=1, keepdims=True)
