"""No iteration without a verdict: the source is searched for roots and loops that may end without having converged."""

import ast
from pathlib import Path

import pytest

import lieint_jax

PACKAGE = Path(lieint_jax.__file__).parent
SOLVERS = {"root": 3, "chords": 3, "implicit_root": 2, "iterate_until_stalled": 2}  # and the number of their results
ROOTS = {
    "schemes/_shared/half_rotation.py:scalar_root": "every caller judges the residual of h, of which m is a part",
    "schemes/_shared/half_rotation.py:solve_scalar": "no iteration: it gives h its derivative; F is returned",
}
LOOPS = {
    "examples/didymos.py:impact": "NaN if the last change is not small",
    "_free_body.py:momentum_of_ratio": "bisection halves an interval, always",
    "_numerics/elliptic.py:_ascending": "Landen's transformation, quadratic for m1 ≤ ½, the only ones it gets",
    "_numerics/elliptic.py:_descending": "the same for m1 ≥ ½",
    "_numerics/elliptic.py:quarter_period": "means converge quadratically for every ratio of floating-point numbers",
    "diagnostics/_critical_point.py:_balance": "factors, by which a matrix is multiplied, whatever they are",
    "diagnostics/_critical_point.py:_decrease": "a first search, whose end is judged by Newton's step",
    "diagnostics/_critical_point.py:newton": "its caller judges the end by Newton's step",
    "diagnostics/_critical_point.py:solved": "its caller judges the last correction, which it returns",
    "diagnostics/_order.py:_flow": "NaN if the last change is not small",
    "diagnostics/_order.py:step_once": "a part of _flow",
    "runs/_storage/untrusted.py:parse_json": "no iteration: levels of brackets, refused if there are more",
    "fitting/_trust_region.py:_damped_step": "a step with any damping is judged by its loss",
    "groups/_matrix.py:exp": "squarings by their number; NaN beyond",
    "groups/_matrix.py:log": "NaN if the last change is not small",
    "groups/_matrix.py:near": "four products, no iteration",
    "measure/_revolutions.py:mean_ellipse": "each pass multiplies the error by about the rate per revolution",
    "measure/_nutation.py:from_slope": "halves an interval in which the slope changes sign, to its last digit",
    "measure/_spectrum.py:line": "parabolas over ever smaller steps; the frequency stays near the transform's peak",
    "native/functions/_exponentials.py:_cbrt": "two corrections, tested in ulps for all exponents",
    "files/_tle.py:secular_j2": "each sweep gains three digits, since the drift is 1e-3, and tests compare with sgp4",
    "orbits/_anomaly.py:_halley": "two corrections suffice for all M and e, which tests compare with mpmath",
    "orbits/_graded_times.py:graded_times": "any grid will do",
    "plots/_axes.py:save": "layouts, each from the one before; they are looked at, not computed with",
    "schemes/_gauss.py:guess": "a guess",
    "schemes/_shared/clock_coefficients.py:_powers": "three products, no iteration",
}


def places():
    """The functions of the numerical package, with their names."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if "command" in path.relative_to(PACKAGE).parts:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield f"{path.relative_to(PACKAGE)}:{node.name}", node


def name_of(call):
    """The name of a called function; of `root` only that of Newton's method."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    return name if name != "root" or getattr(getattr(call.func, "value", None), "id", "") == "newton" else ""


def drops_a_verdict(function):
    """Whether a function calls a solver and does not name its last result, or names it and does not read it."""
    kept = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and isinstance(node.value, ast.Call):
            kept.add(node.value)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and isinstance(node.targets[0], ast.Tuple):
            last = node.targets[0].elts[-1]
            names = [x.id for x in ast.walk(last) if isinstance(x, ast.Name)]
            read = {x.id for x in ast.walk(function) if isinstance(x, ast.Name) and isinstance(x.ctx, ast.Load)}
            if len(node.targets[0].elts) == SOLVERS.get(name_of(node.value)) and read & set(names):
                kept.add(node.value)
    calls = [x for x in ast.walk(function) if isinstance(x, ast.Call) and name_of(x) in SOLVERS]
    return any(call not in kept for call in calls)


def is_constant(x):
    return isinstance(x, ast.Constant | ast.Name) and getattr(x, "id", "_").startswith("_")


def repeats_a_constant_number_of_times(function):
    """Whether a function has a loop over a constant range that does not use the number of the pass."""
    loops = [x for x in ast.walk(function) if isinstance(x, ast.For) and isinstance(x.iter, ast.Call)]
    ranges = [x.iter for x in loops if name_of(x.iter) == "range" and getattr(x.target, "id", "") == "_"]
    ranges += [x for x in ast.walk(function) if isinstance(x, ast.Call) and name_of(x) == "fori_loop"]
    return any(is_constant(x.args[-1] if name_of(x) == "range" else x.args[1]) for x in ranges)


@pytest.mark.long
@pytest.mark.parametrize(("finds", "reasons"), [(drops_a_verdict, ROOTS), (repeats_a_constant_number_of_times, LOOPS)])
def test_iterations_have_a_verdict_or_a_reason(finds, reasons):
    found = {place for place, function in places() if finds(function)}
    assert found == set(reasons)


@pytest.mark.parametrize(
    "text",
    [
        "def f():\n    return newton.root(F, c, x, 4)[0]",
        "def f():\n    x, *_ = newton.root(F, c, x, 4)\n    return x",
        "def f():\n    x, F, steady = newton.root(F, c, x, 4)\n    return x",
        "def f():\n    x, _ = newton.implicit_root(F, x, solve, tangents)\n    return x",
    ],
)
def test_a_dropped_verdict_is_found(text):
    assert drops_a_verdict(ast.parse(text).body[0])
    assert not drops_a_verdict(ast.parse("def f():\n    x, F, ok = newton.root(F, c, x, 4)\n    return x, ok").body[0])
