"""The house rules: imports point down, the core needs only jax and numpy, examples everywhere, no x64 at import."""

import ast
import graphlib
import importlib
import inspect
import re
import subprocess
import sys
import tokenize
from functools import cache
from pathlib import Path

import data_files
import jax
import pytest
import stubs
from grid import examples, schemes, steps, systems
from repeated import once

import lieint_jax as li
from lieint_jax import _discover, maps
from lieint_jax.core import Step

ROOT, TESTS = Path(li.__file__).parent, Path(__file__).parents[1]
FLOORS = [  # from the roof down; a module imports only from floors below its own, or its own package
    ("command",),
    ("examples",),  # scripts, on public names only
    ("plots", "report"),
    ("files",),
    ("_cache",),
    ("fitting",),
    ("diagnostics", "measure"),
    ("runs",),
    ("schemes",),
    ("systems",),
    ("tides",),
    ("orbits", "potentials", "torques"),
    ("shapes",),
    ("_free_body",),
    ("phase_spaces",),
    ("attitude", "maps"),
    ("groups",),
    ("elliptic",),
    ("core",),
    ("_numerics",),
    ("native",),
    ("_xla",),
    ("_text", "dates"),
    ("_checks", "_discover", "_version"),
]
LEVEL = {name: level for level, floor in enumerate(FLOORS) for name in floor}
CORE = {"jax", "numpy"}  # and the standard library: all that the numerical core needs, everything below `runs`
CHECKED = {"jaxtyping"}  # of the room `_numerics`, where only type checkers import it: see test_import_is_light
EQUATIONS = "lieint_jax.systems._equations"  # which systems inherit and schemes integrate
COMPILER = {"llvmlite"}  # of the room `native`, which imports it with the first machine code
FILES = sorted(path for path in ROOT.rglob("*.py") if path != ROOT / "__init__.py")
ROOMS = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}


@cache
def parsed(path):
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def room_of(path):
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imports(path):
    """The modules that a file imports, wherever in it: `from lieint_jax.native import _emit` is one of a module."""
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            found = {name for name in submodules if file_of(name)}
            yield from found
            if found != submodules:
                yield node.module


def imported_names(path):
    """The names in the `from … import` statements of a file."""
    tree = parsed(path)
    return {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}


def file_of(name):
    """The file of a module of the package, or None."""
    path = ROOT.joinpath(*name.split(".")[1:])
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


def _needed_inside_jit():
    """The files of `runs` that functions for the inside of jit rest on."""
    found, new = set(), {ROOT / "runs" / f"_{name}.py" for name in ("integrate", "events", "adjoints", "transition")}
    while new:
        found |= new
        new = {file_of(name) for path in new for name in imports(path) if name.startswith("lieint_jax.runs.")} - found
    return found


INSIDE_JIT = _needed_inside_jit()


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_down(path):
    room = room_of(path)
    assert room in LEVEL, f"{room} has no floor: add it to FLOORS"
    for name in imports(path):
        if name.startswith("lieint_jax."):
            other = name.split(".")[1]
            assert LEVEL[other] > LEVEL[room] or other == room, f"{path} imports {name}"
        elif name == "lieint_jax" and room != "examples":
            pytest.fail(f"{path} imports the face of the package")
        elif LEVEL[room] > LEVEL["runs"] or room == "diagnostics" or path in INSIDE_JIT:
            top = name.split(".")[0]
            own = {"native": COMPILER, "_numerics": CHECKED}.get(room, set())
            assert top in CORE | own or top in sys.stdlib_module_names, f"{path} is core and imports {name}"


def test_files_of_runs_import_each_other_in_no_circle():
    files = {path for path in FILES if path.is_relative_to(ROOT / "runs") and path.name != "__init__.py"}
    graph = {path: {file_of(name) for name in imports(path)} & files for path in files}
    assert list(graphlib.TopologicalSorter(graph).static_order())


def test_a_scheme_imports_at_most_nine_files():
    for path in (ROOT / "schemes").glob("_[a-z]*.py"):
        assert len({file_of(name) for name in imports(path) if name.startswith("lieint_jax.")}) <= 9, path


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_private_modules_are_imported_by_their_own_room_only(path):
    for name in imports(path):
        room, *inside = name.split(".")[1:] or [""]
        if room_of(path) == "schemes" and name == EQUATIONS:
            continue
        assert room == room_of(path) or not any(part.startswith("_") for part in inside), f"{path} imports {name}"


