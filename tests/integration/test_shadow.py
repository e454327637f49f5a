"""A candidate beside a live policy, as users deploy it: what it sees, and that nobody who is served notices."""

from __future__ import annotations

import json
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pytest
import ray
import yaml
from eval_fakes import wait_for
from prometheus_series import scrape
from shared_ray import shared_server

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, read_deployment
from vlagents_ray.serve.launch.server import Server

ACTS = 40
ALONE, SHADOWED = "alone", "shadowed"
AGENT = "shadowed_agents:Seeded"
LIVE: dict[str, Any] = {"config": {"ms": 5.0}}
OFFSET = 0.25
TENFOLD: dict[str, Any] = {"policy": AGENT, "config": {"ms": 50.0, "offset": OFFSET}}
TRANSPORTS = ("shm", "websocket", "http", "handle")


def frames(session: int) -> list[Obs]:
    rng = np.random.default_rng(session)
    return [
        Obs({"front": rng.integers(0, 255, (64, 64, 3), np.uint8)}, 1.0, {"joints": rng.random(7, np.float32)})
        for _ in range(ACTS)
    ]


def connected(server: Server, app: str, transport: str, session: int) -> RemoteAgent:
    """A session at the start of an episode."""
    agent = RemoteAgent(f"serve://{app}" if transport == "handle" else server.apps[app], transport=transport)
    agent.reset(Obs(), "stack", seed=session)
    return agent


def played(server: Server, transport: str, session: int = 0, app: str = SHADOWED) -> bytes:
    """The actions of an episode, to the bit."""
    with connected(server, app, transport, session) as agent:
        return b"".join(agent.act(obs).action.tobytes() for obs in frames(session))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shadow")


@pytest.fixture(scope="module")
def server(shared_ray: None, tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Iterator[Server]:
    """The same live policy twice: alone, and with a candidate that takes ten times as long, for all sessions."""
    shadow = {"policy": TENFOLD, "share": 1.0, "record": str(folder)}
    apps = [
        {"name": name, "route_prefix": path, "import_path": IMPORT_PATH, "args": {"policy": AGENT, **LIVE, **more}}
        for name, path, more in ((SHADOWED, "/", {"shadow": shadow}), (ALONE, "/alone", {}))
    ]
    file = tmp_path_factory.mktemp("deployment") / "two.yaml"
    file.write_text(yaml.safe_dump({"applications": apps}))
    with shared_server(read_deployment(str(file))) as server:
        yield server


@pytest.fixture(scope="module")
def alone(server: Server) -> dict[str, bytes]:
    """What the live policy does without a candidate."""
    return {transport: played(server, transport, app=ALONE) for transport in TRANSPORTS}


def recorded(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for file in folder.glob("*.jsonl") for line in file.read_text().splitlines()]


def test_the_live_actions_are_the_same_to_the_bit(server: Server, alone: dict[str, bytes]) -> None:
    assert {transport: played(server, transport) for transport in TRANSPORTS} == alone


def test_the_live_policy_does_not_wait_for_its_candidate(server: Server) -> None:
    took: dict[str, list[float]] = {SHADOWED: [], ALONE: []}
    with connected(server, SHADOWED, "shm", 1) as shadowed, connected(server, ALONE, "shm", 1) as other:
        for obs in frames(1):
            for app, agent in ((SHADOWED, shadowed), (ALONE, other)):
                begun = time.perf_counter()
                agent.act(obs)
                took[app].append(time.perf_counter() - begun)
    assert median(took[SHADOWED]) < 1.5 * median(took[ALONE])


def test_each_comparison_is_recorded(server: Server, folder: Path) -> None:
    """The candidate is behind: what it has missed is counted; up to there, it differs by what its settings say."""
    actions = played(server, "shm", session=7)
    live = np.frombuffer(actions, np.float32).reshape(ACTS, 4, 7)

    def acts() -> list[dict[str, Any]]:
        lines = recorded(folder)
        starts = [place for place, line in enumerate(lines) if line["op"] == "reset"]
        return lines[starts[-1] + 1 :]

    wait_for(lambda: len(acts()) >= 3 and acts()[-1]["dropped"] > 0)
    complete = [line for line in acts() if line["dropped"] == 0]
    assert len(complete) >= 2
    for number, line in enumerate(complete):
        assert np.array_equal(np.float32(line["live"]["action"]), live[number])
        assert line["difference"]["rows"] == 4
        assert line["difference"]["by_joint"] == pytest.approx([OFFSET] * 7, abs=1e-4)
        assert line["difference"]["first_row"] == pytest.approx([OFFSET] * 7, abs=1e-4)
        assert line["candidate"]["timing"]["inference_ms"] >= TENFOLD["config"]["ms"]
        assert line["live"]["timing"]["inference_ms"] >= LIVE["config"]["ms"]
        assert line["live"]["policy"]["version"] == line["candidate"]["policy"]["version"] == 0
    assert [line["step"] for line in complete] == list(range(complete[0]["step"], complete[0]["step"] + len(complete)))


def series() -> dict[str, float]:
    found = [one for one in scrape() if one.tags["application"] == SHADOWED and "_bucket" not in one.name]
    return {one.key("outcome", "rows", "joint"): one.value for one in found}


def test_prometheus_reads_the_comparisons(server: Server) -> None:
    played(server, "shm")
    wanted = {
        "vlagents_shadow_observations_total outcome=compared",
        "vlagents_shadow_difference_count rows=all",
        "vlagents_shadow_difference_count rows=first",
        "vlagents_shadow_joint_difference joint=6",
        "vlagents_shadow_latency_ms_count",
        "vlagents_shadow_dropped_total",
    }
    wait_for(lambda: wanted <= series().keys())
    found = series()
    assert found["vlagents_shadow_dropped_total"] > 0
    assert found["vlagents_shadow_latency_ms_sum"] / found["vlagents_shadow_latency_ms_count"] >= 50


def test_clients_learn_of_it_and_do_not_reach_it(server: Server) -> None:
    with urllib.request.urlopen(f"{server.url}/v1/metadata", timeout=10) as answer:
        metadata = json.load(answer)
    assert metadata["shadow"] == {"policy": AGENT, "share": 1.0}


def test_a_candidate_that_dies_is_followed_again_and_the_live_policy_goes_on(
    server: Server, folder: Path, alone: dict[str, bytes]
) -> None:
    [name] = [one["name"] for one in ray.util.list_named_actors(all_namespaces=True) if "#Shadow#" in one["name"]]
    before = set(folder.glob("*.jsonl"))
    ray.kill(ray.get_actor(name, namespace="serve"))
    assert played(server, "shm") == alone["shm"]

    def compared() -> bool:
        assert played(server, "websocket") == alone["websocket"]
        return set(folder.glob("*.jsonl")) > before

    wait_for(compared)
