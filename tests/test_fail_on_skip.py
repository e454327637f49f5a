"""The rule that CI skips nothing but GPU tests, tried on small test files of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SUPPORT = Path(__file__).parent / "support"


def outcome(folder: Path, *bodies: str, strict: bool = True) -> tuple[int, str]:
    """Exit status and output of pytest on files that hold one of `bodies` each: test_0.py, test_1.py, …"""
    for number, body in enumerate(bodies):
        (folder / f"test_{number}.py").write_text(f"import pytest\n{body}\n")
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = gpu: needs a GPU\n")
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-rfE",
            "--continue-on-collection-errors",
            "-p",
            "needs",
            "-p",
            "no:cacheprovider",
        ],
        check=False,
        cwd=folder,
        env={
            **os.environ,
            "COLUMNS": "300",
            "PYTHONPATH": str(SUPPORT),
            "VLAGENTS_FAIL_ON_SKIP": str(int(strict)),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # other plugins take longer to load than the test to run
        },
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout


SKIPS = {
    "mark": "@pytest.mark.skip(reason='no reason')\ndef test_a(): pass",
    "call": "def test_a(): pytest.skip('no reason')",
    "condition": "@pytest.mark.skipif(True, reason='no reason')\ndef test_a(): pass",
    "fixture": "@pytest.fixture\ndef f(): pytest.skip('no reason')\ndef test_a(f): pass",
    "missing module": "pytest.importorskip('no_reason')",
    "module": "pytest.skip('no reason', allow_module_level=True)",
}


@pytest.fixture(scope="module")
def skipping(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What pytest says of a file for each kind of skip."""
    status, said = outcome(tmp_path_factory.mktemp("skipping"), *SKIPS.values())
    assert status != 0
    return said


@pytest.mark.parametrize("how", SKIPS)
def test_a_skip_fails_and_is_told_with_its_reason(how: str, skipping: str) -> None:
    [failure] = re.findall(rf"^(?:FAILED|ERROR) test_{list(SKIPS).index(how)}\.py.*", skipping, re.MULTILINE)
    assert "unexpected skip" in failure
    assert re.search("no.reason", failure)


def test_a_skip_is_only_a_skip_without_the_variable(tmp_path: Path) -> None:
    found = [f"{SKIPS[how]}\ndef test_b(): pass" for how in ("mark", "call", "missing module")]
    status, said = outcome(tmp_path, *found, strict=False)
    assert (status, "2 passed, 3 skipped" in said) == (0, True), said


def test_a_gpu_test_may_be_skipped_and_an_expected_failure_is_no_skip(tmp_path: Path) -> None:
    gpu = "@pytest.mark.gpu\ndef test_a(): pytest.skip('no GPU')"
    status, said = outcome(tmp_path, gpu, "@pytest.mark.xfail\ndef test_a(): assert False")
    assert (status, "1 skipped, 1 xfailed" in said) == (0, True), said
