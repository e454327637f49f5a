"""A failed test gets a second try on CI, and there alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent / "support" / "play_again.py"
TESTS = """
from pathlib import Path

def test_by_chance():
    seen = Path('seen')
    if not seen.exists():
        seen.touch()
        raise AssertionError('the first time')

def test_broken():
    assert not Path('broken').exists()

def test_right():
    with Path('times').open('a') as times:
        times.write('once ')
"""


def run(folder: Path, ci: str) -> tuple[int, str]:
    """Exit status and output of the script in `folder`."""
    (folder / "test_some.py").write_text(TESTS)
    environment = {**os.environ, "CI": ci, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        [sys.executable, SCRIPT, "-q"], check=False, cwd=folder, env=environment, capture_output=True, text=True
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(("ci", "broken", "status"), [("true", False, 0), ("true", True, 1), ("", False, 1)])
def test_only_what_passes_the_second_time_on_ci_is_flaky(tmp_path: Path, ci: str, broken: bool, status: int) -> None:
    if broken:
        (tmp_path / "broken").touch()
    got, output = run(tmp_path, ci)
    assert got == status
    assert ("flaky: test_some.py::test_by_chance" in output) == (ci == "true")
    assert "flaky: test_some.py::test_broken" not in output
    assert (tmp_path / "times").read_text() == "once "
