"""What tests of runs into stores share: chunks of few rows, crashes, and equality bit for bit."""

import jax
import numpy as np

from lieint_jax.ensemble import _job


class Crash(BaseException):
    """As if the process ended here."""


def commit_every(monkeypatch, rows):
    """Let runs commit after every `rows` saves, on disks and in buckets, so that a short run has many commits."""
    for name in ("buffer_rows", "bucket_rows"):
        monkeypatch.setattr(_job.Job, name, lambda self, across: rows)


def assert_same(a, b):
    """Trees of arrays in memory or on disk are the same, bit for bit."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x[...], y[...])
