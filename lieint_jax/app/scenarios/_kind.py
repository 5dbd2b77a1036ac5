"""A kind of scenario: its keys are the fields of a class, its methods make a run and say what the run shows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from typing import Annotated, Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from pydantic import Field, model_validator

from lieint_jax import _checks, plots, schemes
from lieint_jax._numerics import random_bits
from lieint_jax.app.scenarios import _spread
from lieint_jax.app.scenarios._keys import Date, PositiveInt, Table, Text, methods
from lieint_jax.app.scenarios._report import ROUND_OFF, Conserved, Quantity, join_members, text
from lieint_jax.app.scenarios._runs import (
    LONGEST,
    as_batch,
    drawn_run,
    length,
    momentum,
    nominal_state,
    positive,
    series,
)
from lieint_jax.runs import Run
from lieint_jax.types import State, Step, System, energy_less_work

Picture = Callable[[Any, Run], Figure]
R = TypeVar("R")

ORDERS: dict[str, list[Any]] = {
    "so3_midpoint": [2, 4, 6, 8, 10],
    "so3_explicit": [2, 4, 6, 8, 10],
    "preprocessed": [4, 6, 8, 10],
    "extrapolate": [12, *range(4, 12, 2), *range(14, 22, 2)],
    "gauss": [16, *range(2, 16, 2), 18, 20],
    "nystrom": [6, 4],
    "kepler_splitting": [[8, 6, 4], [8, 4], 2],
    "splitting": [2, 4, 6, 8],
    "bodies_energy_momentum": [2, 4, 6, 8],
}
"""The orders of schemes, the default first; of those not named here 2, and higher ones by composition."""


def step_of(system: Any, scheme: str, order: Any = None, *options: Any) -> Step:
    """The step of a scheme at an order, by default the first of `ORDERS`; `options` are its further arguments."""
    make, order = getattr(schemes, scheme), order or ORDERS.get(scheme, [2])[0]
    if scheme in ("nystrom", "preprocessed", "extrapolate", "kepler_splitting"):
        return make(system, order, *options)
    if scheme == "gauss":
        return make(system, order // 2)
    step = make(system, *options)
    return step if order == 2 else schemes.compose(step, order)


def check_order(scheme: str, order: Any) -> None:
    """Raise ValueError if a scheme does not have the given order; an exact scheme has none."""
    allowed = ORDERS.get(scheme, [])
    if order is not None and order not in allowed:
        known = " or ".join(map(str, allowed)) or "none, since it is exact"
        raise ValueError(f"order of {scheme} is {known}, got {order}")


class Kind(Table):
    """The keys of every scenario. A kind of system adds its own, and declares what follows from them.

    | method | returns |
    |---|---|
    | `make_system()` | the system; numbers that `[spread]` may name can be traced |
    | `start(system, noise)` | a member's initial state, for its standard normal deviates (2, 3), 0 of the nominal one |
    | `make_step()` | the step; by default that of the keys `scheme` and `order`, with the further `options()` |
    | `member(noise)` | with `own_step`, the step and the state of a member; by default of the methods above |
    | `conserved(run)` | what the motion conserves; by default energy and momentum map |
    | `quantities(run)` | what is measured; by default by the methods marked `quantity` |
    | `remarks(run)` | further lines of the report |
    | `draw_NAME(run)` | a picture, marked `picture` |

    Only the first two are required. Where `[spread]` names numbers, each member has a step of its own: `conserved` and
    `quantities` are then called for the run of each member alone.
    """

    title: Text
    """Shown in reports and pictures."""
    about: Text = ""
    """The question that the scenario answers, one line for `lieint list`."""
    time_unit: Text = "time unit"
    """The name of the unit of time. Choose any units of length and mass; all numbers must be in them."""
    epoch: Date | None = None
    """The date of t = 0, with its scale, such as "2026-03-01T12:00:00 TDB"; without a scale in UTC."""
    system: str
    """The kind of system."""
    dt: float
    """Step size, in time_unit, of either sign."""
    steps: PositiveInt
    """The number of steps, a multiple of save_every."""
    save_every: PositiveInt = 1
    """Steps between saved states."""
    save_at: list[float] | None = None
    """Times of saved states, in the order of the run, instead of save_every; a shorter step ends at each."""
    members: Annotated[int, Field(gt=0, le=10**9)] = 1
    """The number of members of the ensemble; the first is the nominal state."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """The seed of the members' random deviations."""
    sources: dict[str, str] = {}
    """Full references, by the short names in `source` keys."""

    fixed: ClassVar[dict[str, str]] = {
        "dt": "all members have the same steps",
        "save_at": "all members are saved at the same times",
        "published.*": "it is a published value",
    }
    """Patterns of the paths of numbers that have no spread, with the reasons."""
    no_spread: ClassVar[str] = ""
    """Why a kind of system has no table spread, where it has none."""
    own_step: ClassVar[bool | None] = None
    """Whether each member has a step of its own, and `build` no indices; None: where `[spread]` names numbers."""
    certified: ClassVar[bool] = True
    """Whether `lieint run` prints a certificate: control and friction conserve the energy balance only."""
    unit_km: ClassVar[float | None] = None
    """The unit of length of a kind that has positions, in km."""
    traced: ClassVar[bool] = True
    """Whether `make_system` accepts traced numbers; if not, the members' systems are made one by one."""

    def given_orbit(self) -> Callable[..., Any] | None:
        """The orbit of a body, t ↦ position and velocity, where all members share it and states have no positions."""

    @model_validator(mode="before")
    @classmethod
    def _check_spread_table(cls, keys: Any) -> Any:
        if isinstance(keys, dict) and "spread" in keys and "spread" not in cls.model_fields:
            raise ValueError(f"spread: {cls.no_spread}")
        return keys

    def _check_steps(self) -> None:
        if self.dt == 0:
            raise ValueError("dt must not be 0")
        if self.steps % self.save_every:
            near = _checks.nearest_multiples(self.steps, self.save_every)
            raise ValueError(f"steps = {self.steps} must be a multiple of save_every = {self.save_every}: give {near}")

    def _check_sources(self) -> None:
        for key in _sources(self.model_dump()):
            if self.sources and key not in self.sources:
                raise ValueError(f"source {key!r} is not one of the keys of [sources]: {', '.join(self.sources)}")

    def _check_number_spreads(self) -> None:
        self.own_numbers()

    def _check_published(self) -> None:
        keys = {mark[1] for f in methods(type(self)) if (mark := vars(f).get("quantity")) is not None}
        if keys and (unknown := set(self._published()) - keys):
            known = " or ".join(sorted(keys - {""}))
            raise ValueError(f"published.{min(unknown)}: no quantity has this key; {known} has")

    def own_numbers(self) -> dict[_spread.Path, _spread.GivenSpread]:
        """The spreads of the numbers that differ between members, by the paths of the numbers."""
        return _spread.requested_spreads(self, self.fixed)

    def has_own_steps(self) -> bool:
        """Whether the leaves of the step have the member axis."""
        return bool(self.own_numbers()) if self.own_step is None else self.own_step

    def spreads(self) -> dict[str, tuple[float, str]]:
        """The standard deviations of the initial states with their units, by quantity."""
        table = dict(self).get("spread")
        return {} if table is None else table.stated(self.time_unit)

    def assumption(self) -> str:
        """The line of the report with the assumed spread of the ensemble; empty if there is none."""
        spreads = self.spreads()
        given = [
            f"{name} {x:.3g}{'' if unit[:1] == '°' else ' '}{unit}".rstrip() for name, (x, unit) in spreads.items() if x
        ]
        given += [spread.words for spread in self.own_numbers().values()]
        line = f"spread about the nominal state, an assumption (1 sigma, each component): {', '.join(given) or 'none'}"
        return line if spreads or given else ""

    def clock(self) -> dict[str, Any]:
        """The arguments of `li.run` for the times of the steps."""
        return {"dt": self.dt, "num_steps": self.steps}

    def describe_steps(self) -> str:
        """The number and size of the steps, as text."""
        span = self.dt * self.steps
        return f"{self.steps} steps of {self.dt:.6g} {self.time_unit} = {span:.6g} {self.time_unit}"

    def date_of_zero(self) -> Any:
        """The date of t = 0, or None; that of other keys, where they give it."""
        return self.epoch

    def source(self, key: str) -> str:
        """The full reference for `key`, or `key` itself."""
        return self.sources.get(key, key)

    def make_system(self) -> System:
        """The system of the nominal member."""
        raise NotImplementedError

    def options(self) -> tuple[Any, ...]:
        """The arguments of the scheme after the system, or after the order."""
        return ()

    def make_step(self) -> Step:
        """The step of the nominal member."""
        keys = dict(self)
        return step_of(self.make_system(), keys["scheme"], keys.get("order"), *self.options())

    def start(self, system: Any, noise: Any) -> State:
        """The initial state of a member."""
        raise NotImplementedError

    def member(self, noise: Any) -> tuple[Step, State]:
        """The step and the initial state of a member."""
        step = self.make_step()
        return step, self.start(step.system, noise)

    def indices(self, indices: np.ndarray | None) -> np.ndarray:
        """The numbers of the members that `build` makes; None selects all."""
        return np.arange(self.members) if indices is None else indices

    def deviates(self, indices: np.ndarray) -> Any:
        """Standard normal deviates of two vectors of each member, (m, 2, 3); those of the nominal member are 0."""
        normal = random_bits.normal_rows(jax.random.key(self.seed), (2, self.members, 3), indices, axis=1)
        return jnp.swapaxes(jnp.where((indices == 0)[:, None], 0.0, normal), 0, 1)

    def build(self, indices: np.ndarray | None = None) -> tuple[Step, State]:
        """The step, and the initial states of all members or of some; member 0 is nominal."""
        return _spread.build(self, self.deviates(self.indices(indices)))

    def conserved(self, run: Run) -> list[Conserved]:
        """Energy, less the work that states count, and the momentum map, with what the scheme promises."""
        found, Phi = list[Conserved](), series(momentum, run)
        if run.system.hamiltonian:
            H, name = series(energy_less_work, run), "energy" if run.state.work is None else "energy less work"
            found.append(Conserved(f"{name}, relative", H, positive(abs(H).max(axis=0)), self._promise(name)))
        if Phi.shape[-1]:
            found.append(Conserved("momentum, relative", Phi, positive(length(Phi[0])), self._promise("momentum")))
        return found

    def _promise(self, name: str) -> str:
        """How well the scheme conserves energy, energy less work, or momentum, as it declares."""
        scheme = dict(self).get("scheme", "")
        declared = next((x.conserves for x in schemes.catalogue() if x.name == scheme), ())
        case = {what: condition for what, _, condition in (x.partition(" (") for x in declared)}
        if name in case:
            return f"{ROUND_OFF} ({case[name]}" if case[name] else ROUND_OFF
        return "bounded, not conserved" if "form" in case else ""

    def quantities(self, run: Run) -> list[Quantity]:
        """The values of the methods that are marked `quantity`, in their order."""
        found = []
        for function in methods(type(self)):
            if (mark := vars(function).get("quantity")) is not None:
                name, published, options = mark
                values, name = np.asarray(function(self, run)), name.format(time_unit=self.time_unit)
                if values.shape != (run.members,):
                    shape = f"({run.members},), one for each member, got {values.shape}"
                    raise ValueError(f"{type(self).__name__}.{function.__name__}, {name}, must return values {shape}")
                found.append(Quantity(name, values, published=self._published().get(published), **options))
        return found

    def _published(self) -> dict[str, Any]:
        """The published values by their keys, of a table or a dict."""
        return dict(dict(self).get("published") or {})

    def remarks(self, run: Run) -> list[str]:
        """Further lines of the report."""
        return []

    def measured(self, run: Run) -> tuple[list[Conserved], list[Quantity]]:
        """What is conserved and measured; of each member alone, where only the spread makes their systems differ."""
        if self.own_step is not None or not run.own_step:
            return self.conserved(run), self.quantities(run)
        each = [(its, as_batch(run.member(m))) for m, its in enumerate(_spread.member_scenarios(self))]
        conserved = join_members([its.conserved(one) for its, one in each])
        return conserved, join_members([its.quantities(one) for its, one in each])

    def report(self, run: Run) -> str:
        """The text that reports a run: what is conserved, what was measured, and the remarks."""
        return text(self, *self.measured(run), self.remarks(run))

    @classmethod
    def pictures(cls) -> dict[str, Picture]:
        """The functions that draw a run, by the suffix of their file names."""
        return {f.__name__.removeprefix("draw_"): f for f in methods(cls, "draw_")}

    def drawn(
        self, one: Run, fine: int = 1, steps: int | None = None, longest: int = LONGEST, step: Step | None = None
    ) -> Run:
        """A run of one body again for a picture, in steps `fine` times as small, saved at the points to draw."""
        count = fine * (self.steps if steps is None else steps)
        return drawn_run(step or one.step, nominal_state(one), self.dt / fine, count, longest)

    def changes(
        self, run: Run, steps: Iterable[Step], longest: int = LONGEST
    ) -> tuple[np.ndarray, dict[str, dict[str, np.ndarray]]]:
        """Times, and the relative changes of what is conserved, by the names of steps and quantities.

        They are those of at most `longest` of each of the `steps`, from the first state of a run of one body.
        """
        found, t = {}, np.zeros(0)
        for step in steps:
            long = as_batch(self.drawn(run, longest=longest, step=step))
            t = np.asarray(long.t)
            found[step.name] = {x.name: x.change()[:, 0] for x in self.conserved(long)}
        return t, found


