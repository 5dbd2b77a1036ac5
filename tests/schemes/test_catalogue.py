"""What the schemes declare of themselves, against their steps and against measurements."""

import re
import sys
from pathlib import Path

import jax
import pytest
from grid import steps

import lieint_jax as li
from lieint_jax import _discover

ENTRIES = {entry.name: entry for entry in li.schemes.catalogue()}
MODULES = _discover.modules_with("examples", li.schemes)
# certificates of one example each; the grid's first step of a scheme need not be the default
MEASURED = ["so3_explicit", "calibrated", "preprocessed", "splitting", "group_midpoint", "so3_midpoint", "extrapolate"]


def test_every_scheme_has_an_entry_with_a_source():
    assert set(ENTRIES) == set(MODULES)
    assert len(ENTRIES) >= 20
    for entry in ENTRIES.values():
        assert entry.source
        assert entry.limit
        assert entry.aliases
        assert hasattr(li.schemes, entry.name)
        assert entry.conserves or entry.name in ("extrapolate", "magnus")
    assert "discrete Moser–Veselov" in " ".join(ENTRIES["so3_midpoint"].aliases)
    table = repr(li.schemes.catalogue())
    assert len(table.splitlines()) == len(ENTRIES) + 1
    assert all(name in table for name in ENTRIES)


def test_a_scheme_of_ones_own_is_one_file(tmp_path, monkeypatch):
    """That which docs/maintaining.md prints: the file, and nothing else, puts it into the room and its catalogue."""
    page = (Path(li.__file__).parents[1] / "docs" / "maintaining.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    (tmp_path / "_sphere_verlet.py").write_text(code, encoding="utf-8")
    monkeypatch.setattr(li.schemes, "__path__", [*li.schemes.__path__, str(tmp_path)])
    for name in ("SphereVerlet", "sphere_verlet", "_sphere_verlet"):
        monkeypatch.setattr(li.schemes, name, None, raising=False)  # taken away again
    monkeypatch.setitem(sys.modules, "lieint_jax.schemes._sphere_verlet", None)
    del sys.modules["lieint_jax.schemes._sphere_verlet"]

    assert {"SphereVerlet", "sphere_verlet"} == set(_discover.publish("lieint_jax.schemes")) - set(li.schemes.__all__)
    entry = next(entry for entry in li.schemes.catalogue() if entry.name == "sphere_verlet")
    assert f"| `sphere_verlet` | {entry.systems} | momentum, form | 2 |" in li.schemes.catalogue().markdown()

    pendulum, state, dt = next(iter(_discover.modules_with("examples", li.systems)["pendulum"].examples().values()))
    step = li.schemes.sphere_verlet(pendulum)
    run = jax.jit(lambda z: li.integrate(step, z, dt, 100))(state)
    assert float(abs(li.diagnostics.momentum_error(pendulum, run)).max()) < 1e-15  # observed: 0
    assert float(li.diagnostics.symplectic_defect(step, state, dt)) < 2e-15  # observed: 2.2e-16
    with pytest.raises(ValueError, match="sphere_verlet integrates pendulums"):
        li.schemes.sphere_verlet(li.systems.rigid_body([1.0, 2.0, 3.0]))


def examples(scheme):
    """The steps by a scheme in the grid."""
    module = MODULES[scheme].__name__
    return [(step, state, dt) for _, step, state, dt in steps() if type(step).__module__ == module]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", sorted(set(MODULES) - {"compose", "exact", "preprocessed"}))
def test_the_declared_symmetry_is_that_of_the_default_step(scheme):
    found = examples(scheme)
    assert found
    entry = ENTRIES[scheme]
    assert entry.symmetric in {step.symmetric for step, *_ in found}
    if scheme not in ("gauss", "nystrom", "kepler_splitting"):  # of a chosen order
        assert entry.order in {step.order for step, *_ in found}


@pytest.mark.slow
@pytest.mark.parametrize("scheme", MEASURED)
def test_every_quantity_declared_conserved_is_measured_conserved(scheme):
    """A declared invariant is constant to round-off; an energy or form that is not declared visibly is not."""
    found = examples(scheme)
    step, state, dt = next((x for x in found if x[0].system.momentum(x[1]).size), found[0])
    body, dt = step.system, 4 * dt if scheme == "extrapolate" else dt  # whose error is round-off at the example's dt
    run = jax.jit(lambda z: li.integrate(step, z, dt, 100))(state)
    energy = float(abs(li.diagnostics.energy_error(body, run)).max() / abs(body.energy(state)))
    momentum = abs(li.diagnostics.momentum_error(body, run)).max()
    defect = float(li.diagnostics.symplectic_defect(step, state, dt))
    declared = ENTRIES[scheme].conserves
    assert (energy < 1e-13) == ("energy" in declared)
    assert ("momentum" in declared) == (float(momentum) < 1e-13)
    if "form" in declared:
        assert defect < 1e-13
    elif not any(x.startswith("form") for x in declared):
        assert defect > 1e-13
