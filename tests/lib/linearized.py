"""A step forth and back with its linearization, in a program that holds the step once."""

import jax
import jax.numpy as jnp

from lieint_jax.core.tangent import value_and_jacobian


def there_and_back(step, state, dt):
    """The state after `step`, its L in the coordinates of the phase space, its symplectic defect, and the state that
    a step of −dt leads back to. A step is any function (state, dt) ↦ (state, info) with a `system`."""
    space = step.system.phase_space

    def linearized_step(z, h):
        end, _, L = value_and_jacobian(space, lambda y: step(y, h), z)
        return end, (end, L)

    back, (ends, Ls) = jax.lax.scan(linearized_step, state, jnp.stack([jnp.asarray(dt, state.p.dtype), -dt]))
    after, L = jax.tree.map(lambda x: x[0], ends), Ls[0]
    return after, L, jnp.abs(L.T @ space.omega(after) @ L - space.omega(state)).max(), back
