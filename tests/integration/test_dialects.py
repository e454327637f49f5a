"""Other systems' clients from PyPI against one replica with batches: each client gets its own
answers.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from peer_environment import drive, peers_python
from shared_ray import shared_server
from websockets.sync.client import connect

from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, read_deployment
from vlagents_ray.serve.launch.server import Server
from vlagents_ray_dialects.messages import openpi as openpi_codec

CALLS = 12
DIALECTS = {
    "openpi": {"mapping": "openpi-libero"},
    # The policy's rows have 7 numbers.
    "roboarena": {
        "mapping": {"preset": "roboarena", "action_gripper": {"index": 6}},
        "action_space": "joint_position",
    },
    "openvla": {},
    "vla_eval": {},
}


@pytest.fixture(scope="module")
def python() -> Path:
    return peers_python()


@pytest.fixture(scope="module")
def server(shared_ray: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve two applications of one deployment file: at the root, and under /pi."""
    args = {"policy": "served_agents:Mirror", "config": {"slow_s": 0.002}, "batch": {"max_size": 8}}
    names = {"root": ("/", DIALECTS), "pi": ("/pi", {"openpi": DIALECTS["openpi"]})}
    apps = [
        {
            "name": name,
            "route_prefix": prefix,
            "import_path": IMPORT_PATH,
            "args": {**args, "dialects": dialects},
        }
        for name, (prefix, dialects) in names.items()
    ]
    file = tmp_path_factory.mktemp("deployment") / "two.yaml"
    file.write_text(yaml.safe_dump({"applications": apps}))
    with shared_server(read_deployment(str(file))) as server:
        yield server


def websocket(server: Server, path: str = "") -> str:
    return server.url.replace("http://", "ws://") + path


def url_for(client: str, server: Server) -> str:
    if client == "openvla":
        return server.url
    return websocket(server, "/vla-eval" if client == "vla_eval" else "")


def require_own_answers(said: list[list[Any]], client: str) -> None:
    """Check that pixel, state and instruction are the sender's, and that acts are counted from 1 in
    each episode.
    """
    for one in said:
        acts = 0
        previous = None
        for sent, rows in one:
            stateless = client == "openvla"
            acts = 1 if stateless or sent["task"] != previous else acts + 1
            previous = sent["task"]
            number = 0.0 if stateless else sent["number"]
            assert [row[:4] for row in rows] == [
                [sent["pixel"], number, acts, float(previous.split()[-1])]
            ]


NAMES = {
    "openpi": "openpi-client",
    "roboarena": "RoboArena's messages",
    "openvla": "OpenVLA's `requests` and json-numpy",
    "vla_eval": "vla-eval",
}


@pytest.mark.parametrize(
    "client", [pytest.param(client, marks=pytest.mark.program(NAMES[client])) for client in NAMES]
)
def test_the_real_clients_get_their_own_answers(server: Server, python: Path, client: str) -> None:
    said = drive(python, client, url_for(client, server), 8, CALLS)
    assert [len(one) for one in said] == [CALLS] * 8
    require_own_answers(said, client)


@pytest.mark.parametrize("path", ["/openpi", "/pi", "/pi/", "/pi/openpi"])
def test_openpi_takes_a_whole_url_with_a_path(server: Server, python: Path, path: str) -> None:
    require_own_answers(drive(python, "openpi", websocket(server, path), 1, 4), "openpi")


@pytest.mark.program(NAMES["openpi"])
def test_openpis_client_reads_the_key_that_is_missing(server: Server, python: Path) -> None:
    ((said,),) = drive(python, "openpi_error", websocket(server), 1, 1)
    assert "observation/wrist_image" in said
    assert "Traceback" not in said.partition("Error in inference server:")[2]


@pytest.mark.program(NAMES["openvla"])
def test_openvlas_own_words_with_the_json_module_patched(server: Server, python: Path) -> None:
    require_own_answers(drive(python, "openvla_patched", server.url, 1, 1), "openvla")


@pytest.mark.program(NAMES["vla_eval"])
def test_vla_eval_runs_a_benchmark_by_its_own_orchestrator(server: Server, python: Path) -> None:
    ((result,),) = drive(python, "vla_eval_run", websocket(server, "/vla-eval"), 1, 3)
    assert result["server_info"]["model_server"] == "served_agents:Mirror"
    assert (result["mean_success"], result["num_errors"]) == (1.0, 0)
    assert [episode["steps"] for episode in result["tasks"][0]["episodes"]] == [7, 7, 7]


def test_pings_are_answered_while_the_policy_thinks(server: Server, tmp_path: Path) -> None:
    white = np.full((8, 8, 3), 255, np.uint8)
    obs = {
        "observation/image": white,
        "observation/wrist_image": white,
        "observation/state": np.zeros(8),
    }
    with connect(websocket(server), compression=None, ping_interval=None) as socket:
        socket.recv()
        gate = tmp_path / "gate"
        socket.send(openpi_codec.encode(obs | {"prompt": f"{gate} task 1"}))
        for _ in range(10):
            assert socket.ping().wait(60)
        with pytest.raises(TimeoutError):
            socket.recv(timeout=0)
        gate.touch()
        assert openpi_codec.decode(socket.recv(timeout=60))["actions"][0, 0] == 255


def test_all_of_them_at_once_beside_our_own(server: Server, python: Path) -> None:
    failed: list[BaseException] = []

    def run(client: str) -> None:
        try:
            require_own_answers(drive(python, client, url_for(client, server), 3, CALLS), client)
        except BaseException as error:  # noqa: BLE001 - raised below
            failed.append(error)

    threads = [threading.Thread(target=run, args=(client,)) for client in DIALECTS]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert httpx.get(f"{server.url}/healthz", timeout=60).status_code == 200
    assert (
        httpx.get(f"{server.url}/v1/metadata", timeout=60).json()["dialects"].keys()
        == DIALECTS.keys()
    )
