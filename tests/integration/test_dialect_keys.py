"""API keys in the protocols of other systems."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import wait_for
from gr00t_client import PolicyClient
from peer_environment import drive, peers_python
from rpyc_client import Client, document

from tests.integration.conftest import serving
from vlagents_ray.serve.access.key_store import new_key
from vlagents_ray.serve.ports import free_port


def test_with_keys_on_only_who_has_one_is_served_and_a_revoked_one_is_not(
    shared_ray: None, tmp_path: Path
) -> None:
    """GR00T's protocol contains a key. vlagents' protocol does not, so it is served only if the
    deployment allows it explicitly.
    """
    file = tmp_path / "keys.json"
    key = new_key(file, "arm")
    observation = {
        "video": {"ego": np.full((1, 1, 8, 8, 3), 3, np.uint8)},
        "language": {"task": [["abc"]]},
    }
    robots, arms = free_port(), free_port()
    dialects = {
        "vlagents": {"port": robots, "without_key": True},
        "gr00t": {"port": arms},
        "openpi": {"mapping": "openpi-libero"},
    }
    with serving(
        "served_agents:Witness", dialects=dialects, access={"keys_file": str(file)}
    ) as server:
        url = server.url.replace("http://", "ws://")
        answers = [
            drive(peers_python(), "openpi_keyed", f"{url}#{shown}", 1, 1)
            for shown in (key, "wrong", "")
        ]
        # The length of "abc", and the first acts.
        assert [row[3:] for row in answers[0][0]] == [[3, 1], [3, 2]]
        assert answers[1:] == [[401], [401]]
        with Client(robots) as robot:
            assert robot.act(document(8, "x")) == [8, 0.5, 0.25, 1, 1]
        for wrong in (None, "wrong"):
            with (
                PolicyClient(arms, wrong) as client,
                pytest.raises(RuntimeError, match="unauthorized"),
            ):
                client.get_action(observation)
        with PolicyClient(arms, key) as client:
            assert client.get_action(observation)[0]["action"][0, 0].tolist() == [3, 0, -1, 3, 1]
            file.unlink()
            wait_for(lambda: _refused(lambda: client.get_action(observation)))


def _refused(ask: Callable[[], object]) -> bool:
    try:
        ask()
    except RuntimeError as error:
        return "unauthorized" in str(error)
    return False
