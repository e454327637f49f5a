from __future__ import annotations

import pytest

from benchmarks.rollouts import main


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_it_measures_both(capsys: pytest.CaptureFixture[str]) -> None:
    main("tiny", workers=2, num_envs=2, episodes=8, rounds=1, size=32)
    loop, median = capsys.readouterr().out.splitlines()[-2:]
    assert loop.startswith("loop ")
    assert median.startswith("median ")
