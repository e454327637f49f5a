from __future__ import annotations

from pathlib import Path

import pytest
import typescript_client
from client_servers import client_servers

from benchmarks import clients
from vlagents_ray.errors import ConfigError


@pytest.mark.node
@pytest.mark.compiler
def test_all_clients_are_measured_in_turns() -> None:
    typescript_client.build()
    with client_servers() as urls:
        found = clients.measure_clients(urls["VLAGENTS_TEST_URL"], 20)
    assert [trips.name for trips in found.ours] == ["Python, websocket", "Python, http", clients.CPP, *clients.NODE]
    assert all(trips.rounds.shape == (1, 20) and trips.median > 0 for trips in found.ours)


def test_a_client_that_was_not_built_is_named_with_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "TYPESCRIPT", tmp_path)
    with pytest.raises(ConfigError, match="npm run build"):
        clients.measure_clients("http://127.0.0.1:9", 1)
