"""Our encoders write what they wrote when the traces were recorded."""

from __future__ import annotations

import pytest

from tests.golden.record import FILES
from tests.golden.traces import differences, read


@pytest.mark.parametrize("file", FILES)
def test_requests_are_those_that_were_recorded(file: str) -> None:
    recorded = {(one.name, endpoint): one for one in read(file) for endpoint in one.endpoints}
    now = {(one.name, endpoint): one for one in FILES[file]() for endpoint in one.endpoints}
    assert now.keys() == recorded.keys()
    for key, one in now.items():
        assert not (said := differences(recorded[key].sent(), one.sent())), f"{key}:\n{said}"
