"""A reader of pickles with a few known structures. It reads opcodes as data: nothing is unpickled,
looked up or imported.

A pickle is a program for a stack machine, and its dangerous opcodes import and call any name in it.
This reader has no such opcode: a pair of module and name is compared, as text, with the closed
lists of its caller, whose entries represent the caller's own functions. An opcode, a name or a
shape that is not listed is rejected.

The reader supports the opcodes that Python's own pickler writes in protocol 4 and 5 for dicts,
lists, tuples, texts, numbers, numpy's arrays and data classes. `MessageLimits` bounds the number of
opcodes (`items`), the nesting (`depth`) and the texts. Bytes are not copied, so that arrays take no
memory beyond the message.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.frame_layout import Buffer, read_array
from vlagents_ray.protocol.messages import MessageLimits

_PROTOCOLS = (4, 5)
_INTEGER = 9  # maximum size of an integer, bytes
_SHOWN = 60  # maximum number of characters of a client's text in an error


class Name(NamedTuple):
    """A class or function that a pickle names."""

    module: str
    name: str


@dataclass(slots=True, eq=False)
class Record:
    """An object of a data class, of which only the name of the class and the fields are read."""

    name: Name
    fields: dict[str, Any] | None = None  # None until they are read


@dataclass(slots=True, eq=False)
class Reduced:
    """An object that a pickle creates by a call, and whose state may follow."""

    read_state: Callable[[Any], Any] | None = None
    value: Any = None  # None until its state is read


Call = Callable[[tuple[Any, ...]], "Reduced | int | float"]
"""A function that returns the value of a call in a pickle, given the arguments of the call; it
raises `MalformedMessage` for invalid arguments.
"""


class _StackValue(NamedTuple):
    """A value on the stack."""

    value: Any
    depth: int = 0  # the number of levels of containers in it
    items: int = 1  # the number of values in it


def read_pickle(
    data: Buffer,
    limits: MessageLimits,
    records: Mapping[Name, Sequence[str]],
    calls: Mapping[Name, Call | None],
) -> Any:
    """Return the object in a pickle; an object of a data class may lack some of its fields.

    Args:
        data: The pickle. Arrays of the result are views of its memory.
        limits: Limits of the number of opcodes (`items`), of nesting (`depth`) and of texts
            (`text`).
        records: The data classes that may occur, with the names of their fields.
        calls: Our replacement of each function that may occur; None for a class that may only occur
            as an argument.

    Returns:
        The object, in which an object of a data class is a `Record`.

    Raises:
        MalformedMessage: The bytes are not a pickle, or contain an opcode, name or shape that is
            not listed.
        MessageTooLarge: The pickle exceeds a limit.
    """
    return _StackMachine(data, limits, records, calls).whole()


def fields_of(value: Any, class_name: Name) -> dict[str, Any]:
    """Return the fields of an object of a data class.

    Args:
        value: The result of `read_pickle`.
        class_name: The name of the data class.

    Raises:
        MalformedMessage: The value is not an object of this class.
    """
    if not isinstance(value, Record) or value.name != class_name or value.fields is None:
        raise MalformedMessage(
            f"pickle: expected a {class_name.name} with its fields, got {_described(value)}"
        )
    return value.fields


class _StackMachine:
    """A stack machine that executes the opcodes of a pickle, without calls; its arguments are those
    of `read_pickle`.
    """

    def __init__(
        self,
        data: Buffer,
        limits: MessageLimits,
        records: Mapping[Name, Sequence[str]],
        calls: Mapping[Name, Call | None],
    ) -> None:
        self._data = memoryview(data)
        self._offset = 0  # offset of the next byte
        self._limits = limits
        self._records = records
        self._calls = calls

        self._items = 0  # the number of values that have been pushed
        self._stack: list[_StackValue] = []
        self._below: list[list[_StackValue]] = []  # the stacks below each open mark
        self._memo: list[_StackValue] = []

    def whole(self) -> Any:
        """Execute all opcodes, and return the object that remains on the stack."""
        if self.take(1)[0] != _PROTO or self.take(1)[0] not in _PROTOCOLS:
            raise MalformedMessage(
                f"pickle: expected one of protocol {_PROTOCOLS[0]} or {_PROTOCOLS[1]}, got another"
            )

        opcode = self.take(1)[0]
        while opcode != _STOP:
            self._count(1)
            execute = _OPCODES.get(opcode)
            if execute is None:
                raise MalformedMessage(f"pickle: got opcode {opcode:#04x}, which is not read here")
            execute(self)
            opcode = self.take(1)[0]

        root = _finished(self.pop())
        if self._stack or self._below or self._offset != len(self._data):
            raise MalformedMessage("pickle: more than one object in a message")
        return root

    def take(self, length: int) -> memoryview:
        """Return the next bytes of the pickle as a view."""
        end = self._offset + length
        if end > len(self._data):
            raise MalformedMessage("pickle: a message that ends too early")
        data = self._data[self._offset : end]
        self._offset = end
        return data

    def push(self, value: Any, depth: int = 0, items: int = 1) -> None:
        """Push a value, together with its levels of containers and its number of values."""
        if depth > self._limits.depth:
            raise MessageTooLarge(f"pickle: more than {self._limits.depth} levels of nesting")
        self._stack.append(_StackValue(value, depth, items))

    def pop(self) -> Any:
        """Pop the last value."""
        return self._entry().value

    def text(self, length: int) -> None:
        """Push the text in the next `length` bytes."""
        if length > self._limits.text:
            raise MessageTooLarge(
                f"pickle: expected a text of at most {self._limits.text} bytes, got {length}"
            )
        try:
            self.push(str(self.take(length), "utf-8"))
        except UnicodeDecodeError as error:
            raise MalformedMessage(f"pickle: a text that is not UTF-8 ({error.reason})") from error

    def integer(self) -> None:
        """Push a long integer."""
        length = self.take(1)[0]
        if length > _INTEGER:
            raise MessageTooLarge(
                f"pickle: expected an integer of at most {_INTEGER} bytes, got {length}"
            )
        self.push(int.from_bytes(self.take(length), "little", signed=True))

    def mark(self) -> None:
        """Begin a group of values."""
        self._below.append(self._stack)
        self._stack = []

    def remember(self) -> None:
        """Store the last value in the memo."""
        self._memo.append(self._top())

    def recall(self, index: int) -> None:
        """Push a value of the memo. A value that can still change is rejected, so that no value
        contains itself.
        """
        if index >= len(self._memo):
            raise MalformedMessage("pickle: a reference to nothing")
        entry = self._memo[index]
        value = entry.value
        is_unfinished = isinstance(value, Reduced) and value.value is None
        if is_unfinished or isinstance(value, (list, dict, Record)):
            raise MalformedMessage(
                f"pickle: a second reference to {_described(value)}; send a copy"
            )
        self._count(entry.items)
        self._stack.append(entry)

    def tuple_of(self, entries: Sequence[_StackValue]) -> None:
        """Push a tuple with the values of these entries."""
        values = tuple(_finished(entry.value) for entry in entries)
        items = 1 + sum(entry.items for entry in entries)
        self.push(values, _above(entries), items)

    def extend(self, entries: Sequence[_StackValue]) -> None:
        """Append the values of entries to the list below them."""
        self._into(list, entries).extend(_finished(entry.value) for entry in entries)

    def update(self, entries: Sequence[_StackValue]) -> None:
        """Add keys and values, which alternate in `entries`, to the dict below them."""
        keys = [entry.value for entry in entries[::2]]
        if len(entries) % 2 or not all(type(key) is str for key in keys):
            raise MalformedMessage("pickle: expected a dict with texts as keys, got other keys")
        values = [_finished(entry.value) for entry in entries[1::2]]
        self._into(dict, entries).update(zip(keys, values, strict=True))

    def last(self, number: int | None) -> list[_StackValue]:
        """Pop the last entries in order: `number` of them, or all above the last mark if None."""
        if number is not None:
            return [self._entry() for _ in range(number)][::-1]
        if not self._below:
            raise MalformedMessage("pickle: a group without its mark")
        group, self._stack = self._stack, self._below.pop()
        return group

    def name(self) -> None:
        """Replace module and name by their entry in the closed list."""
        name, module = self.pop(), self.pop()
        if not (type(module) is str and type(name) is str):
            raise MalformedMessage("pickle: a name that is no text")
        full_name = Name(module, name)
        if full_name not in self._calls and full_name not in self._records:
            raise MalformedMessage(
                f"pickle: names {module[:_SHOWN]!r} {name[:_SHOWN]!r}, which is not read here; "
                "send numbers, texts and numpy arrays of numbers"
            )
        self.push(full_name)

    def reduce(self) -> None:
        """Replace a listed function and its arguments by the result of our replacement."""
        arguments, name = self.pop(), self.pop()
        read = self._calls.get(name) if isinstance(name, Name) else None
        if read is None or type(arguments) is not tuple:
            raise MalformedMessage(
                f"pickle: expected a numpy array of numbers, got a call of {_described(name)}"
            )
        self.push(read(arguments))

    def new(self) -> None:
        """Replace the name of a data class by an object of it without fields."""
        arguments, name = self.pop(), self.pop()
        if arguments != () or not isinstance(name, Name) or name not in self._records:
            raise MalformedMessage(
                f"pickle: expected one of LeRobot's messages, got an object of {_described(name)}"
            )
        self.push(Record(name))

    def build(self) -> None:
        """Set the fields of an object, or the state of a result, from the value above it."""
        state = self._entry()
        target = self._top().value
        if isinstance(target, Record) and target.fields is None and type(state.value) is dict:
            fields = self._records[target.name]
            if state.value.keys() != set(fields):
                field_names = shown(list(state.value))
                raise MalformedMessage(
                    f"pickle: {target.name.name}: expected {list(fields)}, got the fields "
                    f"{field_names}"
                )
            target.fields = state.value
            self._stack[-1] = _StackValue(target, state.depth + 1)
        elif isinstance(target, Reduced) and target.value is None and target.read_state is not None:
            target.value = target.read_state(state.value)
        else:
            raise MalformedMessage(f"pickle: got the state of {_described(target)}, which has none")

    def _count(self, items: int) -> None:
        """Count values; raise `MessageTooLarge` beyond the limit."""
        self._items += items
        if self._items > self._limits.items:
            raise MessageTooLarge(f"pickle: more than {self._limits.items} values in a message")

    def _top(self) -> _StackValue:
        """Return the last entry of the stack."""
        if not self._stack:
            raise MalformedMessage("pickle: an opcode without its value")
        return self._stack[-1]

    def _entry(self) -> _StackValue:
        """Pop the last entry of the stack."""
        entry = self._top()
        self._stack.pop()
        return entry

    def _into(self, container_type: type, entries: Sequence[_StackValue]) -> Any:
        """Return the container below `entries`, to which they are added."""
        container = self._entry()
        if type(container.value) is not container_type:
            raise MalformedMessage(
                f"pickle: expected a {container_type.__name__}, got {_described(container.value)}"
            )
        items = container.items + sum(entry.items for entry in entries)
        self.push(container.value, max(container.depth, _above(entries)), items)
        return container.value


def _above(entries: Sequence[_StackValue]) -> int:
    """Return the number of levels of a container with these entries."""
    return 1 + max((entry.depth for entry in entries), default=0)


def _finished(value: Any) -> Any:
    """Return a value on the stack; if it is a `Reduced`, return the object that the call
    created.
    """
    if not isinstance(value, Reduced):
        return value
    if value.value is None:
        raise MalformedMessage("pickle: an array or a type without its content")
    return value.value


def _described(value: Any) -> str:
    """Describe a value on the stack, for errors."""
    if isinstance(value, Record):
        return value.name.name
    if isinstance(value, Name):
        return f"{value.module}.{value.name}"
    return "an array" if isinstance(value, Reduced) else type(value).__name__


_PROTO, _STOP = 0x80, ord(".")
_U1 = struct.Struct("<B")
_U2 = struct.Struct("<H")
_U4 = struct.Struct("<I")
_U8 = struct.Struct("<Q")
_I4 = struct.Struct("<i")
_F8 = struct.Struct(">d")


def _number(
    form: struct.Struct, then: Callable[[_StackMachine, Any], None]
) -> Callable[[_StackMachine], None]:
    """Return a function that executes an opcode by reading a number and passing it to `then`."""
    return lambda machine: then(machine, form.unpack(machine.take(form.size))[0])


def _bytes(machine: _StackMachine, length: int) -> None:
    """Push the next bytes."""
    machine.push(machine.take(length))


def _fixed(value: Any) -> Callable[[_StackMachine], None]:
    """Return a function that executes an opcode by pushing a fixed value."""
    return lambda machine: machine.push(value)


_OPCODES: dict[int, Callable[[_StackMachine], Any]] = {
    ord("N"): _fixed(None),
    0x88: _fixed(True),
    0x89: _fixed(False),
    ord("K"): _number(_U1, _StackMachine.push),
    ord("M"): _number(_U2, _StackMachine.push),
    ord("J"): _number(_I4, _StackMachine.push),
    0x8A: _StackMachine.integer,
    ord("G"): _number(_F8, _StackMachine.push),
    0x8C: _number(_U1, _StackMachine.text),
    ord("X"): _number(_U4, _StackMachine.text),
    ord("C"): _number(_U1, _bytes),
    ord("B"): _number(_U4, _bytes),
    0x96: _number(_U8, _bytes),  # a bytearray
    ord("("): _StackMachine.mark,
    ord(")"): _fixed(()),
    0x85: lambda reader: reader.tuple_of(reader.last(1)),
    0x86: lambda reader: reader.tuple_of(reader.last(2)),
    0x87: lambda reader: reader.tuple_of(reader.last(3)),
    ord("t"): lambda reader: reader.tuple_of(reader.last(None)),
    ord("]"): lambda reader: reader.push([], 1),
    ord("a"): lambda reader: reader.extend(reader.last(1)),
    ord("e"): lambda reader: reader.extend(reader.last(None)),
    ord("}"): lambda reader: reader.push({}, 1),
    ord("s"): lambda reader: reader.update(reader.last(2)),
    ord("u"): lambda reader: reader.update(reader.last(None)),
    0x94: _StackMachine.remember,
    ord("h"): _number(_U1, _StackMachine.recall),
    ord("j"): _number(_U4, _StackMachine.recall),
    0x93: _StackMachine.name,
    ord("R"): _StackMachine.reduce,
    0x81: _StackMachine.new,
    ord("b"): _StackMachine.build,
    0x95: lambda reader: reader.take(_U8.size),  # a frame, whose length is not needed
}


# Replacements of the calls with which numpy pickles its arrays, types and numbers. They are based
# on the pickles of numpy 1.26 and 2.4 in protocol 4 and 5. Arrays of objects, text, times or
# structures, and big-endian arrays, are rejected.


class _Dtype(str):
    """The name of a plain numpy type, such as `<f4`."""

    __slots__ = ()


def _dtype(arguments: tuple[Any, ...]) -> Reduced:
    """Read `numpy.dtype`: ("f4", False, True), then (3, "<", None, None, None, -1, -1, 0)."""
    match arguments:
        case (str(code), bool() | int(), bool() | int()):
            return Reduced(lambda state: _ordered_dtype(code, state))
    raise MalformedMessage("pickle: numpy.dtype: expected the type of plain numbers, got another")


def _ordered_dtype(code: str, state: Any) -> _Dtype:
    """Return a type with the byte order that its state specifies."""
    match state:
        case (int(3), str("<") | str("|") as order, None, None, None, int(-1), int(-1), int(0)):
            return _Dtype(order + code)
    raise MalformedMessage(
        "pickle: numpy.dtype: expected the type of plain numbers in little-endian order, got "
        "another"
    )


def _array(arguments: tuple[Any, ...]) -> Reduced:
    """Read `_reconstruct`: (numpy.ndarray, (0,), b"b"), then (1, shape, dtype, is_column_major,
    data).
    """
    match arguments:
        case (Name("numpy", "ndarray"), (int(0),), memoryview() as code) if bytes(code[:2]) == b"b":
            return Reduced(_content)
    raise MalformedMessage("pickle: numpy: expected a plain array, got another")


def _content(state: Any) -> np.ndarray:
    """Return the array with the shape, type and data in its state."""
    match state:
        case (int(1), tuple(shape), _Dtype() as dtype, bool(by_columns), memoryview() as data):
            return _ordered(data, dtype, shape, by_columns)
    raise MalformedMessage(
        "pickle: numpy: expected the shape, the type of numbers and the data of an array, got "
        "others"
    )


def _frombuffer(arguments: tuple[Any, ...]) -> Reduced:
    """Read `_frombuffer`, of protocol 5: (data, dtype, shape, "C" or "F")."""
    match arguments:
        case (memoryview() as data, _Dtype() as dtype, tuple(shape), str("C") | str("F") as order):
            return Reduced(value=_ordered(data, dtype, shape, order == "F"))
    raise MalformedMessage(
        "pickle: numpy: expected an array in row-major order; send numpy.ascontiguousarray of it"
    )


def _scalar(arguments: tuple[Any, ...]) -> int | float:
    """Read `scalar`: (dtype, data)."""
    match arguments:
        case (_Dtype() as dtype, memoryview() as data):
            number: int | float = read_array(data, str(dtype), ()).item()
            return number
    raise MalformedMessage("pickle: numpy: expected a plain number, got another")


def _ordered(data: memoryview, dtype: str, shape: tuple[Any, ...], by_columns: bool) -> np.ndarray:
    """Return the array with these bytes, which are in row-major or column-major order."""
    if by_columns:
        return read_array(data, str(dtype), shape[::-1]).T
    return read_array(data, str(dtype), shape)


NUMPY_CALLS: dict[Name, Call | None] = {
    Name("numpy", "dtype"): _dtype,
    Name("numpy", "ndarray"): None,
}
for _core in ("core", "_core"):  # numpy 2.0 renamed the module
    NUMPY_CALLS[Name(f"numpy.{_core}.multiarray", "_reconstruct")] = _array
    NUMPY_CALLS[Name(f"numpy.{_core}.multiarray", "scalar")] = _scalar
    NUMPY_CALLS[Name(f"numpy.{_core}.numeric", "_frombuffer")] = _frombuffer
