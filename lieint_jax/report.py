"""What the commands print and write: a scenario's results, certificates."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from lieint_jax import __version__, discover, ensemble, plots, scenarios, schemes, store, systems
from lieint_jax.diagnostics import certify, energy_error, poisson_error
from lieint_jax.groups import so3
from lieint_jax.integrate import integrate
from lieint_jax.scenarios import Row, Scenario, Sighting
from lieint_jax.types import State, Step, Trajectory

_LONGEST, _POINTS = 200_000, 4_000  # steps of the nominal member that are drawn, and points of a curve


def run(name: str, out: Path | None, members: int | None = None, steps: int | None = None) -> None:
    """Integrate a scenario, print the report, write results and pictures."""
    scenario = scenarios.load(name, members=members, steps=steps)
    out = store.free(out or _unused(Path(Path(name).stem).with_suffix(".npz")))
    step, states = scenarios.build(scenario)
    print(_headline(scenario, step))
    run = ensemble.run(step, states, scenario.dt, scenario.steps, scenario.save_every)
    store.save(out, run, {"scenario": scenario.model_dump(), "lieint_jax": __version__, "jax": jax.__version__})
    print(f"  results in {out}; drawing and certifying …", flush=True)
    pictures = store.pictures(out)
    _draw_path(scenario, step, run, pictures[0])
    _draw_invariants(scenario, step, run, pictures[1])
    body = step.system
    print(_table(scenario, scenarios.quantities(scenario, body, run)))
    for sighting in scenarios.sightings(scenario, body, run):
        print(_sighting(scenario, sighting))
    watched = min(scenario.steps, 10_000)
    print(f"\nCertificate of the nominal member, first {watched} of {scenario.steps} steps:")
    print(certify(step, _nominal(run), scenario.dt, watched))
    well = int(np.asarray(run.info.converged).all(axis=0).sum())
    print(f"  {well} of {scenario.members} members converged at every step")
    print(f"\nwritten: {out} (t, q, p, residual, converged, metadata; {_megabytes(out)}), {pictures[0]}, {pictures[1]}")


def check(system: str, scheme: str, num_steps: int) -> None:
    """Print the certificate of every example of every system with every scheme that takes it."""
    found = False
    for module_name, module in discover.modules(systems).items():
        for name, (body, state, dt) in module.examples().items():
            if system not in ("", module_name, name, f"{module_name}.{name}"):
                continue
            for scheme_module in discover.modules(schemes).values():
                for step_name, step in scheme_module.examples(body).items():
                    if scheme in step_name:
                        found = True
                        print(f"{module_name}.{name}\n{certify(step, state, dt, num_steps)}\n")
    if not found:
        known = [f"{n} ({', '.join(m.examples())})" for n, m in discover.modules(systems).items()]
        raise ValueError(f"nothing to check for system {system!r} and scheme {scheme!r}; systems: {'; '.join(known)}")


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.3g} MB"


def _unused(path: Path) -> Path:
    """`path`, or the first of path-2, path-3, … that does not exist."""
    candidate, k = path, 1
    while any(file.exists() for file in (candidate, *store.pictures(candidate))):
        k += 1
        candidate = path.with_stem(f"{path.stem}-{k}")
    return candidate


def _headline(scenario: Scenario, step: Step) -> str:
    unit, span = scenario.time_unit, scenario.dt * scenario.steps
    spread = scenario.spread
    lines = [
        scenario.title,
        f"  {scenario.members} member(s), {scenario.steps} steps of {scenario.dt:.6g} {unit} = {span:.6g} {unit}, "
        f"{step.name}",
    ]
    if scenario.members > 1:
        lines.append(
            f"  spread about the nominal state, an assumption: {spread.attitude_deg:g}° of attitude and "
            f"{spread.angular_velocity_deg:g}°/{unit} of angular velocity (1 sigma, each component)"
        )
    return "\n".join(lines)


def _table(scenario: Scenario, rows: list[Row]) -> str:
    lines = [f"\n  {'':<34}{'nominal':>10}{'± ensemble':>12}   published"]
    for row in rows:
        published = ""
        if row.published:
            error = f" ± {row.published.error:g}" if row.published.error is not None else ""
            published = (
                f"{row.published.value:g}{error}  ({scenario.sources.get(row.published.source, row.published.source)})"
            )
        nominal, spread = (f"{x:.4f}" if np.isfinite(x) else "—" for x in (row.nominal, row.spread))
        lines.append(f"  {row.name:<34}{nominal:>10}{spread:>12}   {published}")
    if any(np.isnan(row.nominal) for row in rows):
        lines.append(
            "  — no period: the body spins about an axis, or states are saved too far apart (lower save_every)"
        )
    return "\n".join(lines)


def _sighting(scenario: Scenario, sighting: Sighting) -> str:
    seen = sighting.observation

    def triple(values: np.ndarray | list[float]) -> str:
        return "(" + ", ".join(f"{x:8.2f}" for x in values) + ")"

    lines = [
        f"\n  {seen.label}: t = {seen.t:g} {scenario.time_unit}   [{scenario.sources.get(seen.source, seen.source)}]"
    ]
    if seen.euler_313_deg:
        predicted, observed = triple(sighting.euler_313_deg), triple(seen.euler_313_deg)
        lines += [f"    Euler 3-1-3 (°)      predicted {predicted}   observed {observed}"]
    if seen.angular_velocity_deg:
        predicted, observed = triple(sighting.angular_velocity_deg), triple(seen.angular_velocity_deg)
        lines += [f"    body rate (°/{scenario.time_unit})      predicted {predicted}   observed {observed}"]
    lines += [
        f"    attitude predicted and observed: {sighting.apart_deg:.2f}° apart; members about the nominal one: "
        f"{sighting.spread_deg:.2f}° rms; the integrator's own error: {sighting.integrator_error_deg:.2g}°",
        "    (torque-free: what remains is the error of the initial state, of the observation, and torques left out)",
    ]
    return "\n".join(lines)


def _draw_path(scenario: Scenario, step: Step, run: Trajectory, path: Path) -> None:
    """The long view: the body's z axis in space, where the members have it at an observation; the polhode."""
    seen = [s for s in scenario.observation if 0 <= scenarios.save_index(scenario, s) < len(run.t)][:1]
    last = scenarios.save_index(scenario, seen[0]) if seen else len(run.t) - 1
    every = -(-min(last * scenario.save_every, _LONGEST) // _POINTS) or 1
    nominal = jax.jit(integrate, static_argnames=("num_steps", "save_every"))(
        step, _nominal(run), scenario.dt, max(last * scenario.save_every // every, 1) * every, every
    )
    size = np.linalg.norm(run.state.p[0, 0])
    fig, axes = plots.figure(2, subplot_kw={"projection": "3d"})
    left, right = axes[0]
    axis, members = _z_axis(nominal.state.q), _z_axis(jnp.asarray(run.state.q[last]))
    pole = np.asarray(run.state.p[0, 0]) / size
    plots.sphere_path(left, axis, pole, eye=axis.mean(axis=0) + members.mean(axis=0))
    plots.sphere_points(left, members, "members", color=plots.INK, s=2, alpha=0.5)
    if seen:
        plots.sphere_points(left, _z_axis(seen[0].attitude()[None]), seen[0].label, color=plots.RED, marker="x", s=60)
    left.legend(frameon=False, fontsize="x-small", loc="lower left")
    left.set_title(f"body axis z in space to t = {nominal.t[-1]:.4g} {scenario.time_unit}", fontsize="small")
    plots.sphere_path(right, np.asarray(jax.vmap(step.system.body_momentum)(nominal.state)) / size)
    right.set_title("angular momentum in the body", fontsize="small")
    fig.suptitle(scenario.title, fontsize="medium")
    fig.savefig(path, dpi=160)


def _draw_invariants(scenario: Scenario, step: Step, run: Trajectory, path: Path) -> None:
    """Energy and Poisson error of the nominal member against time."""
    every = -(-min(scenario.steps, _LONGEST) // _POINTS)
    n = min(scenario.steps, _LONGEST) // every * every

    @jax.jit
    def nominal(z: State) -> tuple[Array, Array, Array]:
        series = integrate(step, z, scenario.dt, n, every)
        energy = energy_error(step.system, series) / step.system.energy(z)
        sigma = jax.vmap(so3.vee)(poisson_error(step, z, scenario.dt, n)[::every])
        return series.t, energy, jnp.linalg.norm(sigma, axis=1)

    t, energy, sigma = (np.asarray(x) for x in nominal(_nominal(run)))
    fig, axes = plots.figure(2)
    plots.series(axes[0, 0], t, {"": energy}, "relative energy error", scenario.time_unit)
    plots.log_error(axes[0, 1], t, {"": sigma}, "Poisson error |σ|", scenario.time_unit)
    fig.savefig(path, dpi=160)


def _nominal(run: Trajectory) -> State:
    return State(jnp.asarray(run.state.q[0, 0]), jnp.asarray(run.state.p[0, 0]))


def _z_axis(q: Array) -> np.ndarray:
    return np.asarray(jax.vmap(so3.Ad, in_axes=(0, None))(q, jnp.array([0.0, 0.0, 1.0])))
