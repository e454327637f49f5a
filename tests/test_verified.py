"""The outcomes of the tests of model families, and their table in docs/policies/verification.md."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
import verified
from generated import page_of, verification
from readme_blocks import DOCS

from vlagents_ray.registry import entries


@pytest.mark.parametrize("family", verified.RUN_WITH)
def test_what_is_noted_is_of_tests_that_there_are(family: str) -> None:
    tests = dict(verified.marked(family))
    assert (
        {"parity", "batches", "isolation", "loading"} <= set(tests.values()) <= set(verified.WHAT)
    )
    for noted in (one["tests"] for one in verified.notes(family)):
        assert noted.keys() <= tests.keys(), (
            f"run `make verified FAMILIES={verified.RUN_WITH[family][0]}`"
        )
        assert not any("failed" in outcomes for outcomes in noted.values())
    for one in verified.notes(family):
        skipped = {name for name, outcomes in one["tests"].items() if "skipped" in outcomes}
        assert one.get("skipped", {}).keys() == skipped, "each skipped test needs a reason"


def test_each_page_of_a_family_links_to_what_is_verified_of_it() -> None:
    policies = entries("policies")
    of_families = {
        page_of(name, policies[name]) if name in policies else name for name in verified.RUN_WITH
    }
    others = {page_of(name, entry) for name, entry in policies.items() if not entry.requirements}
    pages = {page.stem: page.read_text() for page in (DOCS / "policies").glob("*.md")}
    assert of_families == set(pages) - others - {"index", "verification"}
    assert all("](verification.md)" in pages[name] for name in of_families)


def test_a_test_that_is_new_or_gone_changes_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verified, "ROOT", tmp_path.parent)
    monkeypatch.setattr(verified, "FOLDERS", [tmp_path.name])
    monkeypatch.setattr(verified, "RUN_WITH", {"pi0": ("hf", ())})
    (tmp_path / "pi0").mkdir()
    file = tmp_path / "pi0" / "test_it.py"
    file.write_text(
        '@pytest.mark.verifies("parity")\ndef test_acts_are_theirs(): ...\n\ndef test_other(): '
        "...\n"
    )
    verified.noted_in("pi0").write_text(
        json.dumps(
            {
                "python": "3.11",
                "versions": {"torch": "2"},
                "device": "a CPU",
                "tests": {"test_it.py::test_acts_are_theirs": {"passed": 2, "skipped": 1}},
                "skipped": {"test_it.py::test_acts_are_theirs": "no GPU"},
                "left_out": {"test_more.py": "no simulator"},
            }
        )
    )
    (file.parent / "test_more.py").write_text(
        '@pytest.mark.verifies("parity")\ndef test_more(): ...\n'
    )
    table = "\n".join(verification())
    assert (
        "| [`pi0`](pi0.md) | 2, 1 skipped |  |  |  |  | Python 3.11, torch 2, on a CPU |" in table
    )
    assert "- `pi0`, Python 3.11, `test_it.py`: no GPU." in table
    assert "- `pi0`, Python 3.11, `test_more.py`: no simulator." in table
    file.write_text(file.read_text().replace("acts_are_theirs", "acts_are_like_theirs"))
    newer = "- `pi0`, Python 3.11, `test_it.py`: tests that are newer than these results."
    assert newer in "\n".join(verification())


def test_outcomes_are_noted_by_family_and_test(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verified, "ROOT", tmp_path.parent)
    monkeypatch.setattr(verified, "FOLDERS", [tmp_path.name])
    (tmp_path / "pi0").mkdir()
    plugin = verified.VerifyingTests()
    conftest = ModuleType("conftest")
    conftest.__file__ = str(tmp_path / "pi0" / "conftest.py")
    conftest.LEFT_OUT = {"test_more.py": "no simulator"}  # type: ignore[attr-defined]
    plugin.pytest_plugin_registered(conftest)
    for case, when, outcome in (
        ("a", "setup", "passed"),
        ("a", "call", "passed"),
        ("b", "call", "failed"),
        ("c", "setup", "skipped"),
    ):
        report = pytest.TestReport(
            f"plugins/vlagents_ray_models/tests/families/pi0/test_it.py::test_x[{case}]",
            ("", 0, ""),
            {},
            outcome,
            ("test_it.py", 1, "Skipped: no GPU") if outcome == "skipped" else None,
            when,
            user_properties=[("verifies", True)],
        )
        plugin.pytest_runtest_logreport(report)
    plugin.pytest_sessionfinish()
    noted = json.loads(verified.noted_in("pi0").read_text())
    assert noted["tests"] == {"test_it.py::test_x": {"passed": 1, "failed": 1, "skipped": 1}}
    assert noted["skipped"] == {"test_it.py::test_x": "no GPU"}
    assert noted["left_out"] == {"test_more.py": "no simulator"}
    assert Counter(noted["versions"].keys()) == Counter(["transformers", "torch"])
