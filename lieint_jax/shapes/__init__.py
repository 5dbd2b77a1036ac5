"""Bodies by their shape: mass, center, tensor of inertia and higher moments, and the facets that reflect light.

| | |
|---|---|
| `ellipsoid`, `box`, `cylinder` | homogeneous solids, in closed form |
| `sites` | point masses |
| `body` | given mass, center and inertia |
| `mesh`, `obj` | a homogeneous polyhedron of triangles, from arrays or a file |
| `surface` | the vertices and triangles of a file: OBJ, STL, PLY, plate models of DAMIT and the PDS |
| `facets`, `ellipsoid_facets`, `box_facets` | a convex body, for light curves; `GlossyFacets`: with a lobe |

Shapes can be added with `+` and placed with `moved`. Every system, potential or torque that needs an inertia accepts a
shape. All moments and facets are differentiable with respect to semi-axes, points, vertices and masses.
"""

from lieint_jax.shapes._facets import Facets, GlossyFacets, box_facets, ellipsoid_facets, facets
from lieint_jax.shapes._solids import Shape, body, box, cylinder, ellipsoid, mesh, sites
from lieint_jax.shapes._solids import trace_free as trace_free
from lieint_jax.shapes._surfaces import ENDINGS as ENDINGS
from lieint_jax.shapes._surfaces import obj, surface

__all__ = [
    "Facets",
    "GlossyFacets",
    "Shape",
    "body",
    "box",
    "box_facets",
    "cylinder",
    "ellipsoid",
    "ellipsoid_facets",
    "facets",
    "mesh",
    "obj",
    "sites",
    "surface",
]
__dir__ = __all__.copy
