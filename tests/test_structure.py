"""The house rules: imports point down, the core needs only jax and numpy, examples everywhere, no x64 at import."""

import ast
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from grid import steps, systems

import lieint_jax as li
from lieint_jax import _discover, maps
from lieint_jax.types import Step

ROOT = Path(li.__file__).parent
FLOORS = [  # from the roof down; a module imports only from floors below its own, or its own package
    ("cli",),
    ("report",),
    ("studies",),
    ("scenarios", "figures"),
    ("plots",),
    ("ensemble",),
    ("progress", "archive"),
    ("runs",),
    ("processes", "members", "loop"),
    ("store",),
    ("diagnostics",),
    ("integrate",),
    ("schemes",),
    ("systems",),
    ("phase_spaces",),
    ("free_body",),
    ("maps",),
    ("groups",),
    ("checks",),
    ("newton",),
    ("elliptic",),
    ("small", "dense"),
    ("types", "discover", "data"),
]
LEVEL = {name: level for level, floor in enumerate(FLOORS) for name in floor}
CORE = {"jax", "numpy"}
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")


def imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "lieint_jax":
                yield from (f"lieint_jax.{alias.name}" for alias in node.names)
            else:
                yield node.module


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    room = path.relative_to(ROOT).parts[0].removesuffix(".py")
    assert room in LEVEL, f"{room} has no floor: add it to FLOORS"
    for name in imports(path):
        if name.startswith("lieint_jax."):
            other = name.split(".")[1]
            if other in LEVEL:
                assert LEVEL[other] > LEVEL[room] or other == room, f"{path} imports {name}"
        elif LEVEL[room] > LEVEL["store"] or room in ("runs", "processes", "members", "loop"):
            top = name.split(".")[0]
            assert top in CORE or top in sys.stdlib_module_names, f"{path} is core and imports {name}"


def test_schemes_import_no_system_and_systems_no_scheme():
    for room, forbidden in (("schemes", "systems"), ("systems", "schemes")):
        for path in (ROOT / room).glob("*.py"):
            assert not [name for name in imports(path) if name.startswith(f"lieint_jax.{forbidden}")]


@pytest.mark.parametrize("package", [li.groups, li.systems, li.schemes], ids=lambda p: p.__name__)
def test_every_module_has_examples_and_is_exported(package):
    names = {name for name, _ in systems()}
    for name, module in _discover.modules(package).items():
        if package is li.schemes:
            assert any(module.examples(example[0]) for _, example in systems()), f"{name}: no example on any system"
        else:
            assert module.examples(), f"{name}: no example"
        assert hasattr(package, name), f"{name} is not exported by {package.__name__}"
    assert names
    assert maps.examples()


def test_what_a_factory_s_name_hides_is_exported():
    """`li.systems.euler` is the function, so nothing else of its module can be reached through it."""
    offered = {
        "euler": ("kirchhoff", "manakov", "manakov_integrals"),
        "heavy_top": ("LagrangeMotion", "kovalevskaya_integral", "lagrange_motion"),
        "potential_top": ("Quadratic", "clebsch_integral"),
    }
    for name, module in _discover.modules(li.systems).items():
        for offer in offered.get(name, ()):
            assert getattr(li.systems, offer) is getattr(module, offer)
            assert offer in li.systems.__all__


once = jax.jit(lambda step, state, dt: step(state, dt))


LARGE = ("euler.manakov", "group_potential.bottom_heavy")  # groups whose steps compile for ten seconds and more
GRID = [pytest.param(*s, id=s[0], marks=[pytest.mark.long] * s[0].startswith(LARGE)) for s in steps()]


@pytest.mark.parametrize(("name", "step", "state", "dt"), GRID)
def test_the_grid_of_systems_and_schemes_runs(name, step, state, dt):
    """The contract of every step: a pytree with its system as a child, a flag, and an order and symmetry stated."""
    assert isinstance(step, Step)
    after, info = once(step, state, dt)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert info.converged
    assert step.order >= 1
    assert isinstance(step.symmetric, bool)
    if type(step).prepare is not Step.prepare:
        assert once(step.prepare(state, dt), state, dt)[1].converged
    assert jax.tree.leaves(step)


def test_import_is_light_and_leaves_float32_alone():
    """In a fresh interpreter: nothing but jax and numpy is loaded, x64 stays off, no backend is started."""
    code = (
        "import sys, time, jax; t = time.perf_counter(); import lieint_jax; took = time.perf_counter() - t;"
        "from jax._src import xla_bridge;"
        "heavy = {'matplotlib', 'optax', 'pydantic', 'tqdm', 'scipy', 'zarr'} & set(sys.modules);"
        "print(took, jax.config.jax_enable_x64, sorted(heavy), xla_bridge.backends_are_initialized())"
    )
    before = {"matplotlib", "optax", "pydantic", "tqdm", "zarr"}
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    took, rest = out.split(" ", 1)
    assert float(took) < 1
    assert rest.startswith("False")
    assert not any(name in rest for name in before)
    assert rest.strip().endswith("False")


def test_the_docstring_example_of_rigid_body():
    import doctest

    from lieint_jax.systems.rigid_body import rigid_body

    results = doctest.DocTestRunner().run(
        doctest.DocTestFinder().find(rigid_body, globs={"rigid_body": rigid_body}, name="x")[0]
    )
    assert results.attempted >= 3
    assert results.failed == 0