def test_few_tests_import_private_modules():
    """Those of a unit that is not seen from outside, and `lib/internals.py`, so that the inside can be redesigned."""
    allowed = ("_discover", "_numerics", "_version")
    found = {
        path.relative_to(TESTS)
        for path in TESTS.rglob("*.py")
        for name in imports(path)
        if name.startswith("lieint_jax.")
        and any(part.startswith("_") and part not in allowed for part in name.split("."))
    }
    assert len(found) <= 25, sorted(found)


def test_no_import_goes_in_a_circle():
    """Within the rooms too: modules can be put in an order in which each imports only those before it.

    A name of a package's face stands for its file. That importing a module runs its package's face first is not meant.
    """
    faces = {path for path in FILES if path.name == "__init__.py"}
    inner = {path: sources(path) - faces - {ROOT / "__init__.py"} for path in FILES if path not in faces}
    assert len(list(graphlib.TopologicalSorter(inner).static_order())) == len(inner)
    for path in inner:  # and no module imports the face of a package that it stands in
        assert path.parent == ROOT or path.parent / "__init__.py" not in set(map(file_of, imports(path))), path


def test_the_house_has_few_rooms_and_every_one_a_floor():
    assert ROOMS - {"__init__"} == set(LEVEL)
    assert len(ROOMS - {"__init__"}) <= 34
    assert all((path.parent / "__init__.py").is_file() for path in FILES)


def code_tokens(path):
    """The tokens of a file without comments and docstrings."""
    silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
    with tokenize.open(path) as file:
        tokens = list(tokenize.generate_tokens(file.readline))
    for before, token, after in zip([tokens[-1], *tokens], tokens, [*tokens[1:], tokens[-1]], strict=False):
        alone = before.type in silent and after.type == tokenize.NEWLINE
        if token.type not in silent and not (token.type == tokenize.STRING and alone):
            yield token


def test_any_stands_for_few_types():
    """At most 25 in a thousand lines of all code (observed: 23); what is a tree of arrays is a PyTree."""
    count, lines = 0, 0
    for path in FILES:
        tokens = list(code_tokens(path))
        count += sum(token.string == "Any" for token in tokens)
        lines += len({line for token in tokens for line in range(token.start[0], token.end[0] + 1)})
    assert lines > 15_000
    assert count <= 25 * lines / 1000


def test_a_function_is_short_enough_to_be_seen_whole():
    """At most 120 lines, docstring included; the longest is `li.run`, most of which is its docstring."""
    for path in FILES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 120, f"{path}: {node.name}"


PUBLIC_MODULES = [li, *filter(inspect.ismodule, (getattr(li, name) for name in dir(li)))]


def test_dir_lists_the_public_names_only():
    assert dir(li) == sorted(li.__all__)
    assert not [name for name in dir(li) if name.startswith("_") and name != "__version__"]
    assert all(hasattr(li, name) for name in dir(li))
    for module in PUBLIC_MODULES:
        assert all(hasattr(module, name) for name in module.__all__)
        assert dir(module) == sorted(module.__all__), module.__name__


def test_rooms_have_as_many_public_names_as_their_budgets():
    """The table of docs/maintaining.md, where a new name says which one leaves."""
    text = (TESTS.parent / "docs" / "maintaining.md").read_text(encoding="utf-8")
    budgets = {name: int(n) for name, n in re.findall(r"^\| `(li[.\w]*)` \| (\d+) \|", text, re.M)}
    rooms = {f"li.{name}": getattr(li, name) for name in li.__all__ if inspect.ismodule(getattr(li, name))}
    assert {name: len(room.__all__) for name, room in {"li": li, **rooms}.items()} == budgets


@pytest.mark.parametrize("name", data_files.text("contract.txt").split())
def test_every_name_of_the_contract_exists(name):
    found = li
    for part in name.split("."):
        found = getattr(found, part)


