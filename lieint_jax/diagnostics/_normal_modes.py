"""Normal modes of a relative equilibrium: eigenvalues of the linearized Hamiltonian flow, their signs and stability.

    δẋ = Aδx,    A = −ω⁻¹ d²K      in axes that move with the equilibrium, K as in `_equilibrium`

For a system with symmetries A has eigenvalues that do not affect stability: 0 for a shift along the motion and for a
change of the conserved momentum, ±i|ξ| for a common tilt. They belong to the group, and are computed from it. The
others are those of the symplectic slice: the perturbations that conserve the momentum, modulo the motions along
symmetries that conserve it too.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from lieint_jax._checks import concrete
from lieint_jax.core import State, System, promoted
from lieint_jax.diagnostics._critical_point import Derivatives, Problem, Spins, in_double, rounded
from lieint_jax.diagnostics._equilibrium import Equilibrium, frame_of

_RANK = 1e-7  # of the dimension of a space: singular values below this part of the largest one count as 0


class NormalModes(NamedTuple):
    """The linearized flow about a relative equilibrium. Made by `normal_modes`.

    The first m entries are the oscillation modes, by ascending frequency; the other d − m are motions along symmetries,
    with the frequencies 0 and those of the rotating axes, which do not affect stability.

    Attributes:
        frequencies: (d,), rad per unit of time, ≥ 0: the imaginary parts, in axes that move with the equilibrium.
        growth: (d,), rates of growth ≥ 0, per unit of time: the real parts; 0 for a stable mode. The eigenvalues are
            ±growth ± i frequency.
        signs: (m,), the sign of the energy K of each mode (Krein's signature); 0 for a mode that grows or has the
            frequency 0.
        vectors: (2d, m), complex, the modes in the coordinates of the phase space.
        stable: whether no eigenvalue has a real part (spectral stability).
        definite: whether K has an extremum on the slice, in all directions in which it is not constant: then the
            equilibrium is nonlinearly stable, and remains stable under dissipation if it is a minimum.
        margin: for a stable equilibrium, the distance of the frequencies from a collision at which stability can be
            lost: the least frequency, or the least difference of two frequencies of opposite sign, in rad per unit of
            time. For an unstable one, −max(growth). Frequencies 0, due to symmetries that the system does not declare,
            are ignored.
    """

    frequencies: Array
    growth: Array
    signs: Array
    vectors: Array
    stable: bool
    definite: bool
    margin: float

    @property
    def periods(self) -> Array:
        """2π over the frequencies, in the unit of time; inf for 0."""
        moving = self.frequencies > 0
        return jnp.where(moving, 2 * jnp.pi / jnp.where(moving, self.frequencies, 1), jnp.inf)


def normal_modes(system: System, state: State | Equilibrium, *, frame: ArrayLike | None = None) -> NormalModes:
    """The frequencies of small oscillations about a relative equilibrium, and whether it is stable, with a margin.

    Eigenvalues are paired exactly, ±λ. Where the energy is definite on the slice, the modes are those of a symmetric
    problem: nothing grows, and frequencies down to 1e-14 of the largest (in float32 1e-5) are found. Otherwise real and
    imaginary parts below 1e-7 of the largest eigenvalue (in float32 3e-3) are set to 0, the size of the errors of a
    double eigenvalue 0 due to a symmetry that the system does not declare.

    Args:
        system: as in `equilibrium`.
        state: a relative equilibrium to 1e-6, such as the result of `equilibrium`, which knows the bodies that spin at
            rates of their own.
        frame: as in `equilibrium`.

    Returns:
        A `NormalModes`.

    Raises:
        ValueError: the state is not a relative equilibrium; and the errors of `equilibrium`.

    Example: the wobble of a spin about the axis of greatest moment.

        >>> import lieint_jax as li
        >>> body = li.systems.rigid_body([1.0, 2.0, 3.0])
        >>> modes = li.normal_modes(body, body.state(angular_velocity=[0.0, 0.0, 1.0]))
        >>> round(float(modes.frequencies[0]), 6), modes.stable, modes.definite
        (1.0, True, True)

    Source: Marsden, Lectures on Mechanics (1992), chapters 5 and 10; Meyer & Offin 2017, Introduction to Hamiltonian
    Dynamical Systems, 3.3 (the pairs), and Krein's theorem: Yakubovich & Starzhinskii 1975, III.
    """
    given, spins = (state.state, state.spins) if isinstance(state, Equilibrium) else (state, None)
    system, at, dtype = promoted(system, given)
    if not concrete(system, at, frame):
        raise ValueError("normal_modes computes with concrete numbers: call it outside of jit, vmap and grad")
    with jax.enable_x64(True):
        modes = _about(in_double(system), in_double(at), in_double(spins), frame, float(np.finfo(dtype).eps))
    return rounded(modes, dtype)


def _about(system: System, at: State, spins: Spins | None, frame: ArrayLike | None, eps: float) -> NormalModes:
    """The modes of the equilibrium next to a state: the stress of a small displacement would stiffen soft modes."""
    system.check(at)
    problem = Problem(system, frame_of(system, at, frame, eps), spins, np.arange(system.phase_space.dim))
    step = problem.correction(at)
    if not step.is_rounding and step.size <= max(1e-6, 1e3 * eps):
        at = problem.newton(at)
        step = problem.correction(at)
    if not step.is_rounding:
        raise ValueError(
            f"this state is not a relative equilibrium: by Newton's method the next one is {step.size:.2g} away, in "
            "radians or units of the state. li.equilibrium(system, state) finds it"
        )
    found = problem.derivatives(at)
    return _modes(found, found.rates(), 8 * eps**0.5)


def _modes(found: Derivatives, rates: np.ndarray, small: float) -> NormalModes:
    """The modes, in units of the state and of momentum with which every conjugate pair has the form 1.

    Momenta of bodies on stiff and on soft springs differ as much as these: the rank of the form would be that of some.
    """
    sizes = np.abs(found.unit[:, None] * found.omega * found.unit).max(axis=1)
    found = found._replace(unit=found.unit / np.sqrt(np.where(sizes > 0, sizes, 1)))
    S, unit = found.hessian(rates), found.unit
    omega, along = unit[:, None] * found.omega * unit, found.directions()[0]
    A = -np.linalg.solve(omega, S)
    slice_, orbit = _slice(omega, along)
    form, energy = slice_.T @ omega @ slice_, slice_.T @ S @ slice_
    curvature = _curvature(energy, 16 * small**2)
    definite = bool(np.all(curvature >= 0) or np.all(curvature <= 0))
    if definite and curvature.all():
        pairs, vectors = _oscillations(form, energy, small**2)
    else:
        pairs, vectors = _pairs(-np.linalg.solve(form, energy), small)
    group = _group_rates(A, orbit, omega, along, small)
    frequencies, growth = np.abs(np.imag(pairs)), np.abs(np.real(pairs))
    signs = _signs(pairs, vectors, energy)
    stable = not growth.any()
    margin = _margin(frequencies, signs) if stable else -float(growth.max())
    return NormalModes(
        jnp.asarray(np.concatenate([frequencies, np.abs(np.imag(group))])),
        jnp.asarray(np.concatenate([growth, np.abs(np.real(group))])),
        jnp.asarray(signs),
        jnp.asarray(unit[:, None] * (slice_ @ vectors)),
        stable,
        definite,
        margin,
    )


def _slice(omega: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bases, as columns, of the symplectic slice and of the motions along symmetries.

    The slice is a complement, in the kernel V of dΦ, of V ∩ V^ω, where V^ω are the motions along symmetries.
    """
    dim = omega.shape[0]
    if not along.shape[0]:
        return np.eye(dim), np.zeros((dim, 0))
    _, sizes, rows = np.linalg.svd(along)
    rank = int((sizes > _RANK * max(sizes.max(initial=0), 1e-300)).sum())
    level = rows[rank:].T  # V
    left, sizes, _ = np.linalg.svd(level.T @ omega @ level)  # skew: the singular values are paired
    inner = int((sizes > _RANK * np.abs(omega).max()).sum())
    orbit = np.linalg.svd(np.linalg.solve(omega, rows[:rank].T), full_matrices=False)[0]
    return level @ left[:, :inner], orbit


def _curvature(energy: np.ndarray, least: float) -> np.ndarray:
    """Numbers with the signs of the eigenvalues of the energy, 0 where it is constant.

    By Sylvester's law the signs are those with coordinates in which the curvatures are alike, where the rounding errors
    of stiff ones do not decide about soft ones.
    """
    sizes = np.abs(np.diag(energy))
    unit = 1 / np.sqrt(np.maximum(np.maximum(sizes, least * sizes.max(initial=0)), 1e-300))
    curvature = np.linalg.eigvalsh(unit[:, None] * (energy + energy.T) / 2 * unit)
    return np.where(np.abs(curvature) > least * np.abs(curvature).max(initial=0), curvature, 0)


def _oscillations(form: np.ndarray, energy: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """The pairs iν of a definite energy ±LLᵀ, by ascending frequency, and their vectors as columns.

    With y = Lᵀx the flow is ẏ = ∓Lᵀ(form)⁻¹L y, a skew matrix, whose eigenvalues are imaginary in floating-point
    numbers too: stiff modes give soft ones no growth.
    """
    sign = np.sign(np.trace(energy))
    L = np.linalg.cholesky(sign * (energy + energy.T) / 2)
    K = -sign * L.T @ np.linalg.solve(form, L)
    values, vectors = np.linalg.eigh(-0.5j * (K - K.T))  # pairs ±ν
    half = len(values) // 2
    values, vectors = values[half:], np.linalg.solve(L.T, vectors[:, half:])
    return 1j * np.where(values > least * values.max(initial=0), values, 0), vectors


def _pairs(A: np.ndarray, small: float) -> tuple[np.ndarray, np.ndarray]:
    """One eigenvalue of each pair ±λ of a Hamiltonian matrix, by ascending frequency, and their vectors as columns."""
    values, vectors = np.linalg.eig(A)
    values = _round_to_zero(values, small * np.abs(values).max(initial=0))
    rest, chosen, paired = list(range(len(values))), [], []
    while rest:
        first = max(rest, key=lambda i: (np.imag(values[i]), np.real(values[i])))
        rest.remove(first)
        partner = min(rest, key=lambda i: abs(values[i] + values[first]))
        rest.remove(partner)
        chosen.append(first)
        paired.append((values[first] - values[partner]) / 2)
    order = sorted(range(len(paired)), key=lambda i: (np.imag(paired[i]), abs(np.real(paired[i]))))
    return np.array([paired[i] for i in order], complex), vectors[:, [chosen[i] for i in order]].astype(complex)


def _round_to_zero(values: np.ndarray, least: float) -> np.ndarray:
    """Eigenvalues without real and imaginary parts below `least`."""
    real, imaginary = (np.where(np.abs(x) <= least, 0, x) for x in (np.real(values), np.imag(values)))
    return real + 1j * imaginary


def _group_rates(A: np.ndarray, orbit: np.ndarray, omega: np.ndarray, along: np.ndarray, small: float) -> np.ndarray:
    """One eigenvalue of each pair that belongs to the symmetries.

    On the motions along symmetries A has the eigenvalues of ad ξ: pairs where the form does not vanish on them,
    otherwise one of each pair, whose partner belongs to the change of the momentum.
    """
    if not orbit.shape[1]:
        return np.zeros(0, complex)
    left, sizes, _ = np.linalg.svd(orbit.T @ omega @ orbit)
    inner = int((sizes > _RANK * np.abs(omega).max()).sum())
    moved, isotropy = orbit @ left[:, :inner], orbit @ left[:, inner:]
    quotient = moved.T @ A @ moved  # modulo the isotropy, which A maps to itself
    values = np.linalg.eigvals(isotropy.T @ A @ isotropy)
    scale = max(np.abs(np.linalg.eigvals(orbit.T @ A @ orbit)).max(initial=0), 1e-300)
    values = _round_to_zero(values, small * scale)
    found = np.concatenate([_pairs(quotient, small)[0], values])
    return found[np.argsort(np.abs(np.imag(found)), kind="stable")]


def _signs(pairs: np.ndarray, vectors: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """The sign of the energy of each oscillation; for equal frequencies, that of the computed vectors."""
    values = np.einsum("im,ij,jm->m", vectors.conj(), energy, vectors)
    oscillating = (np.real(pairs) == 0) & (np.imag(pairs) > 0)
    return np.where(oscillating, np.sign(np.real(values)), 0).astype(int)


def _margin(frequencies: np.ndarray, signs: np.ndarray) -> float:
    """The distance to a collision at 0, or of two frequencies of opposite sign; inf without modes."""
    distances = [x for x in frequencies if x > 0]
    for i, sign in enumerate(signs):
        distances += [abs(frequencies[i] - frequencies[j]) for j in range(i) if sign * signs[j] < 0]
    return float(min(distances, default=np.inf))
