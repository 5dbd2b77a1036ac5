"""A scheme takes the systems that inherit the equations of motion which it integrates, and refuses all others."""

import dataclasses
import functools
import re

import data_files
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid import systems

import lieint_jax as li
from lieint_jax import _discover, core, schemes
from lieint_jax.core import State

J = jnp.array([1.0, 2.0, 3.0])
BODY = li.systems.rigid_body(J)
TOP = li.systems.heavy_top(J, [0.3, -0.2, 1.0])
ARGUMENTS = {"nystrom": {"order": 4}, "preprocessed": {"order": 4}, "langevin": {"temperature": 1.0, "friction": 0.1}}
SCHEMES = {
    entry: functools.partial(getattr(schemes, entry.name), **ARGUMENTS.get(entry.name, {}))
    for entry in schemes.catalogue()
    if entry.name not in ("compose", "extrapolate")  # one accepts steps, one every system
}
KINDS = {type(system).__name__: system for _, (system, *_) in reversed(systems())}
# the beginnings of messages, and the schemes that they name; those of systems that are not here are found
INTEGRATES, FITTING = data_files.table("accepted_systems").values()
OTHERWISE = {  # the end of a message about the systems that many accept
    "group_midpoint": "; with a potential use group_energy_momentum",
    "so3_alpha": "; for a body that stays on SO(3), which α = 1/2 does, use so3_midpoint",
}


def of_another_group(scheme, system):
    """Whether a scheme accepts the equations of a system, but not on this group."""
    if scheme == "nystrom":
        return isinstance(system, (li.systems.GroupPotential, li.systems.DrivenGroupPotential))
    return scheme == "log_hamiltonian" and not isinstance(system, li.systems.PotentialTop)


class Undeclared:
    """A gyrostat, H = ½(Π−ℓ)·J⁻¹(Π−ℓ), with an inertia and no potential, that declares nothing."""

    phase_space, inertia, rotor = BODY.phase_space, J, jnp.array([0.0, 0.0, 0.4])

    def angular_velocity(self, state):
        return (li.groups.so3.Ad_star(state.q, state.p) - self.rotor) / self.inertia

    def energy(self, state):
        Omega = self.angular_velocity(state)
        return jnp.sum(self.inertia * Omega * Omega) / 2

    def momentum(self, state):
        return state.p

    def vector_field(self, state):
        return State(li.groups.so3.tangent(state.q, self.angular_velocity(state)), jnp.zeros(3))

    def check(self, state):
        pass


@li.pytree
class Gyrostat(li.systems.RigidBody):
    """The same as a subclass of the free body, which inherits its equations."""

    inertia: jax.Array
    rotor: jax.Array

    def angular_velocity(self, state):
        return (self.body_momentum(state) - self.rotor) / self.inertia


class Doubled:
    """Twice the force, and a little more."""

    def vector_field(self, state):
        q, p, *_ = super().vector_field(state)
        return State(q, 2 * p + 0.1)


@pytest.mark.parametrize("kind", [*KINDS, "str", "Undeclared"])
def test_every_scheme_refuses_every_other_system_and_names_those_that_accept_it(kind):
    """And a subclass of each system that a scheme accepts, with another motion."""
    system = KINDS.get(kind, Undeclared() if kind == "Undeclared" else "a top")
    assert {entry.name for entry in SCHEMES} >= set(INTEGRATES)
    assert set(KINDS) > set(FITTING)
    accept = [entry.name for entry in SCHEMES if isinstance(system, entry.accepts)]
    new = set(accept) - {name for names in FITTING.values() for name in names.split(" or ")} - set(INTEGRATES)
    few = sorted(new.union(FITTING[kind].split(" or ")) if kind in FITTING else accept)
    few = " or ".join(few if len(few) <= 3 else [])
    for entry, make in SCHEMES.items():
        if isinstance(system, entry.accepts):
            changed = li.pytree(type("Changed", (Doubled, type(system)), {}))(
                **{field.name: getattr(system, field.name) for field in dataclasses.fields(system)}
            )
            known = not of_another_group(entry.name, system)
            message = r"Changed\.vector_field overrides their equations" if known else ", got Changed"
            with pytest.raises(ValueError, match=f"{entry.name} integrates .*{message}"):
                make(changed)
            if known:
                continue
        end = f"; use {few}" if few else OTHERWISE.get(entry.name, "")
        message = f"^{entry.name} integrates {INTEGRATES.get(entry.name, '')}.*, got {kind}{re.escape(end)}$"
        if entry.name == "log_hamiltonian" and kind in ("DrivenTop", "GravityGradient", "DrivenGroupPotential"):
            message = f"needs a constant energy, got {kind}, whose potential depends on time"
        with pytest.raises(ValueError, match=message):
            make(system)


