"""Workers that start, die and resume, in virtual time, against the real commit code and a store in memory.

A worker is one part of a run. Its life is simulated event by event with a clock of its own, since parts share nothing
but the root of the store; every request goes through `Storage`, whose methods add a latency to that clock. A worker
dies at a random time, in the middle of a request too: then the request took effect or not, by chance.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple
from unittest import mock

import jax.numpy as jnp
import numpy as np

import lieint_jax as li
from lieint_jax.runs import store as archives
from lieint_jax.runs._engine import Engine
from lieint_jax.runs._plan import Plan, make_plan
from lieint_jax.runs._storage.bucket import Bucket
from lieint_jax.runs._storage.storage import ROOT, Url, address
from lieint_jax.runs.store import StoreOptions, _identity, _layout
from lieint_jax.runs.store._root import Root, read_root
from lieint_jax.runs.store._writer import Slab, Writer, join

MEMBERS = 2  # of a simulated worker; its requests are timed as if they had the bytes of all members


class Model(NamedTuple):
    """The assumptions of a simulation; times in seconds.

    Attributes:
        workers: how many run at the same time, each with a part.
        entries: saved entries of a member, in chunks of `rows`.
        seconds: the compute time between two saves.
        lifetime, wait: the means of the exponential distributions of a worker's life, and of the time to its successor.
        start: the time from the start of a worker to its first step.
        latency, sigma: median and logarithmic spread of a request's latency.
        bandwidth: bytes per second of one worker.
        failing: the fraction of requests that fail and are repeated, with the backoff of `_storage`.
        commit, state: the bytes of the chunks of a commit, which share the bandwidth, and of the state of a part.
    """

    workers: int
    entries: int
    rows: int
    seconds: float
    commit: float
    state: float
    lifetime: float = 1800.0
    wait: float = 60.0
    start: float = 20.0
    latency: float = 0.03
    sigma: float = 0.6
    bandwidth: float = 100e6
    failing: float = 0.01


class Dead(BaseException):
    """The worker dies."""


class TimedBucket(Bucket):
    """Objects in memory; each request costs time on the clock of a worker.

    Requests for chunks are made at the same time: they all start at `now`. `end` is the end of the last of them.
    """

    def __init__(self, url: Url, model: Model, rng: np.random.Generator) -> None:
        super().__init__(url)
        self.model, self.rng, self.guard = model, rng, threading.Lock()
        self.now = self.end = 0.0
        self.death = math.inf
        self.times: list[float] = []
        self.longest = self.repeated = 0.0

    def _size(self, name: str, size: int) -> float:
        """The bytes of a request for the real members, for a file of the simulated ones."""
        if name.startswith("parts/"):
            return self.model.state
        return (
            self.model.commit if name.split("/")[0] in ("q", "p", "residual", "converged") and "/c/" in name else size
        )

    def _pass_time(self, name: str, size: float) -> bool:
        """Pass the time of a request; False if the worker dies before it takes effect. Raises `Dead` after it has."""
        model = self.model
        with self.guard:
            begin, delay, spent = (self.now if "/c/" in name else self.end), 0.1, 0.0
            while True:
                self.times.append(begin + spent)
                spent += model.latency * math.exp(model.sigma * self.rng.normal()) + size / model.bandwidth
                if self.rng.random() >= model.failing:
                    break
                self.repeated += 1
                spent += delay * self.rng.uniform(0.5, 1.0)
                delay = min(2 * delay, 20.0)
            self.longest = max(self.longest, spent)
            self.end = max(self.end, begin + spent)
            return self.end < self.death

    def read(self, name: str) -> bytes:
        """See `Storage`."""
        data = super().read(name)
        self._ends(self._pass_time(name, self._size(name, len(data))))
        return data

    def tail(self, name: str) -> bytes:
        """See `Storage`."""
        data = super().tail(name)
        self._ends(self._pass_time(name, 0))
        return data

    def stage(self, name: str, data: bytes) -> None:
        """See `Storage`."""
        alive = self._pass_time(name, self._size(name, len(data)))
        if alive or self.rng.random() < 0.5:
            super().stage(name, data)
        self._ends(alive)

    def create_store(self, root: str, files: Mapping[str, bytes]) -> bool:
        """See `Storage`."""
        alive = self._pass_time(root, 0)
        created = super().create_store(root, files)
        self._ends(alive)
        return created

    def _ends(self, alive: bool) -> None:
        if not alive:
            raise Dead


class Outcome(NamedTuple):
    """The life of a part.

    Attributes:
        end: when it was complete.
        busy: intervals (begin, end) in which it computed.
        commits: times of its commits.
        requests: times of its requests.
        lost: seconds of computed work that had to be computed again.
        waited: seconds for which the computation waited for a commit.
        longest: the longest request with its repetitions, s.
        deaths: how often its worker died.
        repeated: requests that failed and were repeated.
    """

    end: float
    busy: list[tuple[float, float]]
    commits: list[float]
    requests: list[float]
    lost: float
    waited: float
    longest: float
    deaths: int
    repeated: float


class Simulation:
    """All workers of a model."""

    def __init__(self, model: Model, name: str) -> None:
        self.model = model
        body = li.systems.rigid_body([1.0, 2.0, 3.0])
        count = MEMBERS * model.workers
        q, p = np.tile([1.0, 0, 0, 0], (count, 1)), np.random.default_rng(0).normal(size=(count, 3))
        step, states = li.schemes.so3_midpoint(body), li.State(jnp.array(q), jnp.array(p))
        steps = model.entries - 1
        options = StoreOptions(f"memory://simulation/{name}.zarr")
        self.plan = make_plan(step, states, 0.05, steps, store=options, part=(0, model.workers))
        self.url = address(str(options.path))
        described = _identity.description(self.plan, Engine(self.plan, "native"))
        with mock.patch.object(Plan, "buffer_rows", return_value=model.rows):
            self.files = _layout.first_files(self.plan, options, described, self.plan.split(), True)
        self.created = 0

    def run(self) -> list[Outcome]:
        """The outcomes of all parts."""
        return [self._part(k) for k in range(self.model.workers)]

    def _part(self, k: int) -> Outcome:
        model, rng = self.model, np.random.default_rng([7, k])
        assert isinstance(self.url, Url)
        storage = TimedBucket(self.url, model, rng)
        busy: list[tuple[float, float]] = []
        commits: list[float] = []
        lost = waited = 0.0
        begin, deaths = float(rng.exponential(model.wait)), 0
        while True:
            storage.now = storage.end = begin + model.start
            storage.death = begin + rng.exponential(model.lifetime)
            published = len(commits)
            life = _Life(self, storage, k, commits)
            alive = life.run()
            waited += life.waited
            busy += life.busy
            if alive:
                return Outcome(
                    commits[-1], busy, commits, storage.times, lost, waited, storage.longest, deaths, storage.repeated
                )
            done = min(len(commits) - published, len(life.spent))  # the work of commits that count
            lost += sum(life.spent[done:])
            deaths += 1
            begin = storage.death + float(rng.exponential(model.wait))

    def root(self, storage: TimedBucket) -> Root:
        """The root of the store, created by the first worker."""
        found = read_root(storage)
        if found is None:
            self.created += storage.create_store(ROOT, self.files)
            found = read_root(storage)
        assert found is not None
        return Root(storage, found)

    def values(self, name: str, shape: tuple[int, ...], members: range, first: int) -> np.ndarray:
        """The results: numbers that depend on the array, the member and the entry only."""
        entry = np.arange(first, first + shape[0])[:, None]
        x = np.sin(1.0 + len(name) + 0.37 * entry + 1.3 * np.array(members)[None])
        x = x.reshape(*x.shape, *[1] * (len(shape) - 2)) * np.ones(shape)
        return x > 0 if name == "converged" else x


class _Life:
    """A worker from its start to its death or to the end of its part."""

    def __init__(self, simulation: Simulation, storage: TimedBucket, k: int, commits: list[float]) -> None:
        self.simulation, self.storage, self.k, self.commits = simulation, storage, k, commits
        self.busy: list[tuple[float, float]] = []
        self.spent: list[float] = []  # seconds of work of each chunk of this life
        self.waited = 0.0

    def run(self) -> bool:
        """True if the part is complete, False if the worker died."""
        try:
            root = self.simulation.root(self.storage)
            join(root, self.simulation.files)
            with contextlib.closing(Writer(root, self.k)) as writer:
                self._compute(root, writer)
        except Dead:
            self._note_commits()
            return False
        return True

    def _note_commits(self) -> None:
        """Record a commit whose request took effect at the moment of death."""
        storage = self.storage
        death, storage.death = storage.death, math.inf
        root = read_root(storage)
        state = Root(storage, root).state(self.k) if root else None
        storage.death = death
        rows = 0 if state is None else math.ceil(state.progress["entries"] / self.simulation.model.rows)
        self.commits += [death] * (rows - len(self.commits))

    def _compute(self, root: Root, writer: Any) -> None:
        model, storage = self.simulation.model, self.storage
        first, now = writer.progress["entries"], storage.end  # computing begins when the part is open
        written = now
        while first < model.entries:
            number = min(model.rows, model.entries - first)
            seconds = model.seconds * (number - (first == 0))
            if now + seconds > storage.death:
                self.busy.append((now, storage.death))
                self.spent.append(storage.death - now)
                raise Dead
            self.busy.append((now, now + seconds))
            self.spent.append(seconds)
            now += seconds
            self.waited += max(written - now, 0.0)
            now = max(now, written)  # the last commit must have been published
            storage.now = storage.end = now
            last = first + number == model.entries
            progress = {"commits": 0 if last else first // model.rows + 1, "entries": first + number}
            progress |= {"steps": first + number - 1, "complete": last}
            row = first // model.rows
            writer._put_all(self._slabs(root, first, number, last))
            writer.publish(row, progress, writer.checksums(row, last), {} if last else self._carry(root, first))
            written = storage.end
            self.commits.append(written)
            first += number

    def _carry(self, root: Root, first: int) -> dict[str, np.ndarray]:
        members = len(root.split.part(self.k))
        tails: dict[str, tuple[int, ...]] = {"q": (4,), "p": (3,), "residual": (), "failed": ()}
        return {name: np.full((members, *tail), float(first)) for name, tail in tails.items()}

    def _slabs(self, root: Root, first: int, number: int, last: bool) -> Iterator[Slab]:
        members = root.split.part(self.k)
        for name, tail in (("q", (4,)), ("p", (3,)), ("residual", ()), ("converged", ())):
            shape = (number, len(members), *tail)
            yield Slab(name, (first, 0), self.simulation.values(name, shape, members, first))
        if last:
            yield Slab("first_failure", (0,), np.full(len(members), -1))


def verify(simulation: Simulation) -> dict[str, int]:
    """Compare every stored value with that of a run without deaths; count entries that are lost or doubled."""
    found, attributes = archives.load_store(simulation.url, thorough=True)
    assert not attributes["missing"]
    lost = 0
    for name, x in (("q", found.state.q), ("p", found.state.p), ("residual", found.info.residual)):
        expected = simulation.values(name, x.shape, range(x.shape[1]), 0)
        lost += int((np.asarray(x) != expected).any(axis=tuple(range(2, x.ndim))).sum())
    bucket = Bucket(simulation.url) if isinstance(simulation.url, Url) else None
    assert bucket is not None
    objects = [name for name in bucket.sizes() if "/c/" in name]
    chunks = math.ceil(simulation.model.entries / simulation.model.rows)
    expected_objects = simulation.model.workers * (4 * chunks + 1)
    constants = sum(name.split("/")[0] in ("time", "step", "quaternion", "axis") for name in objects)
    return {"lost": lost, "doubled": len(objects) - constants - expected_objects}
