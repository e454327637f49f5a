"""Each scenario at each endpoint: the server answers what it answered, and our encoders write what they wrote."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.golden import dialects, own_protocol
from tests.golden.scenarios import Scenario
from tests.golden.traces import TRACES, Trace, differences, read, together, write

FILES: dict[str, Callable[[], Iterable[Scenario]]] = {
    "episodes": own_protocol.episodes,
    "refusals": own_protocol.refusals,
    "streams": own_protocol.streams,
    "control_messages": own_protocol.control_messages,
    "http": own_protocol.of_http,
    "openpi": dialects.maps,
    "openvla": dialects.documents,
    "vla_eval": dialects.benchmarks,
    "gateways": dialects.gateways,
}
CASES = [(file, scenario, endpoint) for file, make in FILES.items() for scenario in make() for endpoint in scenario.at]
IDS = [f"{file}-{scenario.name}-{endpoint}" for file, scenario, endpoint in CASES]
each_case = pytest.mark.parametrize(("file", "scenario", "endpoint"), CASES, ids=IDS)


@pytest.fixture(scope="session", autouse=True)
def _recorded(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    """With --record, write all traces before they are played."""
    if pytestconfig.getoption("--record", False):
        folder = tmp_path_factory.mktemp("record")
        for file, make in FILES.items():
            write(file, together([one.trace(at).played(at, folder) for one in make() for at in one.at]))


@each_case
def test_the_server_answers_as_recorded(file: str, scenario: Scenario, endpoint: str, tmp_path: Path) -> None:
    recorded = found(file, scenario, endpoint)
    assert not (said := differences(recorded, recorded.played(endpoint, tmp_path))), f"\n{said}"


@each_case
def test_our_encoders_write_what_was_sent(file: str, scenario: Scenario, endpoint: str) -> None:
    said = differences(found(file, scenario, endpoint).sent(), scenario.trace(endpoint).sent())
    assert not said, f"\n{said}"


def test_traces_are_small() -> None:
    assert sum(file.stat().st_size for file in TRACES.glob("*.txt")) < 300_000


def found(file: str, scenario: Scenario, endpoint: str) -> Trace:
    for one in read(file):
        if one.name == scenario.name and endpoint in one.endpoints:
            return one
    raise LookupError("not recorded: python -m pytest tests/golden --record")
