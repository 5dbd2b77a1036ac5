"""Schemes: each returns a `types.Step` for a system. "Conserved" means to round-off, in runs of any length.

| scheme | for | conserves | order |
|---|---|---|---|
| `exact`, `calibrated` | free rigid bodies | energy, momentum, form | the exact motion |
| `preprocessed` | free rigid bodies | energy, momentum | 4, 6, 8, 10, at the cost of order 2 |
| `so3_midpoint` | free bodies, gyrostats | energy, momentum; free: the form too, with the symplectic κ | 2 |
| `so3_explicit` | free rigid bodies | energy, momentum, form; solved once for a whole run: the fastest | 2 |
| `torqued_midpoint` | bodies with torques or friction | energy less work | 2 |
| `top_energy_momentum` | tops, satellites: any potential | energy (less work), γ·π | 2 |
| `splitting` | tops, satellites, gyrostats, groups with a potential, several bodies, elastic ones | form, momenta | 2 |
| `gauss` | free and elastic bodies, gyrostats, tops, satellites, several bodies | form, momenta | 2s with s stages |
| `extrapolate` | any system | nothing exactly: for short, accurate runs | 4 to 20 |
| `log_hamiltonian` | tops | form; variable step size | 2 |
| `reversible_control` | any step | what that step conserves, except the form; variable step size | 2 |
| `bodies_energy_momentum` | several bodies, with tides too | energy (less work), both momenta | 2 |
| `nystrom` | tops, satellites, several bodies | form, momenta | 4, 6 |
| `kepler_splitting` | two bodies | form, both momenta; the orbit solved exactly | 2, (8, 4), (8, 6, 4) |
| `langevin` | free bodies, tops, several bodies in a heat bath | the canonical measure; exact account of heat | 2 |
| `additive` | elastic bodies | momentum, and energy or the form; volume of incompressible bodies | 2 |
| `sphere_midpoint` | the spherical pendulum | γ·π, and energy or the form | 2 |
| `sphere_chart` | the spherical pendulum | form, γ·π; singular on the axis | 2 |
| `group_midpoint` | geodesics of any matrix group | energy, momentum; the form where the map is symplectic | 2 |
| `group_energy_momentum` | any matrix group with a potential | energy, momentum | 2 |
| `so3_alpha`, `group_alpha` | the paper's families, for study | momentum; energy: see there | 2 for α = ½, else 1 |
| `compose` | any symmetric step of order 2 | what that step conserves | 4 to 10 |

A scheme raises ValueError for a system whose equations it does not integrate. `lieint check SYSTEM` measures what each
conserves; `catalogue()` lists what they declare, with their names in the literature and sources.
"""

import sys as _sys

from lieint_jax._discover import modules_with_examples as _modules_with_examples
from lieint_jax.schemes._additive import Additive, additive
from lieint_jax.schemes._bodies_energy_momentum import BodiesEnergyMomentum, bodies_energy_momentum
from lieint_jax.schemes._calibrated import Calibrated, calibrated
from lieint_jax.schemes._compose import Composition, compose
from lieint_jax.schemes._exact import Exact, exact
from lieint_jax.schemes._extrapolate import Extrapolated, extrapolate
from lieint_jax.schemes._gauss import Gauss, gauss
from lieint_jax.schemes._group_alpha import GroupAlpha, group_alpha
from lieint_jax.schemes._group_energy_momentum import GroupEnergyMomentum, group_energy_momentum
from lieint_jax.schemes._group_midpoint import GroupMidpoint, group_midpoint
from lieint_jax.schemes._kepler_splitting import KeplerSplitting, kepler_splitting
from lieint_jax.schemes._langevin import Langevin, langevin
from lieint_jax.schemes._log_hamiltonian import LogHamiltonian, log_hamiltonian
from lieint_jax.schemes._nystrom import Nystrom, nystrom
from lieint_jax.schemes._preprocessed import Preprocessed, preprocessed
from lieint_jax.schemes._reversible_control import ReversibleControl, reversible_control
from lieint_jax.schemes._shared.elastic_splitting import ElasticSplitting
from lieint_jax.schemes._shared.free_bodies import FreeFlight
from lieint_jax.schemes._shared.gyrostat_splitting import GyrostatSplitting
from lieint_jax.schemes._shared.properties import SchemeProperties
from lieint_jax.schemes._so3_alpha import SO3Alpha, so3_alpha
from lieint_jax.schemes._so3_explicit import SO3Explicit, so3_explicit
from lieint_jax.schemes._so3_midpoint import SO3Midpoint, so3_midpoint
from lieint_jax.schemes._sphere_chart import SphereChart, sphere_chart
from lieint_jax.schemes._sphere_midpoint import SphereMidpoint, sphere_midpoint
from lieint_jax.schemes._splitting import Splitting, splitting
from lieint_jax.schemes._top_energy_momentum import TopEnergyMomentum, top_energy_momentum
from lieint_jax.schemes._torqued_midpoint import DampedMidpoint, TorquedMidpoint, torqued_midpoint
from lieint_jax.types import Catalogue

__all__ = [
    "Additive",
    "BodiesEnergyMomentum",
    "Calibrated",
    "Catalogue",
    "Composition",
    "DampedMidpoint",
    "ElasticSplitting",
    "Exact",
    "Extrapolated",
    "FreeFlight",
    "Gauss",
    "GroupAlpha",
    "GroupEnergyMomentum",
    "GroupMidpoint",
    "GyrostatSplitting",
    "KeplerSplitting",
    "Langevin",
    "LogHamiltonian",
    "Nystrom",
    "Preprocessed",
    "ReversibleControl",
    "SO3Alpha",
    "SO3Explicit",
    "SO3Midpoint",
    "SchemeProperties",
    "SphereChart",
    "SphereMidpoint",
    "Splitting",
    "TopEnergyMomentum",
    "TorquedMidpoint",
    "additive",
    "bodies_energy_momentum",
    "calibrated",
    "catalogue",
    "compose",
    "exact",
    "extrapolate",
    "gauss",
    "group_alpha",
    "group_energy_momentum",
    "group_midpoint",
    "kepler_splitting",
    "langevin",
    "log_hamiltonian",
    "nystrom",
    "preprocessed",
    "reversible_control",
    "so3_alpha",
    "so3_explicit",
    "so3_midpoint",
    "sphere_chart",
    "sphere_midpoint",
    "splitting",
    "top_energy_momentum",
    "torqued_midpoint",
]


def catalogue() -> Catalogue[SchemeProperties]:
    """The schemes as a table: what each integrates and conserves, its order, limit, names in the literature and source.

    Returns:
        A tuple of `SchemeProperties`, which prints as a table; `.markdown()` is one for a page.
    """
    return Catalogue(module.PROPERTIES for module in _modules_with_examples(_sys.modules[__name__]).values())
