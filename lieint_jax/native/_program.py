"""Programs of single numbers: arithmetic, loops and branches, in static single assignment.

Building a program simplifies it: constants are folded, common subexpressions are computed once, and operations that do
not depend on a loop are moved out of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike, DTypeLike

Data = Any  # the value of a constant, the exponent of a power, the place of an argument
# Arrays in memory: of given numbers; not written yet; with one more entry; as a loop carries it; after the loop; the
# rows of a map; entries of an argument; an array that becomes entries of a result.
_ARRAYS = frozenset({"array", "empty", "put", "carry array", "result array", "rows", "column", "stored"})
_OF_MAP = 64  # numbers of a map, which are in memory, so that more than one vector of each would not make it faster
COMMUTATIVE = frozenset({"add", "mul", "max", "min", "eq", "ne", "and", "or", "xor"})
COMPARISONS = frozenset({"eq", "ne", "lt", "le", "gt", "ge"})


class Column(NamedTuple):
    """Entries of an argument, or of a result, that a program has as an array in memory.

    Attributes:
        leaf: the number of the argument, −1 for a result.
        first, stride, length: which entries they are.
    """

    leaf: int
    first: int
    stride: int
    length: int


class Value:
    """One value: the result of an operation, a constant, an argument, or what a loop carries.

    Attributes:
        op: the name of the operation, in most cases that of JAX's primitive.
        inputs: the operands.
        dtype: its NumPy type.
        data: the parameter of the operation: the value of a constant, the exponent of a power.
        block: the block that computes it; None for constants.
        is_constant: whether it is a constant.
        is_array: whether it stands for an array in memory, whose entries are numbers of its type.
    """

    __slots__ = ("block", "data", "dtype", "inputs", "is_array", "is_constant", "op")

    def __init__(self, op: str, inputs: tuple[Value, ...], dtype: np.dtype, data: Data, block: Block | None):
        self.op, self.inputs, self.dtype, self.data, self.block = op, inputs, dtype, data, block
        self.is_constant, self.is_array = op == "const", op in _ARRAYS

    @property
    def length(self) -> int:
        """The number of entries of an array."""
        if self.op in ("column", "stored"):
            return self.data.length
        return len(self.inputs) if self.op == "array" else self.data

    def equals(self, value: float) -> bool:
        """True if it is a constant of this value."""
        return self.op == "const" and bool(self.data == value)


class Block:
    """Operations in order, inside a loop or a branch of the block `parent`.

    Attributes:
        parent: the surrounding block; None for that of the whole program.
        items: numbers, loops and branches, in the order in which they are computed.
        floor: the outermost block to which its operations may move: not out of a branch, even if they depend on nothing
            inside, which is `pinned`.
        tested: True if its operations must not move to its parent, the head of a loop whose body it is: the head is
            also computed after the last iteration, when an index is out of bounds.
        by_operation: its numbers by operation, operands, type and data.
    """

    def __init__(self, parent: Block | None = None, pinned: bool = False, tested: bool = False):
        self.parent, self.tested = parent, tested
        self.depth: int = 0 if parent is None else parent.depth + 1
        self.floor: Block = self if pinned or parent is None else parent.floor
        self.items: list[Value | Loop | Branch | Map] = []
        self.by_operation: dict[object, Value] = {}


class Loop:
    """`while test(carry): carry = following(carry)`.

    Attributes:
        carries: the carried numbers inside the loop.
        starts, following: their values before the loop, and after one iteration.
        head, test: the block that computes the condition of the loop, and the condition, a boolean.
        body: the block of one iteration, inside `head`.
        results: the carried numbers after the loop.
        blocks: the head and the body.
    """

    def __init__(self, parent: Block, starts: Sequence[Value]):
        self.starts = list(starts)
        self.head = Block(parent)
        self.body = Block(self.head, tested=True)
        self.blocks = self.head, self.body
        self.carries = [_carried(x, "carry", self.head) for x in starts]
        self.results = [_carried(x, "result", parent) for x in starts]
        self.test: Value
        self.following: list[Value] = []


def _carried(start: Value, op: str, block: Block) -> Value:
    """A number, or an array of the same length, that a loop carries."""
    name, length = (f"{op} array", start.length) if start.is_array else (op, None)
    return Value(name, (), start.dtype, length, block)


class Branch:
    """One of two blocks, by a boolean.

    Attributes:
        test: the boolean.
        blocks: the block for true, and the block for false.
        values: the results of either block.
        results: the results of the chosen block, after the branch.
    """

    def __init__(self, parent: Block, test: Value):
        self.test = test
        self.blocks = (Block(parent, pinned=True), Block(parent, pinned=True))
        self.values: list[list[Value]] = []
        self.results: list[Value] = []


class Map:
    """`row[index] = values` for each index below `length`, in any order, or several at once.

    Attributes:
        length: the number of rows.
        body: the block of one row.
        index: its number, an int64.
        values: the numbers of one row.
        results: for each of them, the array of all rows.
        blocks: the body.
    """

    def __init__(self, parent: Block, length: int):
        self.length, self.body = length, Block(parent)
        self.blocks = (self.body,)
        self.index = Value("index", (), np.dtype(np.int64), None, self.body)
        self.values: list[Value] = []
        self.results: list[Value] = []


Item = Value | Loop | Branch | Map


class Builder:
    """Adds operations to a program, in the block `block`."""

    def __init__(self) -> None:
        self.root = self.block = Block()
        self._constants: dict[object, Value] = {}
        self._order: dict[Value, int] = {}
        self._entries: dict[Value, list[Value]] = {}
        self.length = self.stacked = 0  # operations; rows of arrays that loops write

    def constant(self, value: ArrayLike, dtype: DTypeLike | None = None) -> Value:
        """A constant."""
        value = np.asarray(value, dtype)[()]
        key = (value.dtype, value.tobytes())
        if key not in self._constants:
            self._constants[key] = self._new("const", (), value.dtype, value, None)
        return self._constants[key]

    def argument(self, dtype: DTypeLike, data: Data) -> Value:
        """An argument of the program, or entries of one as an array, if `data` are a `Column`."""
        return self._new("column" if isinstance(data, Column) else "argument", (), dtype, data, self.root)

    def result_column(self, array: Value, column: Column, before: Value | None) -> Value:
        """An array as entries of a result; for what is carried, `before` are those of the argument."""
        inputs = (array,) if before is None else (array, before)
        return self._new("stored", inputs, array.dtype, column, self.root)

    def empty(self, length: int, dtype: DTypeLike) -> Value:
        """A new array in memory, of which one loop writes each entry."""
        found = self._new("empty", (), dtype, length, self.block.floor)
        self.block.floor.items.append(found)
        return found

    def entries(self, array: Value) -> list[Value]:
        """All entries of an array, in the block where it is: what is not used is not read."""
        if array not in self._entries:
            block: Any = array.block
            indices = map(self.constant, np.arange(array.length))
            made = [self._new("entry", (k, array), array.dtype, None, block) for k in indices]
            block.items += made
            self._entries[array] = made
        return self._entries[array]

    def number(self, op: str, *inputs: Value, dtype: DTypeLike | None = None, data: Data = None) -> Value:
        """The result of an operation."""
        kind = np.dtype(bool if op in COMPARISONS else inputs[0].dtype if dtype is None else dtype)
        if all(x.is_constant for x in inputs):
            folded = _fold(op, [x.data for x in inputs], kind)
            if folded is not None:
                return self.constant(folded, kind)
        simpler = self._simplify(op, inputs, kind)
        if simpler is not None:
            return simpler
        if op in COMMUTATIVE and self._order[inputs[0]] > self._order[inputs[1]]:
            inputs = inputs[::-1]
        block = self.block.floor
        for x in inputs:
            if x.block is not None and x.block.depth > block.depth:
                block = x.block
        inner = self._inside(block)
        block = inner if inner.tested else block
        key = (op, inputs, kind, data)
        surrounding: Block | None = block
        while surrounding is not None:
            if key in surrounding.by_operation:
                return surrounding.by_operation[key]
            surrounding = surrounding.parent
        found = block.by_operation[key] = self._new(op, inputs, kind, data, block)
        block.items.append(found)
        self.length += op != "entry"  # of these most are not used
        return found

    def loop(
        self,
        starts: Sequence[Value],
        test: Callable[[list[Value]], Value],
        following: Callable[[list[Value]], list[Value]],
    ) -> list[Value]:
        """Add a loop, and return the carried numbers after it."""
        outside = self.block
        made = Loop(outside, starts)
        for x in (*made.carries, *made.results):
            self._order[x] = len(self._order)
        self.block = made.head
        made.test = test(made.carries)
        self.block = made.body
        made.following = following(made.carries)
        self.block = outside
        outside.items.append(made)
        return made.results

    def branch(self, test: Value, sides: tuple[Callable[[], list[Value]], Callable[[], list[Value]]]) -> list[Value]:
        """Add a branch: the results of the first side if `test`, else those of the second."""
        if test.is_constant:
            return sides[0 if test.data else 1]()
        outside = self.block
        made = Branch(outside, test)
        for block, side in zip(made.blocks, sides, strict=True):
            self.block = block
            made.values.append(side())
        self.block = outside
        for x in made.values[0]:
            made.results.append(self._new("result", (), x.dtype, made, outside))
        outside.items.append(made)
        return made.results

    def map(self, length: int, values: Callable[[Value], list[Value]], whole: bool = False) -> list[Value]:
        """Add a map: for each number of a row, the array of all rows.

        If all rows have the same number, it is this number, unless the `whole` array is wanted.
        """
        outside = self.block
        made = Map(outside, length)
        self._order[made.index] = len(self._order)
        self.block = made.body
        found = values(made.index)
        self.block = outside
        inside = [x for x in found if whole or (x.block is not None and x.block.depth > outside.depth)]
        made.values = list(dict.fromkeys(inside))
        made.results = [self._new("rows", (), x.dtype, length, outside) for x in made.values]
        outside.items.append(made)
        rows = dict(zip(made.values, made.results, strict=True))
        return [rows.get(x, x) for x in found]

    def _inside(self, block: Block) -> Block:
        """The child of `block` that is or contains the current block; `block` itself if it is the current one."""
        inner = self.block
        while inner is not block and inner.parent is not None and inner.parent is not block:
            inner = inner.parent
        return inner

    def _new(self, op: str, inputs: tuple[Value, ...], dtype: DTypeLike, data: Data, block: Block | None) -> Value:
        found = Value(op, inputs, np.dtype(dtype), data, block)
        self._order[found] = len(self._order)
        return found

    def _simplify(self, op: str, inputs: tuple[Value, ...], dtype: np.dtype) -> Value | None:
        """A simpler number that is equal, or None. 0·x and 0/x may be NaN; as for XLA, x ± 0 is x, also if x is −0."""
        whole = dtype.kind in "iu"
        match op, *inputs:
            case "add", x, y:
                for a, b in ((x, y), (y, x)):
                    if a.equals(0):
                        return b
                    if a.op == "neg":
                        return self.number("sub", b, a.inputs[0])
            case "sub", x, y:
                if y.equals(0):
                    return x
                if x.equals(0) and (whole or np.signbit(x.data)):
                    return self.number("neg", y)
                if y.op == "neg":
                    return self.number("add", x, y.inputs[0])
            case "mul", x, y:
                for a, b in ((x, y), (y, x)):
                    if a.equals(0) and whole:
                        return a
                    if a.equals(1):
                        return b
                    if a.equals(-1):
                        return self.number("neg", b)
            case "div", x, y:
                if y.equals(1) or (x.equals(0) and whole):
                    return x
                if y.is_constant and dtype.kind == "f" and np.frexp(y.data)[0] in (0.5, -0.5):
                    with np.errstate(over="ignore"):
                        inverse = self.constant(1 / y.data, dtype)
                    return self.number("mul", x, inverse) if np.isfinite(inverse.data) else None
            case (("neg" | "not"), x) if x.op == op:
                return x.inputs[0]
            case "convert", x if x.dtype == dtype:
                return x
            case "select", test, yes, no if test.is_constant or yes is no:
                return yes if test.is_constant and test.data else no
            case (("and" | "or"), x, y) if dtype.kind == "b":
                for a, b in ((x, y), (y, x)):
                    if a.is_constant:
                        return b if a.data == (op == "and") else a
                return x if x is y else None
            case (("max" | "min"), x, y) if x is y:
                return x
        return None


_FOLDS: dict[str, np.ufunc] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "abs": np.abs,
    "max": np.maximum,
    "min": np.minimum,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "is_finite": np.isfinite,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.bitwise_not,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "sign": np.sign,
}


def _fold(op: str, values: list[Data], dtype: np.dtype) -> ArrayLike | None:
    """The value of an operation on constants; None if it is left to the machine."""
    with np.errstate(all="ignore"):
        if op == "convert":
            return _convert_constant(values[0], dtype)
        if op == "select":
            return values[1] if values[0] else values[2]
        if op == "div" and dtype.kind == "f":
            return np.divide(*values)
        if op in _FOLDS:
            return np.asarray(_FOLDS[op](*values), dtype)
    return None


def _convert_constant(value: Data, dtype: np.dtype) -> ArrayLike:
    """A constant of another type; real numbers saturate at the limits of integers, and NaN becomes 0."""
    if value.dtype.kind != "f" or dtype.kind not in "iu":
        return value.astype(dtype)
    least, greatest = np.iinfo(dtype).min, np.iinfo(dtype).max
    if np.isnan(value):
        return 0
    return least if value <= least else greatest if value >= greatest else int(value)


class Program:
    """A finished program.

    Attributes:
        block, outputs: its operations, and its results.
        written: numbers that it computes for another program, in addition to its results.
        given: numbers that another program has computed, which depend on no others here.
        varying_arguments: whether an argument depends on the member.
        live: the numbers on which the outputs depend.
        varying: the numbers that depend on the member.
    """

    def __init__(
        self,
        block: Block,
        outputs: Sequence[Value],
        varying_arguments: Callable[[Value], bool],
        written: Sequence[Value] = (),
        given: frozenset[Value] = frozenset(),
    ):
        self.block, self.outputs, self.written, self.given = block, list(outputs), list(written), given
        self.varying_arguments, sources = varying_arguments, _sources(block, with_tests=True)
        self.live = _reached([*outputs, *written], lambda x: () if x in given else (*x.inputs, *sources.get(x, ())))
        self.varying = self.depending_on(varying_arguments)

    def depending_on(self, arguments: Callable[[Value], bool]) -> set[Value]:
        """The numbers that depend on some of the arguments."""
        given = {x for x in self.live if x.op in ("argument", "column") and arguments(x)}
        return _varying_numbers(self.block, self.live, given)

    def depending_on_rows(self) -> tuple[set[Value], int]:
        """The numbers that differ from row to row inside of a map, and the length of the shortest map."""
        maps = [x for x in all_items(self.block) if isinstance(x, Map)]
        rows = _varying_numbers(self.block, self.live, {x.index for x in maps}, inside_only=True)
        return rows, min((x.length for x in maps), default=0)

    def needed_positions(self, numbers: Sequence[Value]) -> list[int]:
        """The positions of the numbers that must be computed: outputs depend on them, and they are not given."""
        return [k for k, x in enumerate(numbers) if x in self.live and x not in self.given]

    def pressure(self, block: Block | None = None) -> int:
        """The largest count of varying numbers that an innermost loop needs from one iteration to the next."""
        found = 0
        for item in (self.block if block is None else block).items:
            if isinstance(item, Value):
                continue
            inside = max(map(self.pressure, item.blocks))
            if isinstance(item, Map):
                inside = max(inside, _OF_MAP)
            elif isinstance(item, Loop):
                inside = inside or self._loop_pressure(item)
            found = max(found, inside)
        return found

    def _loop_pressure(self, loop: Loop) -> int:
        """The count of varying numbers that an innermost loop carries, or reads from outside."""
        items = [x for block in (loop.head, loop.body) for x in block.items if x in self.live]
        inside = {loop.head, loop.body}
        outer = {x for item in items for x in item.inputs if x.block not in inside}
        alive = (*outer, *(x for x in loop.carries if x in self.live))
        return sum(x in self.varying and not x.is_array for x in alive)


def all_items(*blocks: Block) -> Iterator[Item]:
    """The items of blocks and of all blocks inside."""
    for block in blocks:
        for item in block.items:
            yield item
            if not isinstance(item, Value):
                yield from all_items(*item.blocks)


def numbers_of(item: Item) -> Iterable[Value]:
    """All numbers to which an item refers directly."""
    if isinstance(item, Value):
        return item.inputs
    if isinstance(item, Map):
        return item.values
    if isinstance(item, Loop):
        return (*item.starts, *item.following, item.test)
    return (item.test, *item.values[0], *item.values[1])


def _varying_numbers(root: Block, live: set[Value], start: set[Value], inside_only: bool = False) -> set[Value]:
    """The live numbers that depend on some that vary; outside of maps none does if these vary `inside_only`."""
    if not start:
        return set()
    users: dict[Value, list[Value]] = {}
    inputs = ((x, x.inputs) for x in all_items(root) if isinstance(x, Value) and x in live)
    others = (x for x in _sources(root, with_tests=False).items() if not (inside_only and x[0].op == "rows"))
    for x, sources in itertools.chain(inputs, others):
        for y in sources:
            users.setdefault(y, []).append(x)
    return _reached(start, lambda x: users.get(x, ()))


def _reached(start: Iterable[Value], following: Callable[[Value], Iterable[Value]]) -> set[Value]:
    """Some numbers, and all others to which steps lead from them."""
    found, pending = set(start), list(start)
    while pending:
        for x in following(pending.pop()):
            if x not in found:
                found.add(x)
                pending.append(x)
    return found


def _sources(root: Block, with_tests: bool) -> dict[Value, tuple[Value, ...]]:
    """The numbers from which the results of loops, branches and maps come, and those that loops carry.

    What a loop carries unchanged does not depend on the test of the loop, but needs it: `with_tests`.
    """
    found: dict[Value, tuple[Value, ...]] = {}
    for item in all_items(root):
        if isinstance(item, Value):
            continue
        if isinstance(item, Map):
            found |= {after: (x,) for x, after in zip(item.values, item.results, strict=True)}
        elif isinstance(item, Branch):
            found |= {after: (item.test, *x) for after, *x in zip(item.results, *item.values, strict=True)}
        else:
            for inside, start, x, after in zip(item.carries, item.starts, item.following, item.results, strict=True):
                test = (item.test,) if with_tests or x is not inside else ()
                found |= {inside: (start, x, *test), after: (inside, *test)}
    return found
