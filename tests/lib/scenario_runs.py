"""What `lieint run` integrates, without its report."""

from lieint_jax import ensemble
from lieint_jax.app import scenarios


def run(scenario):
    """The step and the trajectories of a scenario."""
    step, states = scenarios.build(scenario)
    kept = {"save_every": scenario.save_every, "step_axis": scenarios.step_axis(scenario)}
    return step, ensemble.run(step, states, **scenario.clock(), **kept, progress=False)
