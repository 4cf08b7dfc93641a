"""Pickles of plain containers, interpreted here: nothing that a file names is imported or called.

`pickletools` splits the stream; the few instructions that torch.save writes are carried out below. A global
is looked up in the caller's table, which has a function of ours for each name.
"""

import pickletools
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import BinaryIO

from formats.errors import BadCheckpoint, FormatError, LimitExceeded, NeedsCode
from formats.foreign.stored import MAX_KEY_BITS

MAX_BYTES = 256 << 20
MAX_INSTRUCTIONS = 500_000
MAX_INTEGER_BYTES = 16
FREE_WORK = 1 << 20
WORK_PER_BYTE = 8
"""Bytes of arguments that values may be made of, for each byte of the pickle and beyond FREE_WORK: what a
pickle holds once can be an argument of many calls."""
ITEM_WORK = 16
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
EMPTY = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple}
VALUES = frozenset(
    "BININT BININT1 BININT2 LONG1 BINFLOAT BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINSTRING SHORT_BINSTRING "
    "BINBYTES SHORT_BINBYTES BINBYTES8".split()
)
TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
IGNORED = ("PROTO", "FRAME", "STOP")
Global = Callable[[tuple], object]
"""What a global makes of the arguments that it is called with in a file."""


class Named:
    """A global that stands in a pickle: its name, and what makes a value of arguments."""

    __slots__ = ("name", "make")

    def __init__(self, name: str, make: Global):
        self.name, self.make = name, make

    def __repr__(self) -> str:
        return f"the name {self.name}"


class Pending:
    """A value that is complete once the instruction BUILD gave it its state."""

    def build(self, state: object) -> None:
        raise NotImplementedError


def read_pickle(
    file: BinaryIO, end: int, known: Mapping[str, Global], persistent: Callable[[object], object]
) -> object:
    """The value of the pickle that begins where `file` stands and ends before byte `end`.

    `known` has globals by "module name", `persistent` says what a persistent id stands for. Lists and
    dictionaries may be shared; only `stored.check_plain` tells that nothing but plain values is left in them.
    Raises BadCheckpoint, NeedsCode, LimitExceeded.
    """
    machine = _Machine(known, persistent)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of unusual escapes in texts, which would be printed
            _carry_out(machine, file, end)
        (value,) = machine.stack
    except FormatError:
        raise
    except (ValueError, TypeError, LookupError, OverflowError, AttributeError) as error:
        raise BadCheckpoint(f"its pickle is damaged ({error}); copy the file again") from error
    return value


def _carry_out(machine: "_Machine", file: BinaryIO, end: int) -> None:
    start = file.tell()
    for count, (name, argument, position) in enumerate(_instructions(file, end)):
        if count == MAX_INSTRUCTIONS:
            raise LimitExceeded(f"its pickle has more than {MAX_INSTRUCTIONS:,} instructions")
        machine.do(name, argument)
        if machine.work > FREE_WORK + WORK_PER_BYTE * (position - start):
            raise LimitExceeded("its pickle makes large values of few bytes")


def _instructions(file: BinaryIO, end: int) -> Iterator[tuple[str, object, int]]:
    for code, argument, position in pickletools.genops(_Stream(file, min(end, file.tell() + MAX_BYTES))):
        yield code.name, argument, position


class _Stream:
    """A file up to a byte: no read allocates more than is there."""

    def __init__(self, file: BinaryIO, end: int):
        self._file, self._end, self.tell = file, end, file.tell

    def read(self, count: int) -> bytes:
        return self._file.read(max(0, min(count, self._end - self._file.tell())))

    def readline(self) -> bytes:
        return self._file.readline(max(0, min(1000, self._end - self._file.tell())))


