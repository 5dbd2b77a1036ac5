"""What tests of runs into stores share: a disk that fails, and equality bit for bit."""

import contextlib
import os
from unittest import mock

import jax
import numpy as np

import lieint_jax as li


class Crash(BaseException):
    """As if the process ended here."""


@contextlib.contextmanager
def disk_for(most, error=Crash):
    """The disk fails with `error` after so many waits for it; returns the list of the waits that were begun."""
    waits, sync = [], os.fsync

    def fsync(descriptor):
        waits.append(descriptor)
        if len(waits) > most:
            raise error
        sync(descriptor)

    with mock.patch.object(os, "fsync", fsync):
        yield waits


def assert_same(a, b):
    """Trees of arrays, or the saves of runs, in memory or on disk, are the same, bit for bit."""
    a, b = ((x.trajectory, x.summary) if isinstance(x, li.Run) else x for x in (a, b))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x[...], y[...])
