"""Each endpoint of the core answers with the recorded bytes in each situation.

tests/golden/endpoints contains the bytes, and `endpoint_situations` the table of situations.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from endpoint_situations import (
    CORE,
    Endpoint,
    case_ids,
    cases,
    costs,
    require_cost,
    require_each_situation_recorded,
    require_recorded_answers,
)


@pytest.mark.slow
@pytest.mark.parametrize(("endpoint", "situation"), cases(CORE), ids=case_ids(CORE))
def test_the_endpoint_answers_with_the_recorded_bytes(
    endpoint: Endpoint, situation: str, tmp_path: Path
) -> None:
    require_recorded_answers(endpoint, situation, tmp_path)


@pytest.mark.parametrize("endpoint", CORE, ids=[endpoint.name for endpoint in CORE])
def test_each_situation_of_the_endpoint_is_recorded(endpoint: Endpoint) -> None:
    require_each_situation_recorded(endpoint)


@pytest.mark.slow
@pytest.mark.parametrize(("endpoint", "kind"), costs(CORE))
def test_each_request_is_charged_to_the_key_exactly_once(
    endpoint: Endpoint, kind: str, tmp_path: Path
) -> None:
    require_cost(endpoint, kind, tmp_path)