def quantity(name: str, published: str = "", **options: Any) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Mark a method (run) ↦ values of the members, (members,), as a measured quantity of the report.

    Args:
        name: its name, with its unit; `{time_unit}` is that of the scenario.
        published: its key in the table `published` of the scenario.
        options: `digits`, `closed_form` and `angle` of `Quantity`.
    """

    def mark(function: Callable[..., R]) -> Callable[..., R]:
        vars(function)["quantity"] = (name, published, options)
        return function

    return mark


def picture(
    columns: int = 1, rows: int = 1, *, size: Any = None, spatial: Sequence[int] = (), **options: Any
) -> Callable[[Callable[..., None]], Picture]:
    """Make the figure, with the scenario's title, for a method `draw_NAME(axes, run)` with an array of axes (panels,).

    Args:
        columns, rows: the numbers of columns and rows of panels.
        size: the size of a panel in inches, or a function of the scenario that returns it.
        spatial: the indices of panels with three axes.
        options: further arguments of `plots.figure`.
    """

    def decorate(draw: Callable[..., None]) -> Picture:
        if not draw.__name__.startswith("draw_"):
            raise ValueError(f"a picture is a method draw_NAME, whose file is SCENARIO-NAME.png; got {draw.__name__}")

        @plots.style()
        @wraps(draw)
        def figure_of_run(scenario: Any, run: Run) -> Figure:
            inches: Any = size(scenario) if callable(size) else size
            fig, axes = plots.figure(columns, rows, inches, **options)
            axes = axes.ravel()
            for k in spatial:
                axes[k].remove()
                axes[k] = fig.add_subplot(rows, columns, k + 1, projection="3d")
            fig.suptitle(scenario.title)
            draw(scenario, axes, run)
            return fig

        return figure_of_run

    return decorate


def for_last_run(method: Callable[[Any, Run], R]) -> Callable[[Any, Run], R]:
    """Store the value of a method for the last run, which the report and the pictures share."""
    last: list[tuple[Run, R]] = []

    @wraps(method)
    def cached(scenario: Any, run: Run) -> R:
        if not (last and last[0][0] is run):
            last[:] = [(run, method(scenario, run))]
        return last[0][1]

    return cached


def _sources(tree: Any) -> list[str]:
    """The values of all keys `source` of a tree of tables."""
    if isinstance(tree, dict):
        here = [value for key, value in tree.items() if key == "source"]
        return here + [name for value in tree.values() for name in _sources(value)]
    return [name for value in tree for name in _sources(value)] if isinstance(tree, list) else []