@pytest.mark.parametrize("module", PUBLIC_MODULES, ids=lambda module: module.__name__)
def test_arguments_after_the_fourth_are_passed_by_name(module):
    by_position = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    many = {"constant_lag": 5}  # the columns of a table of bodies, and G
    many |= {"integrate": 5, "event": 7, "lyapunov": 5, "kepler": 7}  # calls of the first versions
    many |= {"series": 5, "log_error": 5, "works": 5, "member_series": 5, "balance": 5}  # drawings: label, then unit
    many |= {"loglog_lines": 5, "points": 5, "on_sphere": 6}
    for key in module.__all__:
        function = getattr(module, key)
        if inspect.isfunction(function) or (inspect.isclass(function) and key[0].islower()):
            parameters = inspect.signature(function).parameters.values()
            assert sum(parameter.kind in by_position for parameter in parameters) <= many.get(key, 4), key


def test_schemes_import_of_systems_only_equations_and_systems_no_scheme():
    for path in (ROOT / "schemes").rglob("*.py"):
        assert {name for name in imports(path) if name.startswith("lieint_jax.systems")} <= {EQUATIONS}, path
    for path in (ROOT / "systems").rglob("*.py"):
        assert not [name for name in imports(path) if name.startswith("lieint_jax.schemes")], path
    for path in (ROOT / "systems" / "_equations").glob("*.py"):
        of_systems = [name for name in imports(path) if name.startswith("lieint_jax.systems")]
        assert all(name.startswith(f"{EQUATIONS}.") for name in of_systems), path


def test_physics_imports_no_compiler():
    """`runs` and `diagnostics` give loops of a step to `native`; what they repeat does not know of it."""
    for path in FILES:
        if room_of(path) in ("_numerics", "core", "groups", "maps", "phase_spaces", "systems", "schemes"):
            assert not [name for name in imports(path) if name.startswith("lieint_jax.native")], path


def rests_on(path):
    """The files that a file imports, and those that they import."""
    found, new = set(), {path}
    while new:
        found |= new
        new = set().union(*map(sources, new)) - found
    return found - {path}


@cache
def sources(path):
    """The files in which the names that a file imports are defined."""
    nodes = (node for node in ast.walk(parsed(path)) if isinstance(node, ast.ImportFrom))
    names = [(node.module, alias.name) for node in nodes for alias in node.names]
    return {defined_in(module, name) for module, name in names if module.startswith("lieint_jax")} - {path}


def defined_in(module, name):
    """The file of a name of a module; if the module is the face of a package, that from which it has the name."""
    path = file_of(f"{module}.{name}") or file_of(module)
    if path.name == "__init__.py":
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and name in [alias.asname or alias.name for alias in node.names]:
                return defined_in(node.module, name)
        for found in _discover.modules_with("__all__", importlib.import_module(module)).values():
            if name in found.__all__:
                return defined_in(found.__name__, name)
    return path


def test_the_simplest_scheme_rests_on_few_files():
    """Kinematics, T*SO(3), κ, Newton, states and steps: no matrix group, no law of torque, no closed form."""
    files = rests_on(ROOT / "schemes" / "_so3_midpoint.py")
    assert len(files) <= 32, sorted(files)
    assert {room_of(path) for path in files} <= {
        "_checks",
        "_discover",
        "_numerics",
        "_xla",
        "core",
        "groups",
        "maps",
        "phase_spaces",
        "schemes",
        "systems",
    }


def test_schemes_give_no_hints_to_a_compiler():
    """They hold the equations of one body, and `compiled` runs a whole function of theirs."""
    hints = imported_names(ROOT / "_xla" / "__init__.py") - {"compiled"} | {"_xla", "checkpoint_name"}
    for path in (ROOT / "schemes").rglob("*.py"):
        assert not imported_names(path) & hints, path
        tree = parsed(path)
        words = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
        assert not words & {"checkpoint", "remat", "optimization_barrier"}, path


