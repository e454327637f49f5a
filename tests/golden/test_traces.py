"""The server answers what it answered when the traces were recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.golden.traces import TRACES, Trace, differences, read

FILES = sorted(file.stem for file in TRACES.glob("*.txt"))
CASES = [(file, trace, endpoint) for file in FILES for trace in read(file) for endpoint in trace.endpoints]
IDS = [f"{file}-{trace.name}-{endpoint}" for file, trace, endpoint in CASES]


@pytest.mark.parametrize(("file", "trace", "endpoint"), CASES, ids=IDS)
def test_the_server_answers_as_recorded(file: str, trace: Trace, endpoint: str, tmp_path: Path) -> None:
    assert not (said := differences(trace, trace.played(endpoint, tmp_path))), f"{file}:\n{said}"


def test_traces_are_small() -> None:
    assert sum(file.stat().st_size for file in TRACES.glob("*.txt")) < 300_000
