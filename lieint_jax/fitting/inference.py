"""One engine of inference: from data to estimates, tested errors, comparisons and predictions.

A `Problem` declares the unknowns, the errors of a model against data, their noise, and published values. `infer` does

1. a fit from many starts, `fit_starts`, which also fits many data sets at once;
2. the covariance, and quantities derived from the parameters with theirs: `estimates`;
3. a test of the reported errors on synthetic data: `synthetic`, `coverage`;
4. the enlargement of the errors, by the scatter in synthetic data and by χ²: `enlarge_errors`;
5. a prediction by members drawn from the estimate: `draw_members`, `predict`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike

from lieint_jax._numerics.arrays import PyTree
from lieint_jax._xla import rereading_jit, shapes_now
from lieint_jax.fitting._bounds import Bound, free, interval
from lieint_jax.fitting._fit import fit
from lieint_jax.fitting._outcome import Fit
from lieint_jax.fitting._robust import DEGREES_OF_FREEDOM, student_t, student_t_curvature, student_t_noise_error

__all__ = [
    "Coverage",
    "Estimate",
    "Inference",
    "Problem",
    "Published",
    "Shares",
    "StudentT",
    "Unknown",
    "calibrate_errors",
    "chance_errors",
    "chi_square_point",
    "compare",
    "coverage",
    "draw_members",
    "ellipse",
    "enlarge_errors",
    "estimates",
    "fit_starts",
    "infer",
    "predict",
    "pull",
    "random_starts",
    "repeat",
    "shares",
    "squared_distances",
    "synthetic",
]

Params = dict[str, Array]
_SAME = 1e-4  # difference of the losses of starts that end in one minimum


def squared_distances(errors: np.ndarray, covariances: ArrayLike) -> np.ndarray:
    """The squared Mahalanobis distances eᵀC⁻¹e, (n,), of errors (n, parameters) with covariances (n, …, …)."""
    errors = np.asarray(errors)
    return np.einsum("ti,ti->t", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


class Unknown(NamedTuple):
    """A parameter to estimate: a number or a vector.

    Attributes:
        names: a name with its unit for each number, such as ("rate x (rad/s)", …).
        start: the first guess, a number or (n,).
        bound: its domain, one of `lieint_jax.fitting`.
        scatter: the standard deviation of random starts about the first guess.
    """

    names: tuple[str, ...]
    start: ArrayLike | Sequence[float]
    bound: Bound = free
    scatter: float = 0.0


class StudentT(NamedTuple):
    """Noise with outliers: Student's t. Of each kind of error the scale is fitted, from `start` and within bounds."""

    start: tuple[float, ...]
    low: float
    high: float


class Published(NamedTuple):
    """A published value of an unknown or a derived quantity, its standard error, 0 if there is none, and its source."""

    quantity: str
    value: float
    error: float = 0.0
    source: str = ""


