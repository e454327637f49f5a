"""The rule that CI skips nothing but GPU tests, tried on small test files of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SUPPORT = Path(__file__).parent / "support"


def outcome(tmp_path: Path, body: str, strict: bool = True) -> tuple[int, str]:
    """Exit status and summary line of pytest on a file that holds `body`."""
    (tmp_path / "test_it.py").write_text(f"import pytest\n{body}\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = gpu: needs a GPU\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "fail_on_skip", "-p", "no:cacheprovider"],
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(SUPPORT), "VLAGENTS_FAIL_ON_SKIP": str(int(strict))},
        capture_output=True,
        text=True,
    )
    summary = re.sub(r"=|in [0-9.]+s", "", done.stdout.splitlines()[-1]).strip()
    return done.returncode, summary if done.returncode == 0 else f"{summary}\n{done.stdout}"


SKIPS = {
    "mark": "@pytest.mark.skip(reason='no reason')\ndef test_a(): pass",
    "call": "def test_a(): pytest.skip('no reason')",
    "condition": "@pytest.mark.skipif(True, reason='no reason')\ndef test_a(): pass",
    "fixture": "@pytest.fixture\ndef f(): pytest.skip('no reason')\ndef test_a(f): pass",
    "missing module": "pytest.importorskip('no_reason')",
    "module": "pytest.skip('no reason', allow_module_level=True)",
}


@pytest.mark.parametrize("how", SKIPS)
def test_a_skip_fails_and_is_told_with_its_reason(how: str, tmp_path: Path) -> None:
    status, text = outcome(tmp_path, SKIPS[how])
    assert status != 0
    assert "unexpected skip" in text
    assert re.search("no.reason", text)


@pytest.mark.parametrize("how", ["mark", "call", "missing module"])
def test_a_skip_is_only_a_skip_without_the_variable(how: str, tmp_path: Path) -> None:
    status, _ = outcome(tmp_path, f"{SKIPS[how]}\ndef test_b(): pass", strict=False)
    assert status in (0, 5)  # 5: nothing was collected, as the whole file was skipped


def test_a_gpu_test_may_be_skipped(tmp_path: Path) -> None:
    assert outcome(tmp_path, "@pytest.mark.gpu\ndef test_a(): pytest.skip('no GPU')") == (0, "1 skipped")


def test_an_expected_failure_is_no_skip(tmp_path: Path) -> None:
    assert outcome(tmp_path, "@pytest.mark.xfail\ndef test_a(): assert False") == (0, "1 xfailed")
