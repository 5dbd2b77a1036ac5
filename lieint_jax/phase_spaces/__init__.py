"""Phase spaces: perturbed states, coordinates of tangent vectors, and the symplectic form."""

from lieint_jax.phase_spaces._embedded import EmbeddedRotations
from lieint_jax.phase_spaces._groups import ConfigurationGroup, CotangentGroup
from lieint_jax.phase_spaces._matrices import CotangentMatrices, CotangentUnimodular
from lieint_jax.phase_spaces._motions import CotangentMotions
from lieint_jax.phase_spaces._sphere import CotangentSphere, frame

__all__ = [
    "ConfigurationGroup",
    "CotangentGroup",
    "CotangentMatrices",
    "CotangentMotions",
    "CotangentSphere",
    "CotangentUnimodular",
    "EmbeddedRotations",
    "frame",
]
