"""What the systems declare of themselves, against their energies, momenta and vector fields."""

import jax
import jax.numpy as jnp
import pytest

import lieint_jax as li
from lieint_jax import _discover, capabilities
from lieint_jax.core import energy_less_work, time_derivative

ENTRIES = {entry.name: entry for entry in li.systems.catalogue()}
EXAMPLES = {name: module.examples() for name, module in _discover.modules_with("examples", li.systems).items()}
FORCED = (
    capabilities.AbstractTorquedBody,
    capabilities.AbstractTorquedBodyInTime,
    capabilities.AbstractDampedBody,
    capabilities.AbstractDissipativeBodies,
    capabilities.AbstractViscousBody,
)
GIVEN = {
    name for name, found in EXAMPLES.items() if not all(x[0].hamiltonian for x in found.values())
}  # without energy
CASES = [  # the first of each system by default, the others in the shards
    pytest.param(name, key, marks=[pytest.mark.long] * (key != next(iter(found)) or name in ("euler", "rigid_bodies")))
    for name, found in EXAMPLES.items()
    for key in found
    if name not in GIVEN
]


def with_work(system, state):
    """The state, with a work that is counted where the system does work."""
    time = state.t if state.t is not None else jnp.zeros(())
    counted = state._replace(t=time, work=jnp.zeros(()))
    works = jax.eval_shape(type(system).vector_field, system, counted).work is not None
    return state._replace(t=time, work=jnp.zeros(())) if works else state


def perturbed(system, state):
    """A state of no symmetry near an example."""
    space = system.phase_space
    return space.perturb(state, 0.1 * jnp.sin(1.0 + jnp.arange(space.dim)))


def casimirs(system, state):
    group = system.phase_space.group
    return group.casimirs(group.Ad_star(state.q, state.p))


def test_every_system_has_an_entry_with_a_source():
    assert set(ENTRIES) == set(EXAMPLES)
    for entry in ENTRIES.values():
        assert entry.source
        assert entry.aliases
        assert entry.models
        assert entry.conserves or entry.name in GIVEN
        assert callable(getattr(li.systems, entry.name))
    assert len(repr(li.systems.catalogue()).splitlines()) == len(ENTRIES) + 1
    assert li.systems.catalogue().markdown().count("\n| `") == len(ENTRIES)


@pytest.mark.long
@pytest.mark.parametrize(("name", "key"), CASES)
def test_what_is_declared_conserved_has_no_derivative_along_the_motion(name, key):
    """dF·X = 0 at a state without symmetry, for the energy, the momentum map and the Casimirs."""
    system, state, _ = EXAMPLES[name][key]
    entry, state = ENTRIES[name], with_work(system, perturbed(system, state))

    @jax.jit
    def rates(system, state):
        """The relative time derivatives of energy, momentum and Casimirs."""
        functions = [energy_less_work, lambda own, z: own.momentum(z)]
        functions += [casimirs] if "Casimirs" in entry.conserves else []
        functions += [lambda own, z: own.phase_space.defect(z)] if "volume" in entry.conserves else []  # det F − 1
        rate = time_derivative(system, state)
        pairs = [jax.jvp(lambda z, f=f: f(system, z), (state,), (rate,)) for f in functions]
        sizes = [jnp.maximum(jnp.max(jnp.abs(value), initial=0), 1) for value, _ in pairs]
        return [jnp.max(jnp.abs(slope), initial=0) / size for (_, slope), size in zip(pairs, sizes, strict=True)]

    energy, momentum, *more = rates(system, state)
    count = jax.eval_shape(type(system).momentum, system, state).shape[0]
    assert any(x.startswith("energy") for x in entry.conserves)
    assert energy < 1e-14  # observed: up to 1.8e-15, with that of momentum
    assert momentum < 1e-14
    assert not entry.sizes or count in entry.sizes
    assert any(x.startswith("momentum") for x in entry.conserves) or count == 0
    assert all(rate < 1e-14 for rate in more)


@pytest.mark.paper("2.1: (2.11)–(2.13)", "the free rigid body", "systems/_rigid_body.py")
@pytest.mark.paper("5.1.7: (5.15)–(5.20)", "left-invariant energy", "systems/_euler.py")
@pytest.mark.paper("5.1.8: (5.21), (5.22)", "momentum maps", "systems/_euler.py")
@pytest.mark.paper("5.4: (5.41), (5.42)", "a potential on a group", "systems/_group_potential.py")
@pytest.mark.paper("6, 6.1: (6.1)–(6.4)", "pseudo-rigid bodies", "systems/_pseudo_rigid_body.py")
@pytest.mark.long
@pytest.mark.parametrize(("name", "key"), CASES)
def test_the_vector_field_is_hamiltonian(name, key):
    """i_X ω = dH, as in (2.9) and (5.19), at a state without symmetry; not so under torques and friction.

    Observed: 1e-15 of the largest entry.
    """
    system, state, _ = EXAMPLES[name][key]
    state = with_work(system, perturbed(system, state))

    @jax.jit
    def sides(system, state):
        space, field = system.phase_space, system.vector_field(state)
        slope = jax.grad(lambda delta: system.energy(space.perturb(state, delta)))(jnp.zeros(space.dim))
        return space.omega(state).T @ space.trivialize(state, field), slope

    left, slope = sides(system, state)
    holds = bool(jnp.max(jnp.abs(left - slope)) < 4e-15 * jnp.max(jnp.abs(slope)))
    assert holds != isinstance(system, FORCED)


@pytest.mark.long
def test_energy_alone_is_declared_where_no_work_is_done():
    for name, found in EXAMPLES.items():
        if name in GIVEN:
            continue
        works = [with_work(system, state).work is not None for system, state, _ in found.values()]
        declared = ENTRIES[name].conserves
        assert any(works) == ("energy less work" in declared)
        assert all(works) or any(x.startswith("energy") and x != "energy less work" for x in declared)


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(EXAMPLES) - GIVEN))
def test_a_flow_of_order_twelve_conserves_it(name):
    system, state, dt = next(iter(EXAMPLES[name].values()))
    state = with_work(system, state)
    step = li.schemes.extrapolate(system)
    run = li.Run.of(step, jax.jit(lambda z: li.integrate(step, z, dt / 4, 20))(step.start(state)))
    size = jnp.maximum(jnp.abs(system.energy(state)), 1)
    assert jnp.max(jnp.abs(run.energy_error())) < 1e-11 * size
    if any(x.startswith("momentum") for x in ENTRIES[name].conserves):
        assert jnp.max(jnp.abs(run.momentum_error()), initial=0) < 1e-11 * size
