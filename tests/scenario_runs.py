"""What `lieint run` integrates, without its report."""

from lieint_jax import ensemble, scenarios


def run(scenario):
    """The step and the trajectories of a scenario."""
    step, states = scenarios.build(scenario)
    own = scenarios.step_axis(scenario)
    return step, ensemble.run(step, states, scenario.dt, scenario.steps, scenario.save_every, own, progress=False)
