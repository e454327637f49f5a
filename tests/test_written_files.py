"""The files that scripts in tests/support write are up to date: the table in README,
vlagents_ray/published.json, examples/plugin and tests/surface.txt.

The public surface changes only with a visible diff.
"""

from __future__ import annotations

import pytest
import surface
import tables


def test_the_table_of_the_readme_is_up_to_date() -> None:
    text = tables.README.read_text()
    assert tables.with_table(text) == text, "run `python tests/support/tables.py`"


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