@dataclass(frozen=True, eq=False)
class Problem:
    """What `infer` needs: unknowns, the errors of a model against data, noise, and what to compare and predict.

    Attributes:
        unknowns: the unknowns, by the names of the parameters.
        errors: (params, data) ↦ calculated less observed values, an array, or a pair (errors, converged). For
            `StudentT` noise their shape is (kinds, n, d): n vectors of d components of each kind.
        data: the observed values, an array; a tree, if `errors` needs more and `simulate` is given.
        noise: the standard deviation of the errors, which broadcasts with them, or `StudentT`.
        title: the first line of the report.
        derived: (params, data) ↦ quantities that follow from the parameters, (q,).
        quantities: their names with units, (q,). Differences of those that end in (°) are wrapped to ±180°.
        published: published values of unknowns and derived quantities.
        simulate: (params, data, noise) ↦ synthetic data; by default the calculated values less the noise.
        t: the times of the data, (n,), for the picture.
        labels: those of the picture's axes, the times and the data.
        forecast: times and a function params ↦ values at these times, (times,), for a prediction.
    """

    unknowns: Mapping[str, Unknown]
    errors: Callable[[Params, PyTree], PyTree]
    data: PyTree
    noise: ArrayLike | StudentT = 1.0
    title: str = "A fit"
    derived: Callable[[Params, PyTree], Array] | None = None
    quantities: Sequence[str] = ()
    published: Sequence[Published] = ()
    simulate: Callable[[Params, PyTree, Array], PyTree] | None = None
    t: ArrayLike | None = None
    labels: tuple[str, str] = ("t", "data")
    forecast: tuple[ArrayLike, Callable[[Params], Array]] | None = None

    def __post_init__(self) -> None:
        for key, unknown in self.unknowns.items():
            if key == "noise" or len(unknown.names) != np.size(unknown.start):
                raise ValueError(
                    f"the unknown {key!r} needs a name for each of its {np.size(unknown.start)} numbers, got "
                    f"{unknown.names}; no unknown may be called noise"
                )
        known = (*self.names, *self.quantities)
        if unknown := [p.quantity for p in self.published if p.quantity not in known]:
            raise ValueError(f"a published value is of {unknown[0]!r}, but the names are {', '.join(known)}")
        if not isinstance(self.noise, StudentT) and not np.all(np.asarray(self.noise) > 0):
            raise ValueError(f"noise must be a positive standard deviation, got {self.noise}")

    @property
    def names(self) -> list[str]:
        """The names of all numbers, in the order of the vector x."""
        return [name for key in sorted(self.unknowns) for name in self.unknowns[key].names]

    @property
    def levels(self) -> Params:
        """The first guess of the noise levels, if they are fitted."""
        return {"noise": jnp.asarray(self.noise.start)} if isinstance(self.noise, StudentT) else {}

    @property
    def guess(self) -> Params:
        """The first guess, with that of the noise levels."""
        return {name: jnp.asarray(u.start, float) for name, u in self.unknowns.items()} | self.levels

    @property
    def unravel(self) -> Callable[[ArrayLike], Params]:
        """The parameters of a vector x, (p,)."""
        unravel = ravel_pytree(_split_noise(self.guess)[0])[1]
        return lambda x: unravel(jnp.asarray(x))

    @property
    def bounds(self) -> dict[str, Bound]:
        """The bound of each parameter, and of the noise levels."""
        found = {name: u.bound for name, u in self.unknowns.items()}
        return found | ({"noise": interval(*self.noise[1:])} if isinstance(self.noise, StudentT) else {})

    def residuals(self, params: Params, given: PyTree) -> PyTree:
        """The residuals that `fit` minimizes, and whether all steps converged; `given`: data, degrees of freedom."""
        (data, freedom), (motion, levels) = given, _split_noise(params)
        errors, converged = self.flagged_errors(motion, data)
        if not isinstance(self.noise, StudentT):
            return errors / self.noise, converged
        low = self.noise.low
        return [student_t(e, levels[k], low, freedom) for k, e in enumerate(errors)], converged

    def flagged_errors(self, params: Params, data: PyTree) -> tuple[Array, ArrayLike]:
        """The errors, and whether they converged."""
        found = self.errors(params, data)
        return found if isinstance(found, tuple) else (found, np.array(True))

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the errors."""
        return shapes_now(self.flagged_errors, _split_noise(self.guess)[0], self.data)[0].shape

    def calculate(self, params: Params, data: PyTree) -> tuple[Array, ArrayLike]:
        """`flagged_errors`, compiled."""
        return _calculate(self, params, data)

    def estimate(self, params: Params, covariance: Array, data: PyTree, freedom: Array) -> Estimate:
        """`_estimate` of this problem, compiled."""
        return _estimate(self, params, covariance, data, freedom)


_calculate = rereading_jit(Problem.flagged_errors, static_argnums=0)


class Estimate(NamedTuple):
    """Parameters with their uncertainty; for several fits, every field has a leading axis.

    Attributes:
        x: the parameters as a vector, (p,), in the order of `Problem.names`.
        covariance: the covariance of x, (p, p).
        noise: the noise levels of `StudentT`, corrected for the fitted parameters, (kinds,); otherwise (0,).
        derived: the derived quantities, (q,).
        derived_covariance: their covariance, to first order, (q, q).
    """

    x: np.ndarray
    covariance: np.ndarray
    noise: np.ndarray
    derived: np.ndarray
    derived_covariance: np.ndarray

    @classmethod
    def exact(cls, x: ArrayLike, derived: ArrayLike | Sequence[float] = ()) -> Estimate:
        """Known parameters and derived quantities, for comparisons."""
        none = np.zeros(0)
        return cls(np.asarray(x), none, none, np.asarray(derived), none)

    @property
    def values(self) -> np.ndarray:
        """The parameters and derived quantities, (…, p + q)."""
        return np.concatenate([self.x, self.derived], axis=-1)

    @property
    def sigmas(self) -> np.ndarray:
        """Their standard errors, (…, p + q)."""
        each = (np.sqrt(np.diagonal(C, axis1=-2, axis2=-1)) for C in (self.covariance, self.derived_covariance))
        return np.concatenate([*each], axis=-1)


class Coverage(NamedTuple):
    """How often the reported uncertainty includes the truth, over synthetic data sets.

    Attributes:
        pulls: (estimate − truth)/reported σ of parameters, logarithms of noise levels, and derived quantities,
            (sets, p + kinds + q).
        mahalanobis_squared: the squared distance of the estimate from the truth by its covariance, (sets,), expected
            to be χ² with p degrees of freedom.
        success: whether each fit succeeded.
    """

    pulls: np.ndarray
    mahalanobis_squared: np.ndarray
    success: np.ndarray

    def scatter(self, parameters: int, levels: int = 0) -> np.ndarray:
        """Root mean square of the pulls of the parameters, and of the noise levels, (2,); 1 for correct errors."""
        groups = self.pulls[:, :parameters], self.pulls[:, parameters : parameters + levels]
        return np.array([np.sqrt((x**2).mean()) if x.size else 1.0 for x in groups])

    def select(self, sets: slice) -> Coverage:
        """The coverage over a part of the sets."""
        return Coverage(*(leaf[sets] for leaf in self))

    def rescale(self, factors: np.ndarray, parameters: int, levels: int = 0) -> Coverage:
        """The coverage with reported errors enlarged by two factors, for parameters and for noise levels."""
        column = np.arange(self.pulls.shape[1])
        each = np.where((column >= parameters) & (column < parameters + levels), factors[1], factors[0])
        return Coverage(self.pulls / each, self.mahalanobis_squared / factors[0] ** 2, self.success)


class Shares(NamedTuple):
    """The scatter of pulls, (estimate − truth)/reported standard error, over synthetic data sets.

    Attributes:
        within_1: percentages within one standard error; 68.3 are expected.
        within_2: percentages within two; 95.4 are expected.
        rms: the root mean square; 1 is expected.
    """

    within_1: np.ndarray
    within_2: np.ndarray
    rms: np.ndarray


def shares(pulls: np.ndarray, axis: int | None = 0) -> Shares:
    """The shares of pulls (sets, parameters), for each parameter, or with `axis=None` for all together.

    Example:
        >>> shares(np.array([[0.5], [-0.5], [1.5], [3.0]])).within_1.tolist()
        [50.0]
    """
    one, two = (100 * (np.abs(pulls) <= limit).mean(axis=axis) for limit in (1, 2))
    return Shares(one, two, np.sqrt((pulls**2).mean(axis=axis)))


def chance_errors(sets: int) -> Shares:
    """The standard errors of the shares of one parameter, for a number of synthetic sets."""
    one, two = (100 * np.sqrt(p * (1 - p) / sets) for p in (0.683, 0.954))
    return Shares(one, two, 1 / np.sqrt(2 * sets))


def chi_square_point(parameters: int) -> float:
    """The 95 % point of χ²: the squared distance at the joint ellipsoid of 95 % probability.

    Example:
        >>> round(chi_square_point(2), 3)
        5.991
    """
    from scipy.special import chdtri

    return float(chdtri(parameters, 0.05))


def ellipse(center: np.ndarray, covariance: np.ndarray, radius: float) -> np.ndarray:
    """The points of two numbers at `radius` standard errors from their center, (145, 2).

    Example:
        >>> ellipse(np.zeros(2), np.diag([4.0, 1.0]), 1.0).max(axis=0).tolist()
        [2.0, 1.0]
    """
    angle = np.linspace(0, 2 * np.pi, 145)
    return center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ np.linalg.cholesky(covariance).T


def _split_noise(params: Params) -> tuple[Params, Array]:
    """Separate the parameters of the model from the noise levels."""
    return {name: leaf for name, leaf in params.items() if name != "noise"}, params.get("noise", jnp.zeros(0))


def repeat(tree: PyTree, times: int) -> PyTree:
    """Repeat every leaf of a tree along a new leading axis of length `times`."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (times, *jnp.shape(leaf))), tree)


