"""Tests of the test machinery, with small test files: which tests are imported, skips on CI, the
second run of failed tests, and the mutants that tests must detect.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from mutants import ROOT, SUBJECTS, Subject, mutants_of
from needs import left_out
from schedule import in_order, not_marked_slow


@pytest.mark.parametrize(
    ("line", "markexpr", "wanted"),
    [
        ("pytestmark = pytest.mark.sim", "not (torch or sim)", True),
        ("pytestmark = [pytest.mark.vulkan, pytest.mark.slow]", "not (slow)", True),
        ("pytestmark = pytest.mark.simple", "not (torch or sim)", False),
        ("@pytest.mark.sim", "not (torch or sim)", False),
        ("pytestmark = pytest.mark.sim", "not (torch or sim) or slow", False),
        ("pytestmark = pytest.mark.sim", "slow", False),
        ("pytestmark = pytest.mark.sim", "", False),
        ("pytestmark = pytest.mark.hosts", "not (integration)", True),
        ("pytestmark = pytest.mark.hosts", "integration", False),
        ("@pytest.mark.integration", "integration", False),
        ("@pytest.mark.sim", "integration", True),
    ],
)
def test_a_file_is_not_imported_if_all_of_it_is_left_out(
    line: str, markexpr: str, wanted: bool, tmp_path: Path
) -> None:
    file = tmp_path / "test_it.py"
    file.write_text(f"import pytest\n\n{line}\n")
    assert left_out(file, markexpr) is wanted
    assert not left_out(tmp_path, markexpr)


def test_the_page_of_the_tests_lists_every_module_of_support() -> None:
    tests = Path(__file__).parent
    packages = {path.parent.name for path in (tests / "support").glob("*/__init__.py")}
    modules = {path.stem for path in (tests / "support").glob("*.py")} | packages
    page = (tests / "README.md").read_text()
    assert {
        name for name in modules if f"`{name}`" not in page and f"support/{name}.py" not in page
    } == set()


def test_what_runs_alone_is_apart_from_its_file_and_clusters_are_played_by_one_process() -> None:
    beside = [
        "tests/cluster/test_a.py::x",
        "tests/cluster/test_b.py::x[a::b]",
        "tests/test_c.py::x",
        "tests/test_d.py::x",
    ]
    alone = ["tests/cluster/test_a.py::y", "tests/test_d.py::y", "tests/test_d.py::z"]
    together: dict[str, list[str]] = {}
    for test, unit in in_order([*beside, *alone]).items():
        together.setdefault(unit, []).append(test)
    assert list(together.values()) == [beside[:2], beside[2:3], beside[3:], alone[:1], alone[1:]]


def test_tests_that_should_be_marked_slow_are_listed_with_the_time_of_all_cases() -> None:
    def report(test: str, *markers: str) -> pytest.TestReport:
        keywords = dict.fromkeys(markers, 1)
        location = ("test_a.py", 1, "a")
        return pytest.TestReport(test, location, keywords, "passed", None, "call", duration=1.5)

    cases = [report(f"test_a.py::a[{number}]") for number in range(4)]
    marked = [report(f"test_a.py::b[{number}]", "slow") for number in range(9)]
    assert not_marked_slow([*cases, *marked, report("test_a.py::c")]) == {"test_a.py::a": 6.0}


SUPPORT = Path(__file__).parent / "support"


def outcome(folder: Path, *bodies: str, strict: bool = True) -> tuple[int, str]:
    """Return exit status and output of pytest on files test_0.py, test_1.py, … with one of `bodies`
    each.
    """
    for number, body in enumerate(bodies):
        (folder / f"test_{number}.py").write_text(f"import pytest\n{body}\n")
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = gpu: needs a GPU\n")
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-rfE", "--continue-on-collection-errors"),
            *("-p", "needs", "-p", "no:cacheprovider"),
        ],
        check=False,
        cwd=folder,
        env={
            **os.environ,
            "COLUMNS": "300",
            "PYTHONPATH": str(SUPPORT),
            "VLAGENTS_FAIL_ON_SKIP": str(int(strict)),
            # Other plugins take longer to load than the test takes to run.
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
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
    """Return pytest's report for a file with each kind of skip, for one that needs a GPU, and for
    an expected failure.
    """
    gpu = "@pytest.mark.gpu\ndef test_a(): pytest.skip('no GPU')"
    expected = "@pytest.mark.xfail\ndef test_a(): assert False"
    status, said = outcome(tmp_path_factory.mktemp("skipping"), *SKIPS.values(), gpu, expected)
    assert status != 0
    return said


@pytest.mark.parametrize("how", SKIPS)
def test_a_skip_fails_and_is_told_with_its_reason(how: str, skipping: str) -> None:
    [failure] = re.findall(
        rf"^(?:FAILED|ERROR) test_{list(SKIPS).index(how)}\.py.*", skipping, re.MULTILINE
    )
    assert "unexpected skip" in failure
    assert re.search("no.reason", failure)


def test_a_skip_is_only_a_skip_without_the_variable(tmp_path: Path) -> None:
    found = [f"{SKIPS[how]}\ndef test_b(): pass" for how in ("mark", "call", "missing module")]
    status, said = outcome(tmp_path, *found, strict=False)
    assert (status, "2 passed, 3 skipped" in said) == (0, True), said


def test_a_gpu_test_may_be_skipped_and_an_expected_failure_is_no_skip(skipping: str) -> None:
    assert re.search(r"\b1 skipped, 1 xfailed", skipping), skipping


SCRIPT = Path(__file__).parent / "support" / "play_again.py"
TESTS = """
import pytest
from pathlib import Path

