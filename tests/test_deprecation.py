"""What will be removed says so in one way, with what to write instead."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import vlagents_ray
from vlagents_ray.errors import deprecated

PACKAGE = Path(vlagents_ray.__file__).parent


def old_function() -> None:
    deprecated("old_function", "call `new_function`", since="0.2")


def test_who_calls_is_warned_with_what_to_write_instead() -> None:
    with pytest.warns(
        DeprecationWarning, match=r"^old_function is deprecated since version 0\.2: call `new_function`$"
    ) as seen:
        old_function()
    assert seen[0].filename == __file__
    with pytest.warns(FutureWarning, match="remove it from the file"):
        deprecated("a setting", "remove it from the file", since="0.2", in_code=False)


def warned_otherwise() -> Iterator[str]:
    for path in PACKAGE.rglob("*.py"):
        if path == PACKAGE / "errors.py":
            continue
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("warn"):
                words = {ast.unparse(word) for word in (*call.args[1:], *(one.value for one in call.keywords))}
                if words & {"DeprecationWarning", "FutureWarning", "PendingDeprecationWarning"}:
                    yield f"{path.relative_to(PACKAGE)}:{call.lineno}"


def test_nothing_warns_of_its_end_in_another_way() -> None:
    assert list(warned_otherwise()) == []