def random_starts(problem: Problem, count: int, seed: int) -> Params:
    """Random starts, with a leading axis: normal about the first guess, and drawn nearer to it until in bounds."""
    rng, starts = np.random.default_rng(seed), {}
    for name, u in problem.unknowns.items():
        guess = np.asarray(problem.guess[name])
        away = u.scatter * rng.normal(size=(count, *guess.shape))
        inside = jax.vmap(lambda p, bound=u.bound: jnp.isfinite(bound.free(p)).all())
        while u.scatter and not (ok := np.asarray(inside(jnp.asarray(guess + away)))).all():
            away[~ok] /= 2
        starts[name] = jnp.asarray(guess + away)
    return starts | repeat(problem.levels, count)


def fit_starts(
    problem: Problem,
    starts: PyTree,
    data: PyTree,
    freedom: ArrayLike = DEGREES_OF_FREEDOM,
    progress: bool = True,
    standardized: bool = False,
    tolerance: float = 1e-9,
    iterations: int = 100,
) -> Fit:
    """Run many fits at once, by `fit`.

    Args:
        problem: the problem.
        starts: the first guesses; each leaf has a leading axis.
        data: the data of each fit; each leaf has a leading axis.
        freedom: degrees of freedom of Student's t, of all fits or of each.
        progress, standardized, tolerance, iterations: as in `fit`.
    """
    given = data, jnp.broadcast_to(jnp.asarray(freedom, float), len(jax.tree.leaves(starts)[0]))
    options = {"tolerance": tolerance, "iterations": iterations, "standardized": standardized, "progress": progress}
    return fit(problem.residuals, starts, bounds=problem.bounds, starts=True, data=given, **options)