def test_text_files_have_an_encoding():
    """That of the user's locale cannot read the package's own files: machine code was lost where it is not UTF-8."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("read_text", "write_text"):
                assert "encoding" in [k.arg for k in node.keywords], f"{path}, line {node.lineno}"


@pytest.mark.parametrize("package", [li.groups, li.systems, li.schemes], ids=lambda p: p.__name__)
def test_every_module_has_examples_and_is_exported(package):
    names = {name for name, _ in systems()}
    for name, module in _discover.modules_with("examples", package).items():
        if package is li.schemes:
            assert name in schemes(), f"{name}: no example on any system"
        else:
            assert module.examples(), f"{name}: no example"
        assert hasattr(package, name), f"{name} is not exported by {package.__name__}"
    assert names
    assert maps.examples()


@pytest.mark.parametrize("room", stubs.ROOMS, ids=lambda room: room.__name__)
def test_type_checkers_see_the_names_of_a_room(room):
    """`python tests/lib/stubs.py` writes them, and so does this test where they lack a new file."""
    written, text = stubs.path(room).read_text(encoding="utf-8"), stubs.stub(room)
    if written != text:
        stubs.path(room).write_text(text, encoding="utf-8")
    assert written == text, "written again: commit it"


LARGE = ("euler.manakov", "group_potential.bottom_heavy", "rigid_bodies")  # steps that compile for long
LONG = ("additive", "calibrated", "extrapolate", "gauss", "group_midpoint")  # schemes whose steps do


def dear(name):
    return name.startswith(LARGE) or name.partition("-")[2].startswith(LONG)


FIRST = {type(step): name for name, step, _, _ in reversed(steps()) if not dear(name)}  # the others in the shards
GRID = [pytest.param(*s, id=s[0], marks=[pytest.mark.long] * (s[0] not in FIRST.values())) for s in steps()]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "step", "state", "dt"), GRID)
def test_the_grid_of_systems_and_schemes_runs(name, step, state, dt):
    """The contract of every step: a pytree with its system as a child, a flag, and an order and symmetry stated."""
    assert isinstance(step, Step)
    after, info = once(step, state, dt)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert info.converged
    assert step.order >= 1
    assert isinstance(step.symmetric, bool)
    if step.prepares:
        assert once(step.prepare(state, dt), state, dt)[1].converged
    assert jax.tree.leaves(step)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "system"), [pytest.param(name, x[0], id=name) for name, x in systems()])
def test_every_scheme_that_accepts_a_system_integrates_its_motion(name, system):
    """The steps of the grid are made without that comparison, which raises where a vector field is another."""
    ids = [i for i, step, *_ in steps() if step.system is system]
    assert ids == [f"{name}-{found}" for _, found in examples(system)]


def test_import_is_light_and_leaves_float32_alone():
    """In a fresh interpreter: nothing but jax and numpy is loaded, no application, x64 stays off, no backend starts."""
    code = (
        "import sys, jax, lieint_jax;"
        "from jax._src import xla_bridge;"
        "heavy = {'jaxtyping', 'matplotlib', 'numcodecs', 'optax', 'platformdirs'};"
        "heavy = (heavy | {'pydantic', 'tqdm', 'zarr'}) & set(sys.modules);"
        "app = [name for name in sys.modules if name.startswith('lieint_jax.command')];"
        "print(jax.config.jax_enable_x64, heavy or app or 'light', xla_bridge.backends_are_initialized())"
    )
    rest = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert rest.split() == ["False", "light", "False"]


def test_an_absolute_bound_is_no_looser_than_it_says():
    """numpy adds a relative tolerance of 1e-7 (1e-5 in `allclose`) to `atol` unless `rtol` is given."""
    house = Path(__file__).parents[2]
    loose = [
        f"{path.relative_to(house)}:{call.lineno}"
        for folder in ("tests", "benchmarks", "lieint_jax")
        for path in sorted((house / folder).rglob("*.py"))
        for call in ast.walk(parsed(path))
        if isinstance(call, ast.Call)
        and getattr(call.func, "attr", "") in ("assert_allclose", "allclose", "isclose")
        and {k.arg for k in call.keywords} & {"atol", "rtol"} == {"atol"}
    ]
    assert not loose


def test_a_relative_bound_is_no_looser_than_it_says():
    """pytest allows 1e-12 beside `rel` unless `abs` is given: of a number below 1, more than a `rel` of 1e-12."""
    house = Path(__file__).parents[2]
    loose = [
        f"{path.relative_to(house)}:{call.lineno}"
        for path in sorted((house / "tests").rglob("*.py"))
        for call in ast.walk(parsed(path))
        if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "approx"
        for given in [{k.arg: k.value for k in call.keywords}]
        if "abs" not in given and isinstance(given.get("rel"), ast.Constant) and given["rel"].value <= 1e-10
    ]
    assert not loose
