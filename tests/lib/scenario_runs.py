"""What `lieint run` integrates, without its report."""

from lieint_jax import runs


def run(scenario):
    """The run of a scenario."""
    step, states = scenario.build()
    kept = {"save_every": scenario.save_every, "own_step": scenario.has_own_steps()}
    return runs.run(step, states, **scenario.clock(), **kept, progress=False)