def estimates(
    problem: Problem,
    found: Fit,
    data: PyTree,
    freedom: ArrayLike = DEGREES_OF_FREEDOM,
    which: Iterable[int] | None = None,
) -> Estimate:
    """The estimates of many fits, or of `which` of them, with their covariances; each leaf has a leading axis."""
    starts = found.starts
    assert starts is not None
    given = starts.params, starts.covariance, data, np.broadcast_to(freedom, len(starts.loss))
    several = jax.tree.map(np.asarray, given)  # slices of NumPy arrays need no dispatch by JAX
    chosen = range(len(starts.loss)) if which is None else which
    each = [problem.estimate(*jax.tree.map(lambda leaf, k=k: leaf[k], several)) for k in chosen]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


@partial(rereading_jit, static_argnums=0)
def _estimate(problem: Problem, params: Params, covariance: Array, data: PyTree, freedom: Array) -> PyTree:
    """The estimate of one fit; for `StudentT` its covariance is the inverse of the observed information.

    The information is that of the linearized model: the second derivatives of the errors are left out. The
    maximum-likelihood σ of a fit is too small, since the parameters are fitted to the same errors. So σₖ² is multiplied
    by n/(n − m): n is the number of components of kind k, and m, the number of parameters that they determine, is the
    trace of the projection onto kind k.
    """
    motion, noise = _split_noise(params)
    x, unravel = ravel_pytree(motion)
    if isinstance(problem.noise, StudentT):
        J, e = _with_jacobian(lambda x: problem.flagged_errors(unravel(x), data)[0], x)

        def information(noise: Array) -> Array:
            curvature = jnp.stack([student_t_curvature(e[k], noise[k], freedom) for k in range(len(e))])
            return jnp.einsum("knci,kncd,kndj->kij", J, curvature, J)

        share, count = information(noise), e.shape[1] * e.shape[2]
        used = jnp.trace(jnp.linalg.inv(jnp.sum(share, axis=0)) @ share, axis1=1, axis2=2)
        noise = noise * jnp.sqrt(count / (count - used))
        covariance = jnp.linalg.inv(jnp.sum(information(noise), axis=0))
    if problem.derived is None:
        return Estimate(x, covariance, noise, jnp.zeros(0), jnp.zeros((0, 0)))  # pyright: ignore[reportArgumentType]
    derived = problem.derived
    D, of_x = _with_jacobian(lambda x: derived(unravel(x), data), x)
    return Estimate(x, covariance, noise, of_x, D @ covariance @ D.T)  # pyright: ignore[reportArgumentType]


def _with_jacobian(function: Callable[[Array], Array], x: Array) -> tuple[Array, Array]:
    """The Jacobian of a function, and its value."""

    def twice(x: Array) -> tuple[Array, Array]:
        value = function(x)
        return value, value

    return jax.jacfwd(twice, has_aux=True)(x)


