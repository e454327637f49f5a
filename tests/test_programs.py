"""The recorded outcomes of the tests of third-party programs, which the site shows in
docs/programs.md.
"""

from __future__ import annotations

import json
from pathlib import Path

import programs
import pytest
import verified
from programs import PROGRAMS

from vlagents_ray.registry import names


def test_what_is_noted_is_of_programs_that_there_are_in_the_versions_that_are_wanted_and_passed() -> (
    None
):
    noted = programs.notes()
    assert list(noted) == [name for name in PROGRAMS if name in noted]
    for name, runs in noted.items():
        for python, one in runs.items():
            assert one.get("passed", 0) > 0, f"{name}, Python {python}: run `make programs`"
            assert "failed" not in one, f"{name}, Python {python}"
    of_their_own = {name: one for name, one in PROGRAMS.items() if one.client}
    for name, program in of_their_own.items():
        assert {python: one["versions"] for python, one in noted[name].items()} == {
            program.python: programs.versions(program)
        }, f"{name}: run `make programs`"
    assert len(noted) >= 12


def test_outcomes_are_noted_by_program_and_python_beside_those_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs, "NOTED", tmp_path / "programs.json")
    programs.NOTED.write_text(
        json.dumps({"vla-eval": {"3.11": {"versions": "vla-eval 0", "passed": 1}}})
    )
    plugin = programs.RunPrograms()
    for name, outcome in (
        ("provael", "passed"),
        ("provael", "failed"),
        ("Stable-Baselines3", "skipped"),
    ):
        report = pytest.TestReport(
            f"tests/x.py::test[{name}-{outcome}]", ("", 0, ""), {}, outcome, None, "call",
            user_properties=[("program", name)],
        )  # fmt: skip
        plugin.pytest_runtest_logreport(report)
    plugin.pytest_sessionfinish()
    assert programs.notes() == {
        "vla-eval": {"3.11": {"versions": "vla-eval 0", "passed": 1}},
        "provael": {
            "3.12": {"versions": "provael 0.46.0, openpi-client 0.1.2", "passed": 1, "failed": 1}
        },
    }


CLIENTS_OF = {
    "gr00t": "GR00T",
    "lerobot": "LeRobot",
    "lerobot_remote": "LeRobot",
    "openpi": "openpi",
    "openvla": "OpenVLA",
    "roboarena": "RoboArena",
    "sglang": "SGLang",
    "vla_eval": "vla-eval",
    "vlagents": "vlagents",
    "xpolicylab": "XPolicyLab",
}


def test_each_dialect_is_named_where_its_users_look() -> None:
    assert sorted(CLIENTS_OF) == sorted(names("dialects"))
    readme, page, listed = (
        (verified.ROOT / name).read_text()
        for name in ("README.md", "docs/other_clients.md", "docs/programs.md")
    )
    clients = readme.partition("Your client still works")[2].partition("connect unchanged")[0]
    for client in CLIENTS_OF.values():
        assert client in clients
        assert client in page
    # What has a test of its own needs no other dialect.
    missing = listed.partition("## Programs that need another dialect")[2].lower()
    for program in PROGRAMS.values():
        version = programs.versions(program).partition(",")[0] if program.client else "none"
        assert f"| {version} |" not in missing


def test_each_program_is_run_by_a_test() -> None:
    clients = {one.client for one in PROGRAMS.values()} - {""}
    script = (programs.ROOT / "tests/support/program_clients.py").read_text()
    assert [name for name in clients if f"def {name}(port: int)" not in script] == []
    files = [
        *programs.ROOT.glob("tests/*/**/test_*.py"),
        *programs.ROOT.glob("plugins/*/tests/**/test_*.py"),
    ]
    texts = "".join(file.read_text() for file in files)
    marked = [name for name, one in PROGRAMS.items() if not one.client and f'"{name}"' not in texts]
    assert marked == []
