"""The state of the running code in git."""

from __future__ import annotations

import hashlib
import os
import subprocess
from pathlib import Path

import pytest

from vlagents_ray.ray_tools import git_state
from vlagents_ray.ray_tools.git_state import code_in, code_of


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a repository with one commit and an importable module, and empty the cache of seen
    states.
    """
    folder = tmp_path / "repository"
    folder.mkdir()
    (folder / "grasping.py").write_text("SPEED = 1\n")
    (folder / ".gitignore").write_text("installed.py\n")
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "begin")
    monkeypatch.syspath_prepend(str(folder))
    for cached in (code_in, git_state._is_tracked, git_state._code):
        cached.cache_clear()
    return folder


def git(folder: Path, *words: str) -> str:
    who = {
        f"GIT_{role}_{what}": "someone"
        for role in ("AUTHOR", "COMMITTER")
        for what in ("NAME", "EMAIL")
    }
    command = ["git", "-C", folder, *words]
    return subprocess.run(
        command, capture_output=True, text=True, check=True, env=os.environ | who
    ).stdout.strip()


def test_a_clean_checkout_is_its_commit(repository: Path) -> None:
    found = code_of("grasping:Grasping")
    assert found.to_json() == {
        "commit": git(repository, "rev-parse", "HEAD"),
        "dirty": False,
        "diff_sha256": None,
    }


def test_what_differs_from_the_commit_is_kept_with_its_digest(repository: Path) -> None:
    (repository / "grasping.py").write_text("SPEED = 2\n")
    (repository / "secrets.env").write_text("KEY=1\n")
    found = code_of("grasping")
    assert b"KEY" not in found.diff, "git does not track it"
    assert b"-SPEED = 1\n+SPEED = 2\n" in found.diff
    assert found.diff_sha256 == hashlib.sha256(found.diff).hexdigest()


def test_a_package_is_its_folder_alone_and_a_module_its_repository(repository: Path) -> None:
    package = repository / "lifting"
    package.mkdir()
    (package / "__init__.py").write_text("SPEED = 1\n")
    git(repository, "add", ".")
    git(repository, "commit", "--quiet", "--message", "add a package")
    of_the_package = git(repository, "rev-parse", "HEAD")
    (repository / "grasping.py").write_text("SPEED = 2\n")
    git(repository, "commit", "--quiet", "--all", "--message", "change a module")
    (repository / "grasping.py").write_text("SPEED = 3\n")
    state = code_of("lifting")
    assert (state.commit, state.diff_sha256) == (of_the_package, None)
    assert code_of("grasping").commit == git(repository, "rev-parse", "HEAD")
    assert b"+SPEED = 3" in code_of("lifting:Lifting").diff

    git_state._code.cache_clear()
    (package / "__init__.py").write_text("SPEED = 4\n")
    changed = code_of("lifting")
    assert changed.commit == of_the_package
    assert b"+SPEED = 4" in changed.diff
    assert b"+SPEED = 3" not in changed.diff


def test_an_installed_module_inside_a_repository_is_not_taken_for_its_code(
    repository: Path,
) -> None:
    (repository / "installed.py").write_text("")
    assert code_of("installed") is None


def test_of_a_long_difference_the_first_part_is_kept_and_the_digest_is_of_all(
    repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(git_state, "MOST_BYTES", 100)
    (repository / "grasping.py").write_text("SPEED = 3\n" * 1000)
    found = code_in(repository)
    assert len(found.diff) == 100
    assert found.diff_sha256 != hashlib.sha256(found.diff).hexdigest()


@pytest.mark.parametrize("target", ["no_such_module", "no_such.module:Class", "sys", "numpy"])
def test_of_what_git_does_not_know_nothing_is_said(
    target: str, repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert code_of(target) is None
    assert code_in(tmp_path) is None, "outside of any repository"
    monkeypatch.setenv("PATH", "")
    assert code_in(repository) is None, "without git"