def synthetic(problem: Problem, truth: Estimate, sets: int, seed: int) -> PyTree:
    """Synthetic data sets of the model with the parameters `truth`, with noise; each leaf has a leading axis."""
    rng, params = np.random.default_rng(seed), problem.unravel(truth.x)
    errors = problem.calculate(params, problem.data)[0]
    if isinstance(problem.noise, StudentT):
        shape = len(errors), sets, *errors.shape[1:]
        levels = truth.noise.reshape(-1, *[1] * errors.ndim)
        noise = levels * rng.normal(size=shape)
        gamma = rng.chisquare(DEGREES_OF_FREEDOM, (*shape[:-1], 1)) / DEGREES_OF_FREEDOM
        noise = np.moveaxis(noise / np.sqrt(gamma), 0, 1)
    else:
        noise = problem.noise * rng.normal(size=(sets, *errors.shape))
    if problem.simulate is None:
        return problem.data + errors - jnp.asarray(noise)
    return jax.vmap(partial(problem.simulate, params, problem.data))(jnp.asarray(noise))


def coverage(problem: Problem, truth: Estimate, sets: int, seed: int, progress: bool = True) -> Coverage:
    """Fit synthetic data sets of the fitted model, and compare their estimates with the model's parameters."""
    data = synthetic(problem, truth, sets, seed)
    starts = problem.unravel(truth.x) | {name: jnp.asarray(truth.noise) for name in problem.levels}
    found = fit_starts(problem, repeat(starts, sets), data, progress=progress)
    assert found.starts is not None
    return compare(problem, truth, estimates(problem, found, data), found.starts.success)


def calibrate_errors(
    problem: Problem, estimate: Estimate, sets: int, seed: int, progress: bool = True
) -> tuple[np.ndarray, Coverage]:
    """By how much half of 2 `sets` synthetic data sets enlarges the errors, and a test of these by the other half.

    The factors, (2,), are those of the parameters and of the noise levels; none is below 1.
    """
    p, levels = len(estimate.x), len(estimate.noise)
    both = coverage(problem, estimate, 2 * sets, seed, progress)
    factors = np.maximum(both.select(slice(sets)).scatter(p, levels), 1)
    return factors, both.select(slice(sets, None)).rescale(factors, p, levels)


def compare(problem: Problem, truth: Estimate, each: Estimate, success: np.ndarray) -> Coverage:
    """The coverage of the truth by the estimates of many fits."""
    p, error = len(truth.x), each.x - truth.x
    level = np.zeros((len(error), 0))
    if problem.levels:
        _, n, d = problem.shape
        level = np.log(each.noise / truth.noise) / student_t_noise_error(n, d)
    wrapped = _difference(each.derived, truth.derived, problem.quantities)
    pulls = np.concatenate([error / each.sigmas[:, :p], level, wrapped / each.sigmas[:, p:]], axis=1)
    return Coverage(pulls, squared_distances(error, each.covariance), success)


def _difference(a: ArrayLike, b: ArrayLike, names: Sequence[str]) -> np.ndarray:
    """a − b; for angles in degrees, wrapped to ±180°."""
    difference = np.asarray(a) - np.asarray(b)
    return np.where([name.endswith("(°)") for name in names], (difference + 180) % 360 - 180, difference)


def pull(name: str, value: float, sigma: float, other: float, error: float = 0.0) -> float:
    """The difference of another value from ours, in units of the combined standard error."""
    return float(_difference(other, value, [name])[0] / np.hypot(sigma, error))


def enlarge_errors(estimate: Estimate, factor: float) -> Estimate:
    """Multiply the standard errors of an estimate by a factor."""
    of_x, of_derived = (factor**2 * C for C in (estimate.covariance, estimate.derived_covariance))
    return estimate._replace(covariance=of_x, derived_covariance=of_derived)


def draw_members(estimate: Estimate, members: int, seed: int) -> np.ndarray:
    """Parameters drawn from the normal distribution of an estimate, (members, p)."""
    return np.random.default_rng(seed).multivariate_normal(estimate.x, estimate.covariance, members)


def predict(problem: Problem, function: Callable[[Params], Array], x: ArrayLike) -> np.ndarray:
    """A function of the parameters for every row of x, (members, p)."""
    return np.asarray(jax.lax.map(jax.jit(lambda x: function(problem.unravel(x))), jnp.asarray(x)))


