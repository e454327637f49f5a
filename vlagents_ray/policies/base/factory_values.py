"""The values with which a Python factory makes a policy: arguments, closures, attributes and
globals. Two runs of one file may have different values.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import itertools
import json
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

from vlagents_ray.policies.base.program import Program, code_of_class, files_named, is_own_module

_LONGEST = 100  # longest number that is shown instead of its digest, characters
_NUMBERS = (bool, int, float, complex, type(None), np.number, np.bool_)


def factory_program(make: Callable[..., Any]) -> Program:
    """Return the program of a factory: its values, the files that they name, and the files of the
    modules that define the factory and its values.

    A value is shown as a number, or as a digest of all that it contains. A value that
    cannot be compared, such as a lock or an open file, differs in each process. Globals are those
    that the factory's own code names; globals of functions that it calls are not included, nor are
    globals and attributes of classes that cannot be compared.

    Args:
        make: A function, lambda, class, bound method, `functools.partial` or callable object.

    Returns:
        "factory" -> its name; "argument speed", "closure speed", "default speed", "global SPEED",
        "attribute speed" or "class attribute speed" -> value; and the files (see `code_of_class`
        and `files_named`).
    """
    values: dict[str, Any] = {}
    while isinstance(make, functools.partial):
        for number, value in enumerate(make.args):
            values.setdefault(f"argument {number}", value)
        values |= {f"argument {name}": value for name, value in make.keywords.items()}
        make = make.func

    digests = _Digests()
    values |= _values_of(make, digests)
    program: Program = {"factory": _name_of(make, digests)}
    for name, value in values.items():
        text, is_comparable = digests.text(value)
        is_global = name.startswith(("global ", "class attribute "))
        # A global may name a large folder that has nothing to do with the policy.
        named = {name.removeprefix("argument "): digests.take_paths()}
        program |= files_named(named, folders=not is_global)
        # Modules and classes often have locks and open connections, which rarely choose a policy.
        if is_comparable or not is_global:
            program[name] = text
    digests.visit(make)
    for module in sorted(digests.modules):
        program |= code_of_class(module)
    return program


def _name_of(make: Any, digests: _Digests) -> str:
    """Return the name of a factory that is no partial, with the digest of a function's code, as a
    file may have several functions of one name, such as lambdas.
    """
    if isinstance(make, MethodType):
        return f"{_name_of(make.__func__, digests)} of {type(make.__self__).__qualname__}"
    if isinstance(make, FunctionType):
        return f"{make.__module__}:{make.__qualname__} sha256:{digests.visit(make.__code__)}"
    cls = make if isinstance(make, type) else type(make)
    return f"{cls.__module__}:{cls.__qualname__}"


def _values_of(make: Any, digests: _Digests) -> dict[str, Any]:
    """Return the values of a factory that is no partial, by their names."""
    if isinstance(make, MethodType):
        values = _values_of(make.__self__, digests)
        function = make.__func__
        return values | (_of_function(function) if isinstance(function, FunctionType) else {})
    if isinstance(make, FunctionType):
        return _of_function(make)
    if isinstance(make, type):
        return _of_class(make)
    values = _of_class(type(make))
    state = digests.state(make)
    if isinstance(state, Mapping):
        return values | {f"attribute {name}": value for name, value in state.items()}
    return values | {"object": make}


def _of_function(function: FunctionType) -> dict[str, Any]:
    """Return the closure, the defaults and the globals of a function."""
    values: dict[str, Any] = {}
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=False)
    for name, cell in cells:
        try:
            values[f"closure {name}"] = cell.cell_contents
        except ValueError:  # the variable is not set yet
            values[f"closure {name}"] = None

    parameters = inspect.signature(function).parameters.values()
    for parameter in parameters:
        if parameter.default is not inspect.Parameter.empty:
            values[f"default {parameter.name}"] = parameter.default
    return values | {f"global {name}": value for name, value in _globals_of(function)}


def _of_class(cls: type) -> dict[str, Any]:
    """Return the attributes of a class and its base classes, and the values of its methods."""
    values: dict[str, Any] = {}
    for owner in reversed(cls.__mro__):
        if not is_own_module(owner.__module__):
            continue
        for name, value in vars(owner).items():
            function = value.__func__ if isinstance(value, staticmethod | classmethod) else value
            if isinstance(function, FunctionType):
                values |= _of_function(function)
            elif not name.startswith(("__", "_abc_")) and not _is_code(value):
                values[f"class attribute {name}"] = value
    return values


def _globals_of(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the globals that the code of a function names, except code."""
    for name in dict.fromkeys(itertools.chain.from_iterable(_names(function.__code__))):
        value = function.__globals__.get(name)
        if name in function.__globals__ and not _is_code(value):
            yield name, value


