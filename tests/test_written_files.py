"""The files that scripts in tests/support write are up to date: the tables in the pages, and
tests/surface.txt.

The statements in README and docs/ about registered adapters come from the registry. The public
surface changes only with a visible diff.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import reference
import surface
import tables

from vlagents_ray.registry import entries, names


@pytest.mark.parametrize("file", [*tables.TABLES, "mkdocs.yml"])
def test_the_tables_are_up_to_date(file: str) -> None:
    text = (tables.ROOT / file).read_text()
    assert tables.with_tables(file, text) == text, "run `python tests/support/tables.py`"


def test_the_names_of_all_plugins_are_published() -> None:
    assert tables.PUBLISHED.read_text() == tables.published(), (
        "run `python tests/support/tables.py`"
    )


def test_the_example_of_a_plugin_is_what_the_skeleton_writes() -> None:
    expected = tables.example_plugin()
    for path, text in expected.items():
        assert path.read_text() == text, "run `python tests/support/tables.py`"
    written = {path for path in tables.PLUGIN.rglob("*") if path.is_file()}
    ignored = {
        path
        for path in written
        if not {"__pycache__", "homing.egg-info", "runs"}.isdisjoint(path.parts)
    }
    assert written - ignored == set(expected)


def test_each_policy_and_environment_has_a_page_and_each_page_one_of_them() -> None:
    for folder, registered, further in (
        ("policies", entries("policies"), tables.FURTHER_PAGES),
        ("benchmarks", entries("envs"), ()),
    ):
        named = {tables.page_of(name, entry) for name, entry in registered.items() if entry.about}
        pages = {page.stem for page in (tables.ROOT / "docs" / folder).glob("*.md")}
        assert pages - {"index"} == (named | set(further)) - {""}


def test_each_dialect_is_shown_among_the_clients_of_other_systems() -> None:
    docs = tables.ROOT / "docs"
    pages = [docs / "other_clients.md", *sorted((docs / "clients").glob("*.md"))]
    page = "\n".join(file.read_text() for file in pages)
    assert [
        name
        for name in names("dialects")
        if not re.search(rf"\b{name}:( {{|$)", page, re.MULTILINE)
    ] == []


def test_the_public_surface_is_the_one_that_was_reviewed() -> None:
    changes = list(surface.lines_that_differ(surface.FILE.read_text(), surface.surface()))
    if changes:
        pytest.fail(
            "the public surface is another one:\n"
            + "\n".join(changes)
            + "\nIf that is meant, run `python tests/support/surface.py`."
        )


def test_a_change_is_seen() -> None:
    """The comparison must detect a changed name, default and path."""
    was = surface.FILE.read_text()
    for before, after in (
        ("batch.max_size = 16", "batch.max_size = 8"),
        ("POST /v1/act", "POST /v1/acts"),
        ("vlagents_ray.RemoteAgent.act(obs)", "vlagents_ray.RemoteAgent.act(obs, now)"),
    ):
        assert before in was.splitlines()
        assert surface.lines_that_differ(was, was.replace(before, after)) == [
            f"- {before}",
            f"+ {after}",
        ]


@pytest.mark.parametrize("page", reference.pages().items(), ids=lambda page: page[0].name)
def test_a_page_of_the_reference_is_that_of_the_commands_and_settings(
    page: tuple[Path, str],
) -> None:
    file, text = page
    assert file.read_text() == text, "run `python tests/support/reference.py`"


@pytest.mark.parametrize("name", ["run_file", "deployment", "policies"])
def test_each_setting_has_a_description(name: str) -> None:
    rows = re.findall(r"^\| `.*$", (reference.FOLDER / f"{name}.md").read_text(), re.MULTILINE)
    assert rows
    assert [row for row in rows if row.endswith("|  |")] == []


def test_each_command_with_options_has_its_section() -> None:
    page = (reference.FOLDER / "cli.md").read_text()
    for path in reference.help_pages():
        assert path == "vlagents-ray" or f"\n## `{path}`\n" in page
