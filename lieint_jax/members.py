"""Members over devices: how a batch is cut, padded and placed, and the one compiled loop that advances it.

The loop is the same on one device, on many, and on many processes: `shard_map` over the mesh axis "members". A device's
members are padded to a multiple of 16, whole vectors of any width, and to 64 at least: below, a CPU's compiler unrolls
the loop over the vectors and rounds otherwise. So the bits of a result depend neither on how many devices there are nor
on where a member lies. On a CPU the loop takes the members in blocks that stay in its cache.
"""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Callable
from functools import cache, partial
from math import lcm
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lieint_jax.types import State, Step, StepInfo

AXIS = "members"
LANES = 16  # members of a whole vector: 16 float32 of 512 bits
_LEAST, _BLOCK = 64, 1024  # members that a CPU works on at once: their states and temporaries fit its cache

Reduction = Callable[[Step, State], Array]


class Layout(NamedTuple):
    """How `members` members lie on the devices of a mesh: `blocks` blocks of `block` members on each, in order.

    What is beyond the last member is padding: copies of it.
    """

    mesh: Mesh
    members: int
    block: int
    blocks: int

    @property
    def each(self) -> int:
        """Members a device, padding included."""
        return self.block * self.blocks

    @property
    def own(self) -> range:
        """The members of this process, without padding."""
        here = [k for k, device in enumerate(self.mesh.devices.flat) if device.process_index == jax.process_index()]
        return range(min(here) * self.each, min((max(here) + 1) * self.each, self.members))


class Range(NamedTuple):
    """Least, greatest and sum of a number over the steps since the last save, one a member."""

    least: Array
    greatest: Array
    total: Array

    @classmethod
    def fresh(cls, like: Array) -> Range:
        """Of no steps yet."""
        return cls(jnp.full_like(like, jnp.inf), jnp.full_like(like, -jnp.inf), jnp.zeros_like(like))

    def with_(self, x: Array) -> Range:
        """Together with one more number a member; a NaN shows in all three."""
        return Range(jnp.minimum(self.least, x), jnp.maximum(self.greatest, x), self.total + x)


class Carry(NamedTuple):
    """All that a run carries from one step to the next, every leaf with the member axis first.

    Attributes:
        state: the states.
        info: the report since the last save.
        failed: the first step that did not converge, or −1.
        change: of a reduced quantity, since the last save; None if nothing is reduced.
    """

    state: State
    info: StepInfo
    failed: Array
    change: Range | None


def mesh_of(mesh: Mesh | None) -> Mesh:
    """`mesh` if it has the one axis "members" and as many devices on each process; None means all devices."""
    if mesh is None:
        return first_devices(None)
    if not isinstance(mesh, Mesh) or tuple(mesh.axis_names) != (AXIS,):
        given = tuple(mesh.axis_names) if isinstance(mesh, Mesh) else type(mesh).__name__
        raise ValueError(f'mesh must be a jax.sharding.Mesh of one axis, "{AXIS}", got {given}')
    processes = [device.process_index for device in mesh.devices.flat]
    if processes != sorted(processes) or len({processes.count(p) for p in processes}) > 1:
        raise ValueError(f"mesh must list as many devices of each process, process by process, got {processes}")
    if jax.process_index() not in processes:
        raise ValueError(f"mesh has no device of this process, {jax.process_index()}")
    return mesh


def want_devices(count: int) -> None:
    """Cut the CPU into so many devices; without effect on accelerators, or once JAX has started."""
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", count)


def first_devices(count: int | None) -> Mesh:
    """A mesh of the first `count` devices of each process; None takes all."""
    devices = np.array(jax.devices())
    if count is not None:
        here = jax.local_device_count()
        if count > here:
            raise ValueError(f"{count} devices were asked for and {here} are there")
        devices = devices.reshape(-1, here)[:, :count].ravel()
    return Mesh(devices, (AXIS,))


