"""Errors about packages that are not installed name extras that this distribution has."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import tomllib

import vlagents_ray_learn
from vlagents_ray.errors import MissingDependency
from vlagents_ray.registry import pip_install
from vlagents_ray_learn.optional import optional

PACKAGE = Path(vlagents_ray_learn.__file__).parent
EXTRAS = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"][
    "optional-dependencies"
]


def named_extras() -> Iterator[str]:
    """Yield the extra of each call of `optional` in the package."""
    default = inspect.signature(optional).parameters["extra"].default
    for file in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            match node:
                case ast.Call(func=ast.Name("optional"), args=[_]):
                    yield default
                case ast.Call(func=ast.Name("optional"), args=[_, ast.Constant(str(extra))]):
                    yield extra


def test_the_extras_that_are_named_exist() -> None:
    assert set(named_extras()) == EXTRAS.keys() - {"dev"}


def test_a_missing_package_is_an_error_that_names_the_distribution_and_the_extra() -> None:
    with pytest.raises(
        MissingDependency, match=re.escape(pip_install("rollouts", "vlagents-ray-learn"))
    ):
        optional("no_such_package")
