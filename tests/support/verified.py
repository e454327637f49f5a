"""What the tests of a model family verify, for the family's page: `python
tests/support/verified.py` writes all tables.

A test states with `@pytest.mark.verifies("parity")` what it verifies. `pytest --verified
tests/families/FAMILY` notes what became of these tests in `verified.json` of that folder, and `make
verified` does both. Why a test was skipped is in its report; why a file was left out is in
`LEFT_OUT` of the folder's conftest.py, {file: reason}.
"""

from __future__ import annotations

import ast
import json
import os
import platform
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.registry import entries, find_entry

ROOT = Path(__file__).parents[2]
FOLDERS = tuple(
    str(path.relative_to(ROOT)) for path in sorted(ROOT.glob("plugins/*/tests/families"))
)
PAGES = ROOT / "docs" / "policies"
PYTHON = "3.11"  # of this project's own environment
BEGIN, END = "<!-- verified: {} -->", "<!-- /verified -->"
WHAT = {
    "parity": "Actions equal those of upstream's own code.",
    "batches": "Actions are the same alone and in any batch.",
    "isolation": "Sessions in a batch do not affect each other.",
    "loading": "Invalid checkpoints are rejected.",
    "size": "The model has the published size.",
}
PLUGINS = ("arro",)  # wrappers of packages in plugins/, with a page among those of the policies
# Of each family: the names of its requirements, and the packages and checkouts whose versions
# matter.
RUN_WITH = {
    name: (" ".join(one.requirements), (*one.checkouts, *one.needs[bool(one.checkouts) :]))
    for name, one in entries("policies").items()
    if one.requirements
    if any((ROOT / folder / name).is_dir() for folder in FOLDERS)
} | {"arro": ("hf", ("transformers", "torch"))}


class VerifyingTests:
    """A pytest plugin that notes the outcomes of the tests marked `verifies`, by family."""

    def __init__(self) -> None:
        self._outcomes: dict[str, dict[str, Counter[str]]] = {}
        self._skipped: dict[str, dict[str, str]] = {}  # why, by family and test
        self._left_out: dict[str, dict[str, str]] = {}  # why, by family and file

    def pytest_plugin_registered(self, plugin: Any) -> None:
        if left_out := getattr(plugin, "LEFT_OUT", None):  # a conftest.py
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
    """The folder of a family's tests, among those of the core or of a plug-in."""
    folders = [ROOT / folder / family for folder in FOLDERS]
    return next((folder for folder in folders if _verifies(folder)), folders[0])


def _verifies(folder: Path) -> bool:
    """Return whether tests of the folder state what they verify; others of a family are of other
    distributions.
    """
    return any("pytest.mark.verifies(" in file.read_text() for file in folder.glob("test_*.py"))


def noted_in(family: str) -> Path:
    """The file with the outcomes of a family's tests in this Python."""
    python = _python()
    return folder_of(family) / (
        "verified.json" if python == PYTHON else f"verified.python{python}.json"
    )


def notes(family: str) -> list[dict[str, Any]]:
    """What is noted of a family, for each Python in which it was tested."""
    return [
        json.loads(file.read_text()) for file in sorted(folder_of(family).glob("verified*.json"))
    ]


def marked(family: str) -> Iterator[tuple[str, str]]:
    """Yield each test of a family that is marked `verifies`, as `file::test`, and what it
    verifies.
    """
    for file in sorted(folder_of(family).glob("test_*.py")):
        for node in ast.parse(file.read_text()).body:
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.verifies":
                    yield f"{file.name}::{node.name}", ast.literal_eval(mark.args[0])


def table(family: str) -> str:
    """The table of a family's page, in Markdown."""
    requirements, _ = RUN_WITH[family]
    noted = [one for one in notes(family) if one["tests"]]
    ran = (
        f"They ran with {'; and with '.join(map(_with, noted))}."
        if noted
        else "They have not run yet."
    )
    groups: dict[tuple[str, str], list[str]] = {}  # tests by what they verify and by their file
    for name, what in sorted(marked(family), key=lambda one: list(WHAT).index(one[1])):
        groups.setdefault((what, name.partition("::")[0]), []).append(name)
    rows, seen = list[str](), set[str]()
    for (what, file), names in groups.items():
        cells = [_reason_once(_result(one, names), seen) for one in noted] or ["not run"]
        rows.append(f"| {WHAT[what]} | `{file}` | {' | '.join(cells)} |")
    cases = [f"cases, Python {one['python']}" for one in noted] if len(noted) > 1 else ["cases"]
    return "\n".join(
        [
            (
                f"`make verified FAMILIES={_quoted(requirements)}` runs these tests with small "
                f"random checkpoints. {ran}"
            ),
            "",
            f"| verified | `{folder_of(family).relative_to(ROOT)}` | {' | '.join(cases)} |",
            f"|---|---{'|---' * len(cases)}|",
            *rows,
        ]
    )


def with_table(page: str, family: str) -> str:
    """The text of a family's page with its table between the markers."""
    begin = BEGIN.format(family)
    if page.count(begin) != 1:
        raise ValueError(f"{page_of(family).name}: want {begin} once, and {END} after its table")
    return re.sub(
        f"{begin}.*?{END}", lambda _: f"{begin}\n{table(family)}\n{END}", page, flags=re.DOTALL
    )


def page_of(family: str) -> Path:
    """The page that has a family's table."""
    one = find_entry("policies", family)
    name = (one.page if one else None) or family
    return PAGES / f"{name.partition('#')[0]}.md"


def main() -> None:
    for family in RUN_WITH:
        file = page_of(family)
        file.write_text(with_table(file.read_text(), family))


def _with(noted: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in noted["versions"].items())
    return f"Python {noted['python']}, {versions}, on {noted['device']}"


def _quoted(words: str) -> str:
    return f'"{words}"' if " " in words else words


def _python() -> str:
    return ".".join(platform.python_version_tuple()[:2])


def _result(noted: dict[str, Any], names: list[str]) -> str:
    """Return the summed outcomes of some tests, with the reasons why others were skipped or not
    run.
    """
    ran = [name for name in names if name in noted["tests"]]
    outcomes = sum((Counter(noted["tests"][name]) for name in ran), Counter[str]())
    said = ", ".join(f"{number} {what}" for what, number in sorted(outcomes.items()))
    if skipped := _once(
        noted["skipped"][name] for name in ran if "skipped" in noted["tests"][name]
    ):
        said = f"{said}: {skipped}"
    files = (name.partition("::")[0] for name in names if name not in ran)
    not_run = _once(
        noted.get("left_out", {}).get(file, "it is newer than these results") for file in files
    )
    return "; ".join(filter(None, (said, not_run and f"not run: {not_run}")))


def _reason_once(result: str, seen: set[str]) -> str:
    """Return a cell, without its reason if `seen`, to which it is added, has that."""
    outcome, _, reason = result.partition(": ")
    if reason in seen:
        return outcome
    seen.add(reason)
    return result


def _once(reasons: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(reasons))


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
        torch.cuda.get_device_name()
        if torch is not None and torch.cuda.is_available()
        else "a CPU, not on a GPU"
    )
    return {"python": _python(), "versions": versions, "device": device}


if __name__ == "__main__":
    main()