class _Machine:
    """Stack and memo of a pickle that is being read."""

    def __init__(self, known: Mapping[str, Global], persistent: Callable[[object], object]):
        self.known, self.persistent = known, persistent
        self.stack: list = []
        self.marks: list[int] = []
        self.memo: dict[int, object] = {}
        self.work = 0

    def do(self, name: str, argument: object) -> None:
        """Carry out one instruction."""
        if name in VALUES:
            if type(argument) is int and argument.bit_length() > 8 * MAX_INTEGER_BYTES:
                raise LimitExceeded(f"its pickle holds an integer of {argument.bit_length():,} bits")
            self.stack.append(argument)
        elif name in CONSTANTS:
            self.stack.append(CONSTANTS[name])
        elif name in EMPTY:
            self.stack.append(EMPTY[name]())
        elif name in TUPLES:
            self.stack.append(tuple(self.taken(TUPLES[name])))
        elif name in ACTIONS:
            ACTIONS[name](self, argument)
        elif name not in IGNORED:
            raise NeedsCode(
                f"needs code to load: its pickle has the instruction {name}, which no plain checkpoint has"
            )

    def taken(self, count: int) -> list:
        """The last `count` values, off the stack."""
        start = len(self.stack) - count
        if start < (self.marks[-1] if self.marks else 0):
            raise ValueError("its stack is empty")
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def since_mark(self) -> list:
        return self.taken(len(self.stack) - self.marks.pop())

    def top(self, kind: type) -> object:
        """The last value, which has to be of a kind."""
        (value,) = self.stack[-1:]
        if type(value) is not kind:
            raise ValueError(f"a {kind.__name__} was expected, found {type(value).__name__}")
        return value

    def mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def tuple(self, _: None) -> None:
        self.stack.append(tuple(self.since_mark()))

    def append(self, _: None) -> None:
        (value,) = self.taken(1)
        self.top(list).append(value)

    def appends(self, _: None) -> None:
        values = self.since_mark()
        self.top(list).extend(values)

    def setitem(self, _: None) -> None:
        self.set_pairs(self.taken(2))

    def setitems(self, _: None) -> None:
        self.set_pairs(self.since_mark())

    def set_pairs(self, values: list) -> None:
        table = self.top(dict)
        for key, value in zip(values[::2], values[1::2], strict=True):
            set_item(table, key, value)

    def put(self, index: int) -> None:
        self.memo[index] = self.stack[-1]

    def memoize(self, _: None) -> None:
        self.put(len(self.memo))

    def get(self, index: int) -> None:
        self.stack.append(self.memo[index])

    def find(self, name: object) -> None:
        """A global, named "module name"."""
        if name not in self.known:
            shown = str(name).replace(" ", ".")[:200]
            raise NeedsCode(
                f"needs code to load: it holds {shown}, and only tensors and plain containers are read; "
                "where it was trained, save its state dict and its settings as plain values"
            )
        self.stack.append(Named(name, self.known[name]))

    def stack_global(self, _: None) -> None:
        module, name = self.taken(2)
        self.find(f"{module} {name}")

    def call(self, _: None) -> None:
        made_of, arguments = self.taken(2)
        if not isinstance(made_of, Named) or type(arguments) is not tuple:
            raise NeedsCode(f"needs code to load: its pickle calls a {type(made_of).__name__}")
        self.work += _size(arguments)
        self.stack.append(made_of.make(arguments))

    def build(self, _: None) -> None:
        (state,) = self.taken(1)
        (value,) = self.stack[-1:]
        if isinstance(value, Pending):
            self.work += _size(state)
            value.build(state)
        elif type(value) is not dict:  # what a subclass of dict keeps beside its items is not asked for
            raise NeedsCode(f"needs code to load: its pickle sets the state of a {type(value).__name__}")

    def persistent_id(self, _: None) -> None:
        (name,) = self.taken(1)
        self.stack.append(self.persistent(name))


ACTIONS = {
    "MARK": _Machine.mark,
    "TUPLE": _Machine.tuple,
    "APPEND": _Machine.append,
    "APPENDS": _Machine.appends,
    "SETITEM": _Machine.setitem,
    "SETITEMS": _Machine.setitems,
    "BINPUT": _Machine.put,
    "LONG_BINPUT": _Machine.put,
    "MEMOIZE": _Machine.memoize,
    "BINGET": _Machine.get,
    "LONG_BINGET": _Machine.get,
    "GLOBAL": _Machine.find,
    "STACK_GLOBAL": _Machine.stack_global,
    "REDUCE": _Machine.call,
    "NEWOBJ": _Machine.call,
    "BUILD": _Machine.build,
    "BINPERSID": _Machine.persistent_id,
}


def _size(arguments: object) -> int:
    """About how many bytes the values of a tuple have."""
    texts = sum(len(value) for value in arguments if isinstance(value, str | bytes))
    return texts + ITEM_WORK * sum(
        len(value) for value in arguments if isinstance(value, list | tuple | dict)
    )


def set_item(table: dict, key: object, value: object) -> None:
    """An item of a dictionary of a file: keys are texts, or integers that cannot be made to collide."""
    if type(key) is not str and not (isinstance(key, int) and key.bit_length() <= MAX_KEY_BITS):
        raise BadCheckpoint(f"its pickle has a dictionary with a key of type {type(key).__name__}")
    table[key] = value
