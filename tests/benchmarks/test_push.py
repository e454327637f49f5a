"""A push of weights, measured under sessions that act."""

from __future__ import annotations

import pytest

from benchmarks.push import measure_push


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_the_sessions_act_on_with_the_weights_of_each_push() -> None:
    rounds = measure_push(2_500_000, "float16", sessions=3, base_ms=1, rounds=2, seconds=1)
    assert [row["push"]["newest"] for row in rounds] == [1, 2]
    for row in rounds:
        assert row["push_s"] > 0
        for watched in (row["alone"], row["push"]):
            assert watched["failed"] == 0
            assert watched["monotone"]
            assert watched["longest_ms"] >= 1