def layout_of(mesh: Mesh, members: int, chunk: int | None = None) -> Layout:
    """How so many members lie on a mesh; with a `chunk`, each process holds a whole number of chunks of members."""
    processes = len({device.process_index for device in mesh.devices.flat})
    on_cpu = mesh.devices.flat[0].platform == "cpu"
    if chunk is None or processes == 1:
        each = -(-members // mesh.size)
        blocks = -(-each // _BLOCK) if on_cpu else 1
        return Layout(mesh, members, max(_LEAST, LANES * -(-each // (LANES * blocks))), blocks)
    devices = mesh.size // processes
    unit = lcm(chunk, _LEAST * devices)
    each = unit * -(-members // (processes * unit)) // devices
    block = max(b for b in range(_LEAST, _BLOCK + 1, LANES) if each % b == 0) if on_cpu else each
    return Layout(mesh, members, block, each // block)


def chunk_of(layout: Layout, most: int) -> int:
    """How many members a chunk of a store holds, at most `most` or one block of each device of a process."""
    devices = sum(device.process_index == jax.process_index() for device in layout.mesh.devices.flat)
    row = devices * layout.block
    return row * min(layout.blocks, max(1, most // row))


def place(layout: Layout, tree: Any, first: int = 0) -> Any:
    """Arrays of the host, from member `first` on, padded and spread over the devices; each process places its own."""
    size, spread = layout.mesh.size * layout.each, NamedSharding(layout.mesh, PartitionSpec(AXIS))

    def one(leaf: Any) -> Array:
        leaf = np.asarray(leaf)

        def part(index: Any) -> np.ndarray:
            return leaf[np.clip(np.arange(size)[index[0]] - first, 0, len(leaf) - 1)]

        return jax.make_array_from_callback((size, *leaf.shape[1:]), spread, part)

    return jax.tree.map(one, tree)


def replicate(mesh: Mesh, tree: Any) -> Any:
    """Arrays of the host, whole, on every device."""
    whole = NamedSharding(mesh, PartitionSpec())

    def one(leaf: Any) -> Array:
        leaf = np.asarray(leaf)
        return jax.make_array_from_callback(leaf.shape, whole, lambda index: leaf[index])

    return jax.tree.map(one, tree)


def own(layout: Layout, array: Array, axis: int = 0) -> np.ndarray:
    """This process' part of an array, without padding; `axis` is the member axis."""
    shards = sorted(array.addressable_shards, key=lambda shard: shard.index[axis].start or 0)
    whole = np.concatenate([np.asarray(shard.data) for shard in shards], axis) if len(shards) > 1 else shards[0].data
    return np.asarray(whole)[(slice(None),) * axis + (slice(len(layout.own)),)]


def fetch(layout: Layout, array: Array, axis: int = 0) -> np.ndarray:
    """A whole array on every process, without padding; `axis` is the member axis."""
    if not array.is_fully_addressable:
        array = jax.jit(lambda x: x, out_shardings=NamedSharding(layout.mesh, PartitionSpec()))(array)
        array = array.addressable_data(0)
    return np.asarray(array)[(slice(None),) * axis + (slice(layout.members),)]


def agree(mesh: Mesh, *values: float) -> tuple[float, ...]:
    """Each value's largest over the processes: what all of them then act on alike."""
    if len({device.process_index for device in mesh.devices.flat}) == 1:
        return values
    spread = NamedSharding(mesh, PartitionSpec(AXIS))
    each = jax.make_array_from_callback((mesh.size, len(values)), spread, lambda _: np.asarray([values]))
    return tuple(map(float, np.asarray(_largest(mesh)(each).addressable_data(0))))


@cache
def _largest(mesh: Mesh) -> Any:
    return jax.jit(lambda x: x.max(axis=0), out_shardings=NamedSharding(mesh, PartitionSpec()))


def compiler_options() -> dict[str, Any]:
    """What the compiled loops are built with: full-width vectors, 1.4 to 1.7 times faster on AVX-512 machines."""
    on_x86 = jax.default_backend() == "cpu" and platform.machine().lower() in ("x86_64", "amd64")
    return {"xla_cpu_prefer_vector_width": 512} if on_x86 else {}


def start(layout: Layout, step_axis: int | None, reduction: Reduction | None) -> Callable[..., tuple[Carry, Any]]:
    """(step, states, dt) ↦ the carry of a run and the reduced quantity at its start (None if nothing is reduced)."""
    return _start(layout.mesh, layout.block, layout.blocks, step_axis, reduction)


@cache
def _start(mesh: Mesh, block: int, blocks: int, step_axis: int | None, reduction: Reduction | None) -> Any:
    def kernel(step: Step, states: State) -> tuple[Carry, Any]:
        members = states.p.shape[0]
        info = StepInfo(jnp.zeros(members, states.p.dtype), jnp.ones(members, bool))
        origin = None if reduction is None else jax.vmap(reduction, in_axes=(step_axis, 0))(step, states)
        change = None if origin is None else Range.fresh(origin)
        return Carry(states, info, jnp.full(members, -1, _integer()), change), origin

    return _spread(kernel, mesh, (block, blocks), (step_axis, 0), (0, 0))


def prepare(layout: Layout, step_axis: int | None) -> Callable[..., Any]:
    """(step, states, dt) ↦ the prepared steps, with the member axis on every leaf."""
    return _prepare(layout.mesh, layout.block, layout.blocks, step_axis)


@cache
def _prepare(mesh: Mesh, block: int, blocks: int, step_axis: int | None) -> Any:
    def kernel(step: Step, states: State, dt: Array) -> Step:
        return jax.vmap(lambda step, state: step.prepare(state, dt), in_axes=(step_axis, 0), axis_size=block)(
            step, states
        )

    return _spread(kernel, mesh, (block, blocks), (step_axis, 0, None), 0)


def advance(
    layout: Layout, step_axis: int | None, reduction: Reduction | None, rows: int
) -> Callable[..., tuple[Carry, Any]]:
    """The compiled loop, for at most `rows` saves a call.

    (step, carry, origin, dt, done, saves, every, fresh) ↦ the carry after `saves` times `every` more steps, `done`
    having been taken before, and what is saved: of each save the state and the report, or the report and the change of
    the reduced quantity. Without `fresh` the first save interval goes on with the report that the carry brings.
    """
    return _advance(layout.mesh, layout.block, layout.blocks, step_axis, reduction, rows)


@cache
def _advance(mesh: Mesh, block: int, blocks: int, step_axis: int | None, reduction: Reduction | None, rows: int) -> Any:
    def kernel(
        step: Step, carry: Carry, origin: Any, dt: Array, done: Array, saves: Array, every: Array, fresh: Array
    ) -> tuple[Carry, Any]:
        none = Carry(
            carry.state,
            jax.tree.map(lambda like, x: jnp.full_like(like, x), carry.info, StepInfo(0, True)),  # pyright: ignore[reportArgumentType]
            jnp.full(carry.failed.shape, -1, jnp.int32),
            None if carry.change is None else Range.fresh(carry.change.total),
        )

        def one(n: Array, carry: Carry) -> Carry:
            state, info = jax.vmap(lambda s, z: s(z, dt), in_axes=(step_axis, 0))(step, carry.state)
            failed = jnp.where((carry.failed < 0) & ~info.converged, n, carry.failed)
            change = carry.change
            if reduction is not None and change is not None:
                change = change.with_(jax.vmap(reduction, in_axes=(step_axis, 0))(step, state) - origin)
            return Carry(state, carry.info.worse(info), failed, change)

        def interval(k: Array, loop: tuple[Carry, Any]) -> tuple[Carry, Any]:
            carry, saved = loop
            begun = (k > 0) | fresh
            info, change = jax.tree.map(
                lambda new, old: jnp.where(begun, new, old), (none.info, none.change), (carry.info, carry.change)
            )
            carry = carry._replace(info=info, change=change)
            carry = lax.fori_loop(0, every, lambda i, c: one(k * every + i, c), carry)
            return carry, jax.tree.map(lambda to, x: to.at[k].set(x), saved, _saved(carry))

        buffer = jax.tree.map(lambda x: jnp.zeros((rows, *x.shape), x.dtype), _saved(carry))
        begin = carry._replace(failed=none.failed)
        end, saved = lax.fori_loop(0, saves, interval, (begin, buffer))
        first = jnp.where(end.failed < 0, -1, done + end.failed)
        return end._replace(failed=jnp.where(carry.failed < 0, first, carry.failed).astype(carry.failed.dtype)), saved

    return _spread(kernel, mesh, (block, blocks), (step_axis, 0, 0, *(None,) * 5), (0, 1))


def _saved(carry: Carry) -> Any:
    return (carry.info, carry.state if carry.change is None else carry.change)


def energies(layout: Layout, step_axis: int | None) -> Callable[..., Array]:
    """(step, states) ↦ the energy of each member."""
    return _energies(layout.mesh, layout.block, layout.blocks, step_axis)


@cache
def _energies(mesh: Mesh, block: int, blocks: int, step_axis: int | None) -> Any:
    return _spread(jax.vmap(energy, in_axes=(step_axis, 0)), mesh, (block, blocks), (step_axis, 0), 0)


def worst(layout: Layout, H0: Array, H: Array, failed: Array) -> tuple[float, int]:
    """The largest |H − H₀| over the largest |H₀|, and how many members have failed."""
    change, size, count = (x.addressable_data(0) for x in _worst(layout.mesh, layout.members)(H0, H, failed))
    return float(change) / float(size) if size else float(change), int(count)


@cache
def _worst(mesh: Mesh, members: int) -> Any:
    def worst(H0: Array, H: Array, failed: Array) -> tuple[Array, Array, Array]:
        return jnp.max(jnp.abs(H - H0)), jnp.max(jnp.abs(H0)), jnp.sum(failed[:members] >= 0)

    return jax.jit(worst, out_shardings=NamedSharding(mesh, PartitionSpec()))


def energy(step: Step, state: State) -> Array:
    """The energy of a step's system."""
    return step.system.energy(state)


def _integer() -> Any:
    return jax.dtypes.canonicalize_dtype(np.int64)


def _spread(function: Any, mesh: Mesh, cut: tuple[int, int], axes: tuple[int | None, ...], out: Any) -> Any:
    """A function of one block of members, jitted, over all blocks of all devices.

    `axes` says which arguments have the member axis (first), `out` where each result has it.
    """
    block, blocks = cut

    def specs(axis: int | None) -> PartitionSpec:
        return PartitionSpec() if axis is None else PartitionSpec(*(None,) * axis, AXIS)

    def on_device(*arguments: Any) -> Any:
        if blocks == 1:
            return function(*arguments)

        def split(x: Array) -> Array:
            return x.reshape(blocks, block, *x.shape[1:])

        def join(axis: int, x: Array) -> Array:
            x = jnp.moveaxis(x, 0, axis)
            return x.reshape(*x.shape[:axis], blocks * block, *x.shape[axis + 2 :])

        batched = [jax.tree.map(split, x) for x, axis in zip(arguments, axes, strict=True) if axis is not None]

        def one(parts: list[Any]) -> Any:
            rest = iter(parts)
            return function(*(x if axis is None else next(rest) for x, axis in zip(arguments, axes, strict=True)))

        result = lax.map(one, batched)
        if isinstance(out, int):
            return jax.tree.map(partial(join, out), result)
        return tuple(jax.tree.map(partial(join, axis), part) for axis, part in zip(out, result, strict=True))

    shape = specs(out) if isinstance(out, int) else tuple(map(specs, out))
    spread = jax.shard_map(on_device, mesh=mesh, in_specs=tuple(map(specs, axes)), out_specs=shape, check_vma=False)
    return jax.jit(spread, compiler_options=compiler_options())