def fail_once(name):
    seen = Path(name)
    if not seen.exists():
        seen.touch()
        raise AssertionError('the first time')

def test_by_chance():
    fail_once('seen')

@pytest.fixture(scope='module')
def late_server():
    fail_once('started')

@pytest.mark.parametrize('number', range(20))
def test_that_needs_a_server(late_server, number):
    pass

def test_broken():
    assert not Path('broken').exists()

def test_right():
    with Path('times').open('a') as times:
        times.write('once ')
"""


def run(folder: Path, ci: str) -> tuple[int, str]:
    """Return exit status and output of the script in `folder`."""
    (folder / "test_some.py").write_text(TESTS)
    environment = {**os.environ, "CI": ci, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    done = subprocess.run(
        [sys.executable, SCRIPT, "-q"],
        check=False,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ci", "broken", "status"), [("true", False, 0), ("true", True, 1), ("", False, 1)]
)
def test_only_what_passes_the_second_time_on_ci_is_flaky(
    tmp_path: Path, ci: str, broken: bool, status: int
) -> None:
    if broken:
        (tmp_path / "broken").touch()
    got, output = run(tmp_path, ci)
    assert got == status
    for one in ("test_by_chance", "test_that_needs_a_server[19]"):
        assert (f"flaky: test_some.py::{one}" in output) == (ci == "true")
    assert "flaky: test_some.py::test_broken" not in output
    assert (tmp_path / "times").read_text() == "once "


OWN_PROCESSES = """
import os
import pytest

pytestmark = pytest.mark.own_process
held = []

def test_first():
    held.append(1)

def test_fresh():
    assert held == []

def test_wrong():
    print('its output')
    assert held == [1]

def test_that_ends_its_process():
    os._exit(3)

def test_last():
    pass
"""


def test_each_test_in_an_own_process_has_a_fresh_one_and_tells_how_it_ended(tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(OWN_PROCESSES)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = own_process: has its own\n")
    hooks = "pytest_pyfunc_call, pytest_runtest_teardown, pytest_runtestloop"
    (tmp_path / "conftest.py").write_text(f"from process_resources import {hooks}\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", "-rf"],
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(SUPPORT)},
        capture_output=True,
        text=True,
    )
    failed = re.findall(r"^FAILED test_some.py::(\w+)", done.stdout, re.MULTILINE)
    assert failed == ["test_wrong", "test_that_ends_its_process"], done.stdout
    assert "3 passed" in done.stdout
    assert "its output" in done.stdout
    assert "its process ended with 3" in done.stdout


def test_each_mutant_of_a_file_is_another_program() -> None:
    file = ROOT / "vlagents_ray/chunking/timeliness.py"
    source = file.read_bytes()
    mutants = list(mutants_of("chunking", file))
    assert len(mutants) > 10
    programs = {ast.dump(ast.parse(mutant.in_source(source))) for mutant in mutants}
    assert len(programs) == len(mutants)
    assert ast.dump(ast.parse(source)) not in programs


@pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)
def test_a_subject_of_mutants_has_sources_and_tests(subject: Subject) -> None:
    for pattern in subject.sources:
        assert list(ROOT.glob(pattern)), pattern
    for place in subject.tests:
        assert (ROOT / place).exists(), place
