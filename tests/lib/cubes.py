"""The unit cube as a mesh."""

import itertools

import numpy as np

CUBE = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = [[a, b, c] for q in QUADS for a, b, c in (q[:3], (q[0], *q[2:]))]
