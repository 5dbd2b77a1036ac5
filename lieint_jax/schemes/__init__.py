"""Schemes: each makes a `types.Step` for a system. Each module has `examples(system)`, its steps for that system."""

from lieint_jax.schemes.additive import Additive, additive
from lieint_jax.schemes.bodies_energy_momentum import BodiesEnergyMomentum, bodies_energy_momentum
from lieint_jax.schemes.calibrated import Calibrated, calibrated
from lieint_jax.schemes.compose import Composition, compose
from lieint_jax.schemes.exact import Exact, exact
from lieint_jax.schemes.extrapolate import Extrapolated, extrapolate
from lieint_jax.schemes.gauss import Gauss, gauss
from lieint_jax.schemes.group_alpha import GroupAlpha, group_alpha
from lieint_jax.schemes.group_energy_momentum import GroupEnergyMomentum, group_energy_momentum
from lieint_jax.schemes.group_midpoint import GroupMidpoint, group_midpoint
from lieint_jax.schemes.kepler_splitting import KeplerSplitting, kepler_splitting
from lieint_jax.schemes.log_hamiltonian import LogHamiltonian, log_hamiltonian
from lieint_jax.schemes.nystrom import Nystrom, nystrom
from lieint_jax.schemes.preprocessed import Preprocessed, preprocessed
from lieint_jax.schemes.reversible_control import ReversibleControl, reversible_control
from lieint_jax.schemes.so3_alpha import SO3Alpha, so3_alpha
from lieint_jax.schemes.so3_explicit import SO3Explicit, so3_explicit
from lieint_jax.schemes.so3_midpoint import SO3Midpoint, so3_midpoint
from lieint_jax.schemes.sphere_chart import SphereChart, sphere_chart
from lieint_jax.schemes.sphere_midpoint import SphereMidpoint, sphere_midpoint
from lieint_jax.schemes.splitting import Splitting, splitting
from lieint_jax.schemes.top_energy_momentum import TopEnergyMomentum, top_energy_momentum
from lieint_jax.schemes.torqued_midpoint import DampedMidpoint, TorquedMidpoint, torqued_midpoint

__all__ = [
    "Additive",
    "BodiesEnergyMomentum",
    "Calibrated",
    "Composition",
    "DampedMidpoint",
    "Exact",
    "Extrapolated",
    "Gauss",
    "GroupAlpha",
    "GroupEnergyMomentum",
    "GroupMidpoint",
    "KeplerSplitting",
    "LogHamiltonian",
    "Nystrom",
    "Preprocessed",
    "ReversibleControl",
    "SO3Alpha",
    "SO3Explicit",
    "SO3Midpoint",
    "SphereChart",
    "SphereMidpoint",
    "Splitting",
    "TopEnergyMomentum",
    "TorquedMidpoint",
    "additive",
    "bodies_energy_momentum",
    "calibrated",
    "compose",
    "exact",
    "extrapolate",
    "gauss",
    "group_alpha",
    "group_energy_momentum",
    "group_midpoint",
    "kepler_splitting",
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
