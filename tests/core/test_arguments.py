"""Classes called by a lower-case name: the constructor converts and checks, and JAX rebuilds them as they are."""

import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lieint_jax as li
from lieint_jax import systems, torques
from lieint_jax.core import argument, pytree, static, with_fields


def positive(value):
    if isinstance(value, float | int) and value <= 0:
        raise ValueError(f"must be positive, got {value}")
    return jnp.asarray(value, float)


@pytree
class Spring:
    stiffness: jax.Array = argument(converter=positive)
    length: jax.Array | None = argument(converter=lambda x: None if x is None else positive(x), default=None)


@pytree
class Stiffer(Spring):
    factor: float = 2.0


@pytree
class Chain:
    links: int = static(converter=int)
    joints: int = static(init=False)

    def check_fields(self):
        return {"joints": self.links - 1}


@pytest.mark.parametrize("kind", [Spring, Stiffer])
def test_a_constructor_converts_and_checks(kind):
    assert kind(3).stiffness.dtype == jnp.result_type(float)
    assert kind(3).length is None
    for bad in (lambda: kind(-1.0), lambda: kind(1.0, 0.0), lambda: dataclasses.replace(kind(1.0), stiffness=-2.0)):
        with pytest.raises(ValueError, match=r"must be positive, got"):
            bad()


def test_jax_rebuilds_without_a_conversion():
    """Axes of vmap, shapes and cotangents take the places of numbers; a negative number is a tangent, too."""
    spring = jax.tree.map(lambda x: -x, Spring(1.0))
    assert spring.stiffness == -1
    assert jax.grad(lambda s: -s.stiffness)(Spring(2.0)).stiffness == -1
    np.testing.assert_array_equal(jax.vmap(Spring)(jnp.arange(1.0, 3.0)).stiffness, [1, 2])
    assert pickle.loads(pickle.dumps(Spring(2.0))).stiffness == 2


def test_a_field_that_follows_from_others_is_no_argument():
    chain = Chain("4")
    assert (chain.links, chain.joints, jax.tree.leaves(chain)) == (4, 3, [])
    closed = with_fields(chain, joints=4)
    assert (closed.joints, chain.joints, dataclasses.replace(closed, links=6).joints) == (4, 3, 5)
    assert jax.tree.structure(closed) != jax.tree.structure(chain)
    with pytest.raises(TypeError, match="unexpected keyword argument 'joints'"):
        Chain(4, joints=4)


def test_the_name_that_is_called_is_the_class():
    step = li.schemes.gauss(li.systems.rigid_body([1.0, 2.0, 3.0]), stages=2)
    assert isinstance(step, li.schemes.gauss)
    assert (step.order, li.schemes.gauss) == (4, li.schemes.Gauss)
    law = torques.viscous([0.1, 0.2, 0.3])
    assert isinstance(law, torques.viscous)
    assert torques.viscous is torques.Viscous
    names = ("aerodynamic", "gravity_gradient", "solar_plates", "wheel_motor", "wheels")
    assert [getattr(torques, name).__name__.lower() for name in names] == [name.replace("_", "") for name in names]
    assert (li.potentials.held, li.potentials.springs) == (li.potentials.Held, li.potentials.Springs)
    assert (li.orbits.eclipse, li.orbits.from_state) == (li.orbits.Eclipse, li.orbits.KeplerFromState)
    assert (li.orbits.atmosphere, li.tides.constant_lag) == (li.orbits.Air, li.tides.LaggingTides)
    assert li.torques.kane_damper(1.0, 0.5).label == "kane_damper"
    assert torques.hysteresis([1.0, 0, 0], 1.0, 1.0, 0.1, field=[0.0, 0, 1]).label == "hysteresis"
    assert systems.rigid_body is systems.RigidBody
    assert isinstance(systems.gyrostat([1.0, 2.0, 2.5], [0.1, 0.0, 0.0]), systems.gyrostat)
    assert li.groups.matrix is li.groups.MatrixGroup


def test_a_converter_is_given_the_field_before_it():
    J = jnp.array([1.0, 2.0, 2.5], jnp.float32)
    made = systems.gyrostat(J, [0.1, 0.0, 0.0]).rotor, systems.damped_body(J, 0.1).friction, top(J).axis
    assert [x.dtype for x in made] == [jnp.float32] * 3


def test_the_free_body_of_a_batch_is_a_batch():
    """It is made of fields that are converted already: the constructor refuses the inertias of a batch."""
    J = jnp.array([[1.0, 2.0, 2.5], [1.0, 1.5, 1.8]])
    np.testing.assert_array_equal(jax.vmap(top)(J).free.inertia, J)
    with pytest.raises(ValueError, match=r"use jax\.vmap for batches"):
        systems.RigidBody(J)


def top(J):
    return systems.potential_top(J, jnp.sum)