def test_a_changed_angular_velocity_is_refused_too_and_of_traced_systems():
    gyrostat = Gyrostat(J, jnp.array([0.0, 0.0, 0.4]))
    for entry, make in SCHEMES.items():
        if isinstance(gyrostat, entry.accepts):
            with pytest.raises(ValueError, match=rf"{entry.name} integrates .*Gyrostat\.angular_velocity overrides"):
                make(gyrostat)
    with pytest.raises(ValueError, match=r"Gyrostat\.angular_velocity"):
        jax.jit(lambda rotor: schemes.so3_midpoint(Gyrostat(J, rotor)).order)(gyrostat.rotor)
    jax.jit(lambda J: schemes.so3_midpoint(li.systems.rigid_body(J))(BODY.state(spatial_momentum=J), 0.1))(J)


def with_other_moments(system):
    """The system with unequal moments or an unequal metric, in axes of their own; None if it has neither."""
    rng = np.random.default_rng(5)

    def drawn(size, d):
        axes = np.linalg.qr(rng.normal(size=(d, d)))[0]
        tensor = size * (axes * np.linspace(1, 1.8, d)) @ axes.T
        return (tensor + tensor.T) / 2

    changed = {}
    for field in dataclasses.fields(system):
        old = np.asarray(getattr(system, field.name)) if field.name in ("inertia", "inertias", "metric") else None
        if old is not None and old.ndim:
            size, d = old[old > 0].mean(), old.shape[-1]
            several = field.name == "inertias"
            new = np.stack([drawn(size, d) for _ in old]) if several else drawn(size, d)
            changed[field.name] = jnp.asarray(new)
    return dataclasses.replace(system, **changed) if changed else None


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, (system, *_) in systems() if dataclasses.is_dataclass(system)])
def test_every_step_moves_by_the_vector_field_of_its_system(name):
    """With unequal moments in axes of their own: the symmetry of an example hides mistakes."""
    system, state, _ = dict(systems())[name]
    system, dt = with_other_moments(system) or system, 2e-5  # the error is O(Δt²), of elastic bodies 1200 Δt²
    if isinstance(system, li.systems.IncompressibleBody):  # whose momenta depend on the moments
        state = system.state(state.q, momentum=state.p)
    if isinstance(system, li.systems.TorquedBody):  # whose computer looks at t = 0 at these moments
        state, _ = system.sampled(state, jnp.asarray(dt))
    for module in _discover.modules_with("examples", schemes).values():
        for step in module.examples(system).values():
            if step.name.startswith("langevin"):  # whose heat changes π by √Δt
                continue
            start = step.start(state)
            (end, _), (back, _) = step(start, dt), step(start, -dt)
            passed, rate = (end.t - back.t if step.own_time else 2 * dt), system.vector_field(start)
            for z_dot, last, first in ((rate.q, end.q, back.q), (rate.p, end.p, back.p)):
                error = 1e-5 * (1 + np.max(np.abs(z_dot), initial=0))
                np.testing.assert_allclose((last - first) / passed, z_dot, rtol=0, atol=error, err_msg=step.name)


@li.pytree
class Wrong(core.PotentialWithGradient):
    """A slip in the gradient, by which energy would drift."""

    def __call__(self, Gamma, t=None):
        return Gamma[0] ** 2 + 0.5 * Gamma[2]

    def gradient(self, Gamma, t=None):
        return jnp.array([Gamma[0], 0.0, 0.5])


