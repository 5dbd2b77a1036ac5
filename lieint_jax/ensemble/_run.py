"""`ensemble.run`: a batch in one compiled loop, in memory or into a store."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, Literal, TypeVar

from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jax.sharding import Mesh
from jax.typing import ArrayLike

from lieint_jax import _checks
from lieint_jax._deprecated import old_calls
from lieint_jax.ensemble import _identity, _layout, processes
from lieint_jax.ensemble._engine import engine_of
from lieint_jax.ensemble._execute import execute
from lieint_jax.ensemble._into_store import run_into_store, run_part_into_store
from lieint_jax.ensemble._job import Output
from lieint_jax.ensemble._layout import Layout
from lieint_jax.ensemble._loop import Reduction
from lieint_jax.ensemble._made_states import MakeStates, made_states
from lieint_jax.ensemble._make_job import checked_job, make_jobs
from lieint_jax.ensemble._memory_output import MemoryOutput
from lieint_jax.ensemble._part_of_task import checked_part, part_of_task
from lieint_jax.ensemble._storage import Url, address
from lieint_jax.ensemble._store_options import StoreOptions
from lieint_jax.types import State, Step

_F = TypeVar("_F", bound=Callable[..., Any])


def _untransformed(function: _F) -> _F:
    """Raise TypeError where the function is called with tracers, or meets those of a function that closes over them."""
    advice = (
        f"ensemble.{function.__name__} computes with numbers, outside of jax.jit, jax.vmap, jax.grad and jax.jvp: "
        "inside of them use li.integrate, for a batch jax.vmap(lambda z: li.integrate(step, z, dt, num_steps))(states)"
    )

    @wraps(function)
    def call(*args: object, **kwargs: object) -> object:
        numbers = {name: x for name, x in kwargs.items() if name != "store"}  # whose attributes may hold anything
        if _checks.staged() or not _checks.concrete(args, numbers):
            raise TypeError(advice)
        try:
            return function(*args, **kwargs)
        except (ConcretizationTypeError, TracerArrayConversionError) as error:
            if _checks.outermost():
                raise
            raise TypeError(advice) from error

    return call  # pyright: ignore[reportReturnType]


@old_calls()
@_untransformed
def run(
    step: Step,
    states: State | MakeStates,
    dt: float | None = None,
    num_steps: int | None = None,
    *,
    save_every: int | None = None,
    step_axis: int | None = None,
    reduce: Reduction | Literal["energy"] | None = None,
    mesh: Mesh | None = None,
    store: str | Path | StoreOptions | None = None,
    progress: bool = True,
    resume: bool = False,
    times: ArrayLike | None = None,
    save_at: ArrayLike | None = None,
    part: tuple[int, int] | Literal["auto"] | None = None,
    members: int | None = None,
) -> Any:
    """Integrate a batch of initial states in one compiled loop, in memory or into a store that can be resumed.

    On a CPU the loop is machine code for vectors of members, in one thread per core (`lieint_jax.native`). Steps that
    cannot be compiled this way (a LAPACK call that depends on the state, very many bodies) and other devices use XLA.

    The bits of machine code depend neither on threads, processes and parts nor on whether the run was resumed; those of
    XLA may depend on the numbers of members and devices. With `jax.distributed`, every process calls this with the same
    arguments and gets the same results.

    Args:
        step: a scheme's step; with `step_axis=0` its leaves carry the member axis too (one inertia per member).
        states: initial states with a leading member axis. A time t of shape () is shared by all members, and so is one
            of shape (members,) whose values are equal: then what depends on it alone, such as the position on an orbit,
            is computed once per step. `work` of shape () is that of every member. Or a function of member numbers (m,),
            which returns the states of these members: then a part makes only its own. It is called for consecutive
            numbers, up to 65 536 at once, must return the same for the same numbers in every process, and shares a time
            only by one of shape ().
        dt: step size, the same for all members.
        num_steps: number of steps, a multiple of `save_every`.
        save_every: number of steps between saved states; None saves the last state only.
        step_axis: None or 0.
        reduce: a quantity, "energy" (minus the work, where states have it) or a function (step, state) ↦ scalar.
            Intermediate states are not saved; the result has instead, for each save interval, the least, greatest and
            mean change of the quantity over all steps and members. All three are NaN where the quantity was NaN.
        mesh: devices, a `jax.sharding.Mesh` of the one axis "members"; None uses all. Machine code uses as many threads
            as the mesh has devices of this process, by default one per core.
        store: a folder NAME.zarr, a URL (s3://, gs://, az:// or memory://BUCKET/NAME.zarr), or `StoreOptions`, to which
            results are written during the run; memory then holds two rows of chunks of them: see `peak_memory`.
            Credentials for a URL are those in the environment.
        progress: show a progress bar on stderr, if that is a terminal.
        resume: continue the run in `store` from its last checkpoint; start it if there is no store.
        times: in place of dt and num_steps, the times (N+1,) of the boundaries of all members' steps, as in
            `integrate`.
        save_at: in place of save_every, output times (m,) as in `integrate`; since the start, if the members start at
            different times. The run ends at the last of them.
        part: (k, n) integrates part k = 0 … n − 1 of the members only, as one of n processes that need not run at the
            same time or communicate. Each writes its own part of `store`; it continues this part, if the store
            has it, and starts it otherwise. "auto" is the number of this task in an array of tasks: see
            `part_of_task`. In machine code all parts have the bits of one process.
        members: the number of members, where `states` is a function.

    Returns:
        A `Trajectory` of numpy arrays, axes (time, member, …), the initial states first; with `store`, of Zarr arrays,
        which are read from disk when they are indexed. With `reduce`, a `Summary`. With `part`, the results of the
        members of that part; `ensemble.open` returns those of all. Its t is t₀ + nΔt, where t₀ is the
        shared time of the members. If they have no time or start at different times, t is the time since the start. If
        the step has its `own_time`, t is nΔt, and state.t the time of each member.

    Raises:
        TypeError: the call is inside of jit, vmap, grad or jvp: use `integrate` there.
        ValueError: invalid counts or times; states off the group, not finite, or without the time that a driven system
            needs; members whose first step fails; results larger than this machine's memory; a store that exists
            (without `resume`), or that is damaged, holds another run or cannot be compared with this one (with
            `resume`); attributes that a store cannot hold; `reduce` does not return a real scalar, or not a finite one
            at the start; processes that were given different runs.
        KeyboardInterrupt: interrupted; with `store`, after the chunk has been written.
        processes.LostProcess: another process of this run is gone.

    Warns:
        RuntimeWarning: a store that cannot be resumed, since the step refers to something that cannot be compared;
            members that fail to converge later, with the first such step of each; a time of the states
            so large that neighboring floating-point numbers differ by more than dt/10⁶.
    """
    _check_options(step_axis, reduce, resume, store)
    k, count = part_of_task() if part == "auto" else checked_part(part)
    threads = None if mesh is None else len(mesh.local_devices)
    mesh = _layout.checked_mesh(mesh)
    options = store if isinstance(store, StoreOptions) or store is None else StoreOptions(store)
    in_parts, remote = part is not None and count > 1, options is not None and isinstance(address(options.path), Url)
    if (in_parts or remote) and _layout.count_processes(mesh) > 1:
        raise ValueError("part and stores in object storage are for independent processes, without jax.distributed")
    made = made_states(states, members)
    make_job = partial(
        checked_job,
        dt=dt,
        num_steps=num_steps,
        save_every=save_every,
        step_axis=step_axis,
        reduce=reduce,
        store=store,
        times=times,
        save_at=save_at,
    )
    with _checks.on_host():
        whole, job, split = make_jobs(make_job, step, states, made, (k, count) if in_parts else None, remote)
    engine = engine_of(job, mesh, threads or _layout.count_cores())

    def integrate(layout: Layout, output: Output) -> object:
        return execute(engine, layout, output, progress)

    with processes.name_lost(mesh):
        if options is None:
            if _layout.count_processes(mesh) > 1:
                _identity.check_processes(mesh, _identity.description(job, engine.name), store=None, resume=False)
            layout = _layout.layout_of(mesh, job.members)
            return execute(engine, layout, MemoryOutput(job, layout), progress)
        if in_parts or remote:
            resume = resume or part is not None
            return run_part_into_store(engine, whole, mesh, options, split, k, resume, integrate)
        return run_into_store(engine, mesh, options, resume or part is not None, integrate)


def _check_options(step_axis: int | None, reduce: object, resume: bool, store: object) -> None:
    if step_axis not in (None, 0):
        raise ValueError(f"step_axis must be None (one step for all) or 0 (one per member), got {step_axis!r}")
    if reduce is not None and reduce != "energy" and not callable(reduce):
        raise ValueError(f'reduce must be None, "energy" or a function (step, state) ↦ scalar, got {reduce!r}')
    if resume and store is None:
        raise ValueError("resume continues a run in a store; pass store=PATH.zarr")
