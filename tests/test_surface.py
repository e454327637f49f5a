"""What users write down changes only where a review sees it: tests/surface.txt is a copy of it."""

from __future__ import annotations

import pytest
import surface


def test_the_public_surface_is_the_one_that_was_reviewed() -> None:
    changes = list(surface.lines_that_differ(surface.FILE.read_text(), surface.surface()))
    if changes:
        pytest.fail(
            "the public surface is another one:\n"
            + "\n".join(changes)
            + "\nIf that is meant, run `python tests/support/surface.py`."
        )


def test_a_change_is_seen() -> None:
    """Of each kind: a name, a default, a path."""
    was = surface.FILE.read_text()
    for before, after in (
        ("batch.max_size = 16", "batch.max_size = 8"),
        ("POST /v1/act", "POST /v1/acts"),
        ("vlagents_ray.RemoteAgent.act(obs)", "vlagents_ray.RemoteAgent.act(obs, now)"),
    ):
        assert before in was.splitlines()
        assert surface.lines_that_differ(was, was.replace(before, after)) == [f"- {before}", f"+ {after}"]
