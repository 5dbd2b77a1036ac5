"""Bodies by their shape: mass, center, tensor of inertia and higher moments, and the facets that reflect light.

| | |
|---|---|
| `ellipsoid`, `box`, `cylinder` | homogeneous solids, in closed form |
| `sites` | point masses |
| `mesh`, `obj` | a homogeneous polyhedron of triangles, from arrays or a file |
| `surface` | the vertices and triangles of a file, OBJ or STL |
| `facets`, `ellipsoid_facets`, `box_facets` | the surface of a convex body, for light curves (`li.measure`) |

Shapes can be added with `+` and placed with `moved`. Every system, potential or torque that needs an inertia accepts a
shape. All moments and facets are differentiable with respect to semi-axes, points, vertices and masses.
"""

from lieint_jax.shapes._facets import Facets, box_facets, ellipsoid_facets, facets
from lieint_jax.shapes._solids import Shape, box, cylinder, ellipsoid, mesh, obj, sites, surface
from lieint_jax.shapes._solids import trace_free as trace_free

__all__ = [
    "Facets",
    "Shape",
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
