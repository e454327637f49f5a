"""Error texts that contain a value from the network: their length and the time to write them do not
depend on the value.
"""

from __future__ import annotations

import ast
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vlagents_ray
from vlagents_ray.errors import shown

PACKAGE = Path(vlagents_ray.__file__).parent
PLUGINS = PACKAGE.parent / "plugins"
FROM_THE_NETWORK = (
    *(PACKAGE / folder for folder in ("protocol", "wire", "serve", "images", "weights")),
    PLUGINS / "vlagents_ray_dialects/vlagents_ray_dialects",
    PLUGINS / "vlagents_ray_robot/vlagents_ray_robot/ros",
)
ERRORS = ("error", "full", "problem")  # names of exceptions whose texts are already bounded

ARRAY = np.random.default_rng(0).random(1000)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.binary()
    | st.just(ARRAY),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
)


def _nested(levels: int) -> object:
    value: object = 1
    for _ in range(levels):
        value = [value, value]
    return value


@given(VALUES, st.integers(1, 200))
def test_a_text_is_short(value: object, most: int) -> None:
    assert len(shown(value, most)) <= most


@pytest.mark.parametrize(
    "value",
    [
        "x" * 10**7,
        bytes(10**7),
        [ARRAY] * 10_000,
        {str(i): [ARRAY] * 100 for i in range(100_000)},
        tuple(range(10**6)),
        10**100_000,
        _nested(40),
        set(range(10**6)),
    ],
    ids=["text", "bytes", "arrays", "dict", "tuple", "integer", "nested", "set"],
)
def test_a_large_value_takes_no_time(value: object) -> None:
    begun = time.process_time()
    for _ in range(100):
        assert len(shown(value)) <= 80
    assert (time.process_time() - begun) / 100 < 2e-3  # repr takes at least 10 ms for each


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("a", "'a'"),
        (1.5, "1.5"),
        ([1, "a", None], "[1, 'a', None]"),
        ({"a": (1,)}, "{'a': (1)}"),
        (list(range(20)), "[0, 1, 2, 3, 4, 5, 6, 7, …]"),
        (ARRAY, "ndarray of shape (1000,)"),
    ],
)
def test_a_small_value_is_written_as_it_is(value: object, text: str) -> None:
    assert shown(value) == text


def _cut_after_it_was_written(path: Path) -> Iterator[int]:
    """Return lines with `str(x)[:n]`, `repr(x)[:n]` or `{x!r:.n}`, which write a whole value before
    they cut the text.
    """
    for node in ast.walk(ast.parse(path.read_text())):
        if (
            isinstance(node, ast.FormattedValue)
            and node.conversion != -1
            and isinstance(node.format_spec, ast.JoinedStr)
        ):
            if any(
                isinstance(one, ast.Constant) and str(one.value).startswith(".")
                for one in node.format_spec.values
            ):
                yield node.lineno
        elif (
            isinstance(node, ast.Subscript)
            and isinstance(node.slice, ast.Slice)
            and isinstance(node.value, ast.Call)
            and isinstance(node.value.func, ast.Name)
            and node.value.func.id in ("str", "repr")
            and ast.unparse(node.value.args[0]).rpartition(".")[2] not in ERRORS
        ):
            yield node.lineno


def test_no_value_of_the_network_is_written_before_it_is_cut(tmp_path: Path) -> None:
    assert all(folder.is_dir() for folder in FROM_THE_NETWORK)
    files = [file for folder in FROM_THE_NETWORK for file in folder.rglob("*.py")]
    assert [f"{file}:{line}" for file in files for line in _cut_after_it_was_written(file)] == []
    wrong = tmp_path / "wrong.py"
    wrong.write_text(
        'str(x)[:40]\nf"{x!r:.80}"\nrepr(x)[:3]\nf"{str(a.b)[:4]!r}"\nstr(error)[:80]\nf"{x:.3f}"\n'
    )
    assert sorted(_cut_after_it_was_written(wrong)) == [1, 2, 3, 4]