def _names(code: CodeType) -> Iterator[tuple[str, ...]]:
    """Yield the names in a function's code and in the functions that it defines."""
    yield code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _is_code(value: Any) -> bool:
    """Return whether a value is described by the files of its module."""
    is_descriptor = hasattr(type(value), "__get__")
    return isinstance(value, ModuleType | type | FunctionType) or is_descriptor


class _Digests:
    """Digests of values, which are equal in another process if the values are equal."""

    def __init__(self) -> None:
        self.modules: set[str] = set()  # names of the modules that define the visited values
        # (value, digest, whether it can be compared) by the id of the value, which is kept, so that
        # no other value gets its id
        self._known: dict[int, tuple[Any, str, bool]] = {}
        self._open: set[int] = set()  # ids of the values that contain the present one
        self._failures = 0  # number of visited values that cannot be compared
        self._paths: list[str] = []  # visited texts, which may be paths of files

    def text(self, value: Any) -> tuple[str, bool]:
        """Return a value for people, and whether it can be compared: a short number itself,
        otherwise its type and digest. A text may be a password, and results are published.
        """
        if isinstance(value, _NUMBERS) and len(repr(value)) <= _LONGEST:
            return repr(value), True
        text = f"{type(value).__qualname__} sha256:{self.visit(value)}"
        return text, self._known[id(value)][2]

    def take_paths(self) -> list[str]:
        """Return the texts and paths that were visited since the last call."""
        paths, self._paths = self._paths, []
        return paths

    def visit(self, value: Any) -> str:
        """Return the digest of a value, 64 hexadecimal digits."""
        if id(value) in self._open:
            return "the value contains itself"
        if id(value) in self._known:
            _, digest, is_comparable = self._known[id(value)]
            self._failures += not is_comparable
            return digest

        before = self._failures
        self._open.add(id(value))
        try:
            content = self._content(value)
        except Exception:  # noqa: BLE001 - any object may fail to describe itself
            self._failures += 1
            content = ["not comparable", secrets.token_hex(16)]  # differs in each process
        finally:
            self._open.discard(id(value))
        digest = hashlib.sha256(json.dumps(content).encode()).hexdigest()
        self._known[id(value)] = value, digest, self._failures == before
        return digest

    def state(self, value: Any) -> Any:
        """Return the attributes of an object; None if they cannot be read."""
        try:
            state, *_ = self._parts(value)
        except Exception:  # noqa: BLE001 - any object may fail to describe itself
            return None
        return state

    def _content(self, value: Any) -> list[Any]:  # noqa: PLR0911 - one branch for each type
        """Return the type and the content of a value, as JSON."""
        kind = type(value).__qualname__
        if isinstance(value, str | Path):
            self._paths.append(str(value))
        if isinstance(value, (*_NUMBERS, str, np.generic)):
            return [kind, repr(value)]
        if isinstance(value, bytes | bytearray):
            return [kind, hashlib.sha256(value).hexdigest()]
        if isinstance(value, np.ndarray) and value.dtype != object:
            digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            return [kind, value.dtype.str, list(value.shape), digest]
        if type(value) in (list, tuple):
            return [kind, *map(self.visit, value)]
        if type(value) in (set, frozenset):
            return [kind, *sorted(map(self.visit, value))]
        if type(value) is dict:
            return [
                kind,
                *sorted([self.visit(key), self.visit(item)] for key, item in value.items()),
            ]
        if isinstance(value, ModuleType):
            return [kind, value.__name__]
        if isinstance(value, type | FunctionType):
            return [kind, *self._definition(value)]
        if isinstance(value, MethodType):
            return [kind, self.visit(value.__func__), self.visit(value.__self__)]
        if isinstance(value, CodeType):
            constants = [self.visit(constant) for constant in value.co_consts]
            return [kind, value.co_code.hex(), *value.co_names, *constants]
        return [kind, *map(self.visit, self._parts(value))]

    def _definition(self, value: type | FunctionType) -> Iterable[str]:
        """Return the name of a class or a function, and what its file does not determine."""
        self.modules.add(value.__module__)
        yield f"{value.__module__}:{value.__qualname__}"
        if isinstance(value, FunctionType):
            for name, item in _of_function(value).items():
                yield f"{name}: {self.visit(item)}"
            yield self.visit(value.__code__)
        elif is_own_module(value.__module__) and not code_of_class(value.__module__):
            # A class of a notebook has no file.
            for name, item in vars(value).items():
                if isinstance(item, FunctionType):
                    yield f"{name}: {self.visit(item)}"

    def _parts(self, value: Any) -> tuple[Any, ...]:
        """Return the state, the class and all other values with which `pickle` would create an
        object again.

        Raises:
            TypeError: The object cannot be pickled. Other errors of the object are also raised.
        """
        reduced = value.__reduce_ex__(4)
        if isinstance(reduced, str):  # the name of a global of its module
            return None, type(value), reduced
        make, arguments, state, *items = (*reduced, None, None, None)[:5]
        lists = [None if item is None else list(item) for item in items]
        return state, type(value), make, arguments, *lists
