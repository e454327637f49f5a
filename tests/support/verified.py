"""The properties that the tests of the model families verify, and the outcomes of these tests.

A test declares with `@pytest.mark.verifies("parity")` which property it verifies. `make verified`
runs `pytest --verified tests/families/FAMILY`, which records the outcomes of these tests in
`verified.json` of that folder. The site shows them in docs/policies/verification.md. The reason for
a skipped test comes from its report; the reason for an excluded file from `LEFT_OUT` of the
folder's conftest.py, {file: reason}.
"""

from __future__ import annotations

import ast
import json
import os
import platform
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlagents_ray.registry import entries

if TYPE_CHECKING:
    import pytest  # the environment that builds the site has none

ROOT = Path(__file__).parents[2]
FOLDERS = tuple(
    str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("plugins/*/tests/families"))
)
PYTHON = "3.11"  # Python of this project's own environment
# The properties, which the page explains and which are its columns.
WHAT = ("parity", "batches", "isolation", "loading", "size")
# For each family, the names of its requirements files, and the packages and checkouts whose
# versions matter.
RUN_WITH = {
    name: (" ".join(one.requirements), (*one.checkouts, *one.needs[bool(one.checkouts) :]))
    for name, one in entries("policies").items()
    if one.requirements
    if any((ROOT / folder / name).is_dir() for folder in FOLDERS)
} | {"arro": ("hf", ("transformers", "torch"))}


class VerifyingTests:
    """A pytest plugin that records the outcomes of the tests marked `verifies`, by family."""

    def __init__(self) -> None:
        self._outcomes: dict[str, dict[str, Counter[str]]] = {}
        self._skipped: dict[str, dict[str, str]] = {}  # reasons by family and test
        self._left_out: dict[str, dict[str, str]] = {}  # reasons by family and file

    def pytest_plugin_registered(self, plugin: Any) -> None:
        if left_out := getattr(plugin, "LEFT_OUT", None):  # the plugin is a conftest.py
            self._left_out[Path(plugin.__file__).parent.name] = left_out

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            if item.get_closest_marker("verifies"):
                item.user_properties.append(("verifies", True))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not dict(report.user_properties).get("verifies"):
            return
        if report.when == "call" or report.outcome != "passed":
            file, _, test = report.nodeid.partition("[")[0].partition("::")
            family = Path(file).parent.name
            name = f"{Path(file).name}::{test}"
            self._outcomes.setdefault(family, {}).setdefault(name, Counter())[report.outcome] += 1
            if report.skipped and isinstance(report.longrepr, tuple):
                self._skipped.setdefault(family, {})[name] = report.longrepr[2].removeprefix(
                    "Skipped: "
                )

    def pytest_sessionfinish(self) -> None:
        for family, tests in self._outcomes.items():
            noted = {
                **_environment(family),
                "tests": {name: dict(tests[name]) for name in sorted(tests)},
            }
            noted["skipped"] = self._skipped.get(family, {})
            noted["left_out"] = self._left_out.get(family, {})
            noted_in(family).write_text(json.dumps(noted, indent=2) + "\n")


def folder_of(family: str) -> Path:
    """Return the folder of a family's tests, in the core or in a plug-in."""
    folders = [ROOT / folder / family for folder in FOLDERS]
    return next((folder for folder in folders if _verifies(folder)), folders[0])


def _verifies(folder: Path) -> bool:
    """Return whether the folder has tests marked `verifies`; other distributions may have tests of
    the same family.
    """
    return any("pytest.mark.verifies(" in file.read_text() for file in folder.glob("test_*.py"))


def noted_in(family: str) -> Path:
    """Return the file with the outcomes of a family's tests for this Python version."""
    python = _python()
    return folder_of(family) / (
        "verified.json" if python == PYTHON else f"verified.python{python}.json"
    )


def notes(family: str) -> list[dict[str, Any]]:
    """Return the recorded outcomes of a family for each Python version in which it was tested."""
    return [
        json.loads(file.read_text()) for file in sorted(folder_of(family).glob("verified*.json"))
    ]


def marked(family: str) -> Iterator[tuple[str, str]]:
    """Yield each test of a family that is marked `verifies`, as `file::test`, and the property that
    it verifies.
    """
    for file in sorted(folder_of(family).glob("test_*.py")):
        for node in ast.parse(file.read_text()).body:
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.verifies":
                    yield f"{file.name}::{node.name}", ast.literal_eval(mark.args[0])


def _python() -> str:
    return ".".join(platform.python_version_tuple()[:2])


def installed_version(name: str) -> str:
    """Return the version of a package, or the commit of the checkout that a variable names."""
    if name.isupper():
        folder = os.environ.get(name)
        command = ["git", "-C", folder or "", "rev-parse", "--short", "HEAD"]
        done = (
            subprocess.run(command, check=False, capture_output=True, text=True) if folder else None
        )
        return "not set" if done is None else done.stdout.strip() or "of no commit"
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def _environment(family: str) -> dict[str, Any]:
    versions = {name: installed_version(name) for name in RUN_WITH[family][1]}
    torch = sys.modules.get("torch")
    device = (
        torch.cuda.get_device_name() if torch is not None and torch.cuda.is_available() else "a CPU"
    )
    return {"python": _python(), "versions": versions, "device": device}
