"""Tests that two runs see each value with which a Python factory makes a policy."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from vlagents_ray.policies.base.factory_values import factory_program

# Each way makes a factory that holds a value.
WAYS = """
import sys
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path

import numpy as np


class Policy:
    def __init__(self, speed=1.0, more=None):
        self.speed = speed


def made(speed=None):
    return Policy(speed)


def closure(value):
    return lambda: Policy(value)


def deep_closure(value):
    def make():
        def inner():
            return value
        return Policy(inner())
    return make


def default(value):
    def make(speed=value):
        return Policy(speed)
    return make


def keyword_default(value):
    def make(*, speed=value):
        return Policy(speed)
    return make


SPEED = 0


def global_of_a_function(value):
    global SPEED
    SPEED = value
    def make():
        return [Policy(SPEED) for _ in range(1)][0]
    return make


class Global(Policy):
    def act(self):
        return SPEED


def global_of_a_class(value):
    global SPEED
    SPEED = value
    return Global


class Maker:
    def __init__(self, value):
        self.value = value
    def __call__(self):
        return Policy(self.value)
    def make(self):
        return Policy(self.value)
    @classmethod
    def of_class(cls):
        return Policy(cls.speed)


class Slotted:
    __slots__ = ("value",)
    def __init__(self, value):
        self.value = value
    def __call__(self):
        return Policy(self.value)


@dataclass(frozen=True)
class Settings:
    speed: object


class Kind(Enum):
    SLOW = 1
    FAST = 2


class First(Policy):
    pass


class Second(Policy):
    pass


def first():
    return 1


def second():
    return 2


def class_attribute(value):
    Maker.speed = value
    return Maker


def attribute_of_a_base_class(value):
    Maker.speed = value
    return type("Derived", (Maker,), {"__module__": __name__})


def bound_class_method(value):
    Maker.speed = value
    return Maker.of_class


def contains_itself(value):
    held = [value]
    held.append(held)
    return partial(made, held)


def nothing_but_a_file(value):
    return partial(Policy, "weights.bin")


WAYS = {
    "positional argument": lambda value: partial(Policy, value),
    "keyword argument": lambda value: partial(Policy, speed=value),
    "partial of a partial": lambda value: partial(partial(Policy, more=2), speed=value),
    "partial of a closure": lambda value: partial(closure(value)),
    "closure": closure,
    "deep closure": deep_closure,
    "default": default,
    "keyword default": keyword_default,
    "global of a function": global_of_a_function,
    "global of a class": global_of_a_class,
    "callable object": Maker,
    "bound method": lambda value: Maker(value).make,
    "bound class method": bound_class_method,
    "object with slots": Slotted,
    "class attribute": class_attribute,
    "attribute of a base class": attribute_of_a_base_class,
    "list": lambda value: partial(Policy, [0, [value]]),
    "dict": lambda value: partial(Policy, {"b": 1, "a": value}),
    "set of texts": lambda value: partial(Policy, {"a", "b", "c", "d", f"e{value}"}),
    "array": lambda value: partial(Policy, np.full((64, 64), value)),
    "array of objects": lambda value: partial(Policy, np.array([{"a": value}], object)),
    "type of an array": lambda value: partial(Policy, np.zeros(3, "f4" if value == 1 else "f8")),
    "bytes": lambda value: partial(Policy, bytes([value]) * 1000),
    "long text": lambda value: partial(Policy, f"{value}" * 1000),
    "dataclass": lambda value: partial(Policy, Settings(value)),
    "enum": lambda value: partial(Policy, Kind(value)),
    "function": lambda value: partial(Policy, {1: first, 2: second}[value]),
    "class": lambda value: {1: First, 2: Second}[value],
    "lambda": lambda value: {1: lambda: first(), 2: lambda: second()}[value],
    "class in an argument": lambda value: partial(Policy, {1: First, 2: Second}[value]),
    "object in an object": lambda value: partial(Policy, Maker(Maker(value))),
    "value that contains itself": contains_itself,
    "file that an argument names": nothing_but_a_file,
    "file that a closure names": lambda _value: closure("weights.bin"),
    "file that an object names": lambda _value: Maker([Path("weights.bin")]),
}


if __name__ == "__main__":
    import json
    import ways
    from vlagents_ray.policies.base.factory_values import factory_program
    value = int(sys.argv[1])
    Path("weights.bin").write_text(str(value))
    programs = {}
    for name in sys.argv[2:] or ways.WAYS:
        programs[name] = factory_program(ways.WAYS[name](value))
    print(json.dumps(programs))
"""


def programs(folder: Path, value: int, seed: str) -> dict[str, dict[str, str]]:
    """Return the program of each way to hold `value`, in another process."""
    environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": str(folder)}
    command = [sys.executable, "ways.py", str(value)]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_each_value_of_a_factory_is_seen_and_is_equal_in_another_process(tmp_path: Path) -> None:
    (tmp_path / "ways.py").write_text(WAYS)
    first, again = (programs(tmp_path, 1, seed) for seed in ("1", "2"))
    other = programs(tmp_path, 2, "1")
    assert {name for name in first if first[name] != again[name]} == set()
    assert {name for name in first if first[name] == other[name]} == set()
    assert len(first) == 35


def test_a_number_is_shown_and_a_text_which_may_be_a_key_is_not() -> None:
    program = factory_program(partial(dict, speed=0.5, key="secret", more=["secret"]))
    assert program["argument speed"] == "0.5"
    assert program["argument key"].startswith("str sha256:")
    assert "secret" not in str(program)


def test_a_value_that_cannot_be_compared_differs_in_each_process_unless_it_is_a_global() -> None:
    lock = threading.Lock()
    values = [factory_program(lambda: lock)["closure lock"] for _ in range(2)]
    assert values[0] != values[1]
    assert factory_program(partial(dict, held=lock)) != factory_program(partial(dict, held=lock))
    assert "global LOCK" not in factory_program(naming_a_lock)


LOCK = threading.Lock()


def naming_a_lock() -> threading.Lock:
    return LOCK


@pytest.mark.parametrize("code", ["return 1", "return 2", "return [3 for _ in ()]"])
def test_the_code_of_a_function_without_a_file_is_seen(code: str) -> None:
    def program(text: str) -> dict[str, str]:
        namespace: dict[str, object] = {"__name__": "of_a_notebook"}
        exec(f"def act():\n    {text}", namespace)  # noqa: S102 - like a notebook's cell
        return factory_program(partial(dict, act=namespace["act"]))

    assert program(code) == program(code)
    assert program(code) != program("return 4")