@li.pytree
class WrongStress(core.StoredEnergy):
    """Half of the stress."""

    def __call__(self, C):
        return jnp.sum((C - jnp.eye(3)) ** 2)

    def stress(self, C):
        return tuple(2 * (c - one) for c, one in zip(C, (1, 1, 1, 0, 0, 0), strict=True))

    def mean_stress(self, C, D):
        return self.stress(C)


def test_a_wrong_derivative_in_closed_form_is_refused():
    for make in (li.systems.potential_top, li.systems.driven_top):
        with pytest.raises(ValueError, match=r"Wrong\.gradient must be the derivative of its values"):
            make(J, Wrong())
        with pytest.raises(ValueError, match=r"Wrong\.gradient must be the derivative of its values"):
            jax.jit(lambda J, make=make: make(J, Wrong()).inertia)(J)
    for call in (lambda call: call, jax.jit):
        with pytest.raises(ValueError, match=r"WrongStress\.stress must be the derivative of its values"):
            call(lambda J: li.systems.pseudo_rigid_body(J, WrongStress()).inertia)(J)


@pytest.mark.long
def test_extrapolation_integrates_an_altered_motion():
    """Not as that of the class from which it inherits, whose unknowns of one body it knows."""
    changed = li.pytree(type("Changed", (Doubled, type(BODY)), {}))(BODY.inertia)
    state, dt = changed.state(angular_velocity=[0.1, 0.2, 1.0]), 0.1
    end, info = schemes.extrapolate(changed, 4)(state, dt)
    assert info.converged
    np.testing.assert_allclose(end.p - state.p, dt * changed.vector_field(state).p, rtol=1e-12)


class Torque:
    """Another torque, which kicks and the vector field have, and schemes by the potential have not."""

    def force(self, q):
        return 2 * super().force(q)


@pytest.mark.long
def test_another_force_is_refused_by_schemes_that_use_the_potential_and_taken_by_those_that_use_the_force():
    changed = li.pytree(type("Changed", (Torque, type(TOP)), {}))(TOP.inertia, TOP.potential, TOP.axis)
    for name in ("top_energy_momentum", "gauss"):
        with pytest.raises(ValueError, match=f"{name} integrates .*Changed.force overrides"):
            getattr(schemes, name)(changed)
    state, dt = TOP.state(angular_velocity=[0.1, 0.2, 1.0]), 0.02
    twice = li.systems.potential_top(TOP.inertia, li.systems.LinearPotential(2 * TOP.potential.weight), TOP.axis)
    expected = schemes.splitting(twice)(state, dt)[0]
    np.testing.assert_allclose(schemes.splitting(changed)(state, dt)[0].p, expected.p, rtol=1e-14)
    best = schemes.extrapolate(changed)(state, dt)[0]
    np.testing.assert_allclose(best.p, schemes.extrapolate(twice)(state, dt)[0].p, rtol=1e-12)


def test_extreme_bodies_are_accepted():
    """Rounding is no other motion: rods, full tensors of ratio 1e10, large and small units, float32."""
    turn = li.groups.so3.to_matrix(li.groups.so3.exp(jnp.array([0.3, 0.2, 0.5])))
    for moments in ([1e-10, 1.0, 1.0], [1e-12, 1e-12, 1.9e-12], [1e20, 2e20, 2.5e20], [1.0, 1.0, 1.0]):
        for inertia in (jnp.array(moments), turn @ jnp.diag(jnp.array(moments)) @ turn.T):
            schemes.so3_midpoint(li.systems.rigid_body(inertia))
            schemes.splitting(li.systems.heavy_top(inertia, [0.0, 0.0, 1.0]))
    schemes.so3_midpoint(li.systems.rigid_body(J.astype(jnp.float32)))