class Inference(NamedTuple):
    """What `infer` returns: all that a report and a picture need, without the problem.

    Attributes:
        title, names, labels: the first line, the names of parameters and derived quantities, and of the axes.
        fit: the fits from all starts.
        share_at_minimum: the share of the starts that end in the minimum of the best one.
        estimate: the estimate, with enlarged errors.
        factors: by how much the scatter in half of the synthetic sets enlarges the errors of the parameters and of the
            noise levels, and χ² those of the parameters, (3,); none is below 1.
        coverage: how often the errors enlarged by the scatter include the truth in the other half of the sets; None
            without a successful fit.
        published: published values.
        t: the times of the data, (n,).
        data, calculated: the data, and the values of the estimate, (n, components); None if the data are a tree.
        errors: calculated less observed values, in units of the noise, (n, components).
        forecast: times, the prediction of the estimate, and the members' quantiles of 5 and 95 %, (4, times), or None.
    """

    title: str
    names: list[str]
    labels: tuple[str, str]
    fit: Fit
    share_at_minimum: float
    estimate: Estimate
    factors: np.ndarray
    coverage: Coverage | None
    published: list[Published]
    t: np.ndarray
    data: np.ndarray | None
    calculated: np.ndarray | None
    errors: np.ndarray
    forecast: np.ndarray | None

    @property
    def tested(self) -> np.ndarray | None:
        """The pulls of parameters and derived quantities in synthetic data, (sets, p + q), if there are any."""
        p, levels = len(self.estimate.x), len(self.estimate.noise)
        return None if self.coverage is None else np.delete(self.coverage.pulls, slice(p, p + levels), axis=1)


def _check_shapes(problem: Problem) -> None:
    """Raise ValueError if the errors, the times or the derived quantities do not fit together."""
    if problem.simulate is None and problem.shape != np.shape(problem.data):
        raise ValueError(
            f"the errors have shape {problem.shape}, but the data {np.shape(problem.data)}: return calculated less "
            "observed values, or give simulate=, which makes synthetic data"
        )
    rows = problem.shape[1 if problem.levels else 0] if problem.shape else 1
    if problem.t is not None and np.shape(problem.t) != (rows,):
        raise ValueError(f"t must hold the times of the {rows} rows of errors, got the shape {np.shape(problem.t)}")
    if problem.derived is not None:
        motion = _split_noise(problem.guess)[0]
        found, named = shapes_now(problem.derived, motion, problem.data).shape, (len(problem.quantities),)
        if found != named:
            raise ValueError(f"derived returns the shape {found}, but `quantities` has {named[0]} names: needs {named}")


def infer(problem: Problem, quick: bool = False, progress: bool = True) -> Inference:
    """Fit from many starts, test and enlarge the errors, and predict; `quick` uses a fifth of all numbers."""
    sets, members = (20, 200) if quick else (100, 1000)
    _check_shapes(problem)
    random, known = random_starts(problem, 2 * sets - 1, 1), not problem.levels
    starts = jax.tree.map(lambda first, more: jnp.concatenate([first[None], more]), problem.guess, random)
    data = repeat(problem.data, 2 * sets)
    found = fit_starts(problem, starts, data, progress=progress, standardized=known)
    assert found.starts is not None
    if not np.isfinite(found.starts.loss).any():
        raise ValueError(f"no start of {problem.title!r} can be evaluated: {found.message}")
    best = int(np.nanargmin(found.starts.loss))
    estimate = jax.tree.map(lambda leaf: leaf[0], estimates(problem, found, data, which=[best]))
    factors, test, forecast = np.ones(3), None, None
    if found.success and np.isfinite(estimate.covariance).all():
        factors[:2], test = calibrate_errors(problem, estimate, sets, 2, progress)
        factors[2] = max(1.0, np.sqrt(found.chi_square / max(found.degrees_of_freedom or 0, 1))) if known else 1.0
        estimate = enlarge_errors(estimate, factors[0] * factors[2])
        if problem.forecast is not None:
            t, function = problem.forecast
            values = predict(problem, function, np.stack([estimate.x, *draw_members(estimate, members, 3)]))
            forecast = np.stack([np.asarray(t), values[0], *np.percentile(values[1:], (5, 95), axis=0)])
    e = np.asarray(problem.calculate(problem.unravel(estimate.x), problem.data)[0])
    noise = problem.noise if known else estimate.noise[:, None, None]

    def rows(x: np.ndarray) -> np.ndarray:
        x = x if known else np.moveaxis(x, 0, 1)
        return x.reshape(len(x), -1)

    observed = np.asarray(problem.data) if problem.simulate is None else None
    return Inference(
        problem.title,
        [*problem.names, *problem.quantities],
        problem.labels,
        found,
        float((found.starts.loss < found.loss + _SAME).mean()),
        estimate,
        factors,
        test,
        list(problem.published),
        np.arange(len(rows(e))) if problem.t is None else np.asarray(problem.t),
        None if observed is None else rows(observed),
        None if observed is None else rows(observed + e),
        rows(e / noise),
        forecast,
    )
