"""The encoders write the same bytes as in the recorded traces, and the server gives the recorded
answers.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from dialect_situations import DIALECTS
from endpoint_situations import CORE, FOLDER

from tests.golden.record import FILES
from tests.golden.traces import TRACES, Trace, differences, read


@pytest.mark.parametrize("file", FILES)
def test_requests_are_those_that_were_recorded(file: str) -> None:
    recorded = {(one.name, endpoint): one for one in read(file) for endpoint in one.endpoints}
    now = {(one.name, endpoint): one for one in FILES[file]() for endpoint in one.endpoints}
    assert now.keys() == recorded.keys()
    for key, one in now.items():
        assert not (said := differences(recorded[key].sent(), one.sent())), f"{key}:\n{said}"


CASES = [
    (file, trace, endpoint)
    for file in FILES
    for trace in read(file)
    for endpoint in trace.endpoints
]
IDS = [f"{file}-{trace.name}-{endpoint}" for file, trace, endpoint in CASES]


@pytest.mark.slow
@pytest.mark.parametrize(("file", "trace", "endpoint"), CASES, ids=IDS)
def test_the_server_answers_as_recorded(
    file: str, trace: Trace, endpoint: str, tmp_path: Path
) -> None:
    assert not (said := differences(trace, trace.played(endpoint, tmp_path))), f"{file}:\n{said}"


def test_traces_are_small_and_of_today() -> None:
    assert {file.stem for file in TRACES.glob("*.txt")} == FILES.keys()
    assert sum(file.stat().st_size for file in TRACES.glob("*.txt")) < 300_000


def test_the_files_of_endpoints_are_small_and_of_today() -> None:
    sizes = {file.stem: file.stat().st_size for file in FOLDER.glob("*.txt")}
    assert sizes.keys() == {endpoint.name for endpoint in (*CORE, *DIALECTS)}
    assert sum(sizes.values()) < 16_660 * len(sizes)