def test_every_system_declares_what_it_is():
    """The examples of all systems: each has one kind of equations, and none has two that exclude each other."""
    flows = (
        li.systems.AbstractFreeBody,
        li.systems.EmbeddedBody,
        li.systems.Euler,
        li.systems.RightEuler,
    )
    kinds = (
        *flows,
        li.systems.AbstractForcedSystem,
        li.systems.PseudoRigidBody,
        li.systems.IncompressibleBody,
        li.systems.Pendulum,
    )
    kinds += (
        li.systems.AbstractDrivenSystem,
        li.systems.Gyrostat,
        li.systems.DrivenGyrostat,
        li.systems.TorquedBody,
        li.systems.InertiaInTime,
        li.systems.TorquedInertiaInTime,
        li.systems.DampedBody,
        li.systems.AbstractDissipativeBodies,
        li.systems.ViscousBody,
        li.systems.Kinematics,
    )
    for name, (system, _, _) in systems():
        assert isinstance(system, core.System), name
        assert sum(isinstance(system, kind) for kind in kinds) == 1, name


def test_groups_with_analytic_functions_are_distinguished_from_others():
    class Plain:
        """so3 in a class: all that a `Group` must have."""

    for name in core.Group.__protocol_attrs__ if hasattr(core.Group, "__protocol_attrs__") else dir(li.groups.so3):
        setattr(Plain, name, getattr(li.groups.so3, name, None))
    assert isinstance(li.groups.special_euclidean(2), core.AnalyticGroup)
    assert not isinstance(li.groups.so3, core.AnalyticGroup)
    assert not isinstance(Plain(), core.AnalyticGroup)


def test_a_custom_step_needs_public_names_only():
    """Explicit Euler for the kinematics: what `li.pytree`, `li.static` and `li.Step` are public for."""

    @li.pytree
    class Forward(li.Step):
        system: li.systems.RigidBody
        order: float = li.static(default=1)
        symmetric: bool = li.static(default=False)

        @property
        def name(self):
            return "forward"

        def advance(self, state, dt):
            q = state.q + dt * self.system.vector_field(state).q
            q = q / jnp.sqrt(jnp.sum(q * q))
            return State(q, state.p), li.StepInfo(jnp.zeros(()), jnp.isfinite(q).all())

    run = li.integrate(Forward(BODY), BODY.state(angular_velocity=[0.2, 0.0, 1.0]), 0.01, 10)
    assert run.state.q.shape == (11, 4)
    assert run.info.converged.all()


def test_a_system_declares_the_drift_of_its_splitting():
    """It comes before that of its free motion, and must be symmetric like any other."""

    class Own(li.systems.PotentialTop):
        default_drift = "exact"

    top = li.pytree(Own)(BODY.inertia, lambda Gamma: Gamma[2], jnp.array([0.0, 0.0, 1.0]))
    assert isinstance(li.schemes.splitting(top).drift, li.schemes.Exact)
    Own.default_drift = "extrapolate"
    with pytest.raises(ValueError, match="drift must be a symmetric step"):
        li.schemes.splitting(top)


@pytest.mark.parametrize(
    ("final", "hook"), [("__call__", "advance"), ("prepare", "with_constants"), ("tangent", "advance_tangents")]
)
def test_a_step_that_overrides_a_final_method_is_refused_where_it_is_defined(final, hook):
    """Else steps made of it, and runs, would call one method or the other."""
    with pytest.raises(TypeError, match=f"Custom overrides {final}, which is final: define {hook} in its place"):
        type("Custom", (li.Step,), {final: lambda self, state, dt: None})


def test_two_classes_with_the_same_fields_have_different_structures():
    """Else jit may run the program of one for the other: a doubled force was, now and then, not seen."""
    changed = li.pytree(type("Changed", (Doubled, type(TOP)), {}))
    other = changed(**{field.name: getattr(TOP, field.name) for field in dataclasses.fields(TOP)})
    assert jax.tree.structure(other) != jax.tree.structure(TOP)
    assert jax.tree.structure(other) == jax.tree.structure(dataclasses.replace(other, inertia=2 * TOP.inertia))
