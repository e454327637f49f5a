"""The order in which tests are assigned to the processes of pytest-xdist, and in which units.

The slowest units begin first, so that the processes end at about the same time. `seconds.json` has
the durations of slow files by tier. A run with VLAGENTS_TEST_SECONDS=tests/support/seconds.json
records its durations there.
"""

from __future__ import annotations

import itertools
import json
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

_SECONDS = Path(__file__).parent / "seconds.json"
_LEAST_S = 8.0  # shortest duration of a file that is recorded
# A test is marked `slow` if all its cases take more than a second together. Other tests of the same
# run make them several times slower.
_SLOW_S = 4.0
# These tests simulate several hosts each. They run one at a time, since two of them would starve
# each other of CPU.
_CLUSTERS = "tests/cluster/"


def unit(nodeid: str) -> str:
    """Return the file of a test, or the folder whose files one process runs."""
    return _CLUSTERS if nodeid.startswith(_CLUSTERS) else nodeid.partition("::")[0]


def seconds(config: pytest.Config) -> Counter[str]:
    """Return the known durations of the units of a tier."""
    found: Counter[str] = Counter()
    for file, took in json.loads(_SECONDS.read_text()).get(config.option.markexpr, {}).items():
        found[unit(file)] += took
    return found


def in_order(nodeids: Sequence[str]) -> dict[str, str]:
    """Return the unit of each test, with a number that increases when another unit begins, so that
    separated parts of a unit differ.
    """
    found: dict[str, str] = {}
    number, before = 0, ""
    for nodeid in nodeids:
        number += (now := unit(nodeid)) != before
        found[nodeid], before = f"{now} {number}", now
    return found


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `--dist loadfile`, assign whole units to processes. The tests of a unit that run alone,
    after all others, form a separate part.
    """
    if config.option.dist != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class UnitScheduling(LoadFileScheduling):
        units: dict[str, str] | None = None

        def _split_scope(self, nodeid: str) -> str:
            if self.units is None:
                self.units = in_order(self.collection)
            return self.units[nodeid]

    return UnitScheduling(config, log)


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """List the tests that should be marked `slow`, where `-m` leaves such tests out. Record the
    duration of each file if VLAGENTS_TEST_SECONDS is set and several processes run tests.
    """
    reports = [
        report
        for report in itertools.chain(*terminalreporter.stats.values())
        if isinstance(report, pytest.TestReport)
    ]
    if "slow" in config.option.markexpr:
        for test, took in not_marked_slow(reports).items():
            terminalreporter.write_line(f"not marked slow: {test} took {took:.0f} s in all")
    name = os.environ.get("VLAGENTS_TEST_SECONDS")
    if name is not None and config.getoption("numprocesses", None):
        _record(reports, config.option.markexpr, Path(name))


def not_marked_slow(reports: Iterable[pytest.TestReport]) -> dict[str, float]:
    """Return the tests without the marker `slow` all cases of which took more than `_SLOW_S`
    together, and their durations in seconds, longest first.
    """
    took: Counter[str] = Counter()
    for report in reports:
        if "slow" not in report.keywords:
            took[report.nodeid.partition("[")[0]] += report.duration
    return {test: s for test, s in took.most_common() if s > _SLOW_S}


def _record(reports: Iterable[pytest.TestReport], tier: str, file: Path) -> None:
    took: Counter[str] = Counter()
    for report in reports:
        took[report.nodeid.partition("::")[0]] += report.duration
    known = json.loads(file.read_text()) if file.exists() else {}
    others = {test: s for test, s in known.get(tier, {}).items() if test not in took}
    known[tier] = others | {test: round(s, 1) for test, s in took.items() if s >= _LEAST_S}
    file.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")
