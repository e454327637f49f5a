"""Each dialect answers with the recorded bytes in each situation.

The bytes are in tests/golden/endpoints, the table of situations in `dialect_situations`.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from dialect_situations import DIALECTS
from endpoint_situations import (
    Endpoint,
    case_ids,
    cases,
    costs,
    require_cost,
    require_each_situation_recorded,
    require_recorded_answers,
)


@pytest.mark.slow
@pytest.mark.parametrize(("endpoint", "situation"), cases(DIALECTS), ids=case_ids(DIALECTS))
def test_the_dialect_answers_with_the_recorded_bytes(
    endpoint: Endpoint, situation: str, tmp_path: Path
) -> None:
    require_recorded_answers(endpoint, situation, tmp_path)


@pytest.mark.parametrize("endpoint", DIALECTS, ids=[endpoint.name for endpoint in DIALECTS])
def test_each_situation_of_the_dialect_is_recorded(endpoint: Endpoint) -> None:
    require_each_situation_recorded(endpoint)


@pytest.mark.slow
@pytest.mark.parametrize(("endpoint", "kind"), costs(DIALECTS))
def test_each_request_is_charged_to_the_key_exactly_once(
    endpoint: Endpoint, kind: str, tmp_path: Path
) -> None:
    require_cost(endpoint, kind, tmp_path)
