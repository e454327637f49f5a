"""A policy that never returns from an act: its sessions continue elsewhere, the cause is reported,
and Serve replaces the replica.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import ray
import served_agents
from eval_fakes import wait_for
from prometheus_series import scrape
from shared_ray import shared_server

from vlagents_ray import DeadlineExceeded, Obs, PolicyUnavailable, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

CALL_S, ACT_S = 5, 6  # a replica that pauses for 3 s does not count as hung
INSIDE: list[TransportName] = ["handle", "plasma"]
OUTSIDE: list[TransportName] = ["shm", "websocket", "http"]


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    limits = {"act_s": ACT_S, "warm_up_s": ACT_S}
    config = deployment("served_agents:Hanging", replicas=2, limits=limits).model_dump(
        exclude_unset=True
    )
    # A hung replica never drains. By this package's default, Serve would wait 20 s for it, and
    # check each replica three times, every 5 s.
    config["applications"][0]["deployments"] = [
        {"name": "Policy", "graceful_shutdown_timeout_s": 2, "health_check_period_s": 1}
    ]
    with shared_server(Deployment(**config)) as server:
        yield server


def hung_calls() -> list[tuple[str, float]]:
    """Return the metric of hung calls: the operation and the number of each."""
    return [
        (one.tags["op"], one.value) for one in scrape() if one.name == "vlagents_hung_calls_total"
    ]


def logged() -> str:
    """Return the logs of this Ray's workers."""
    logs = Path(ray._private.worker._global_node.get_logs_dir_path())  # type: ignore[union-attr]
    return "".join(file.read_text(errors="replace") for file in logs.glob("worker-*.err"))


def line_of(code: str) -> int:
    """Return the number of the only line of the policies' file that contains `code`."""
    [number] = [
        n
        for n, line in enumerate(Path(served_agents.__file__).read_text().splitlines(), 1)
        if code in line
    ]
    return number


def persist(agent: RemoteAgent, left: int) -> None:
    """Act until another replica than `left` answers."""
    while True:
        with suppress(DeadlineExceeded, PolicyUnavailable):
            if agent.act(Obs()).info["pid"] != left:
                return


@pytest.mark.parametrize("how", ["sleep", "lock"])
def test_its_sessions_go_on_elsewhere_the_cause_is_told_and_it_is_replaced(
    how: str, server: Server
) -> None:
    """A replica whose policy holds the GIL ("lock") cannot report anything itself: clients and
    Serve notice its silence.
    """
    made = [RemoteAgent("serve://Hanging", transport=one, timeout_s=CALL_S) for one in INSIDE * 3]
    made += [RemoteAgent(server.url, transport=one, timeout_s=CALL_S) for one in OUTSIDE * 3]
    for agent in made:
        agent.reset(Obs())
    at = {agent: agent.act(Obs()).info["pid"] for agent in made}
    first = set(at.values())
    hung = at[made[0]]
    hit = [agent for agent in made if at[agent] == hung]
    with pytest.raises(DeadlineExceeded):
        hit[0].act(Obs(info={"hang": how}))
    begun = time.monotonic()
    threads = [threading.Thread(target=persist, args=(agent, hung), daemon=True) for agent in hit]
    for thread in threads:
        thread.start()
    wait_for(lambda: not any(thread.is_alive() for thread in threads))
    print(
        f"{how}: {len(hit)} sessions were on this replica; the last acted elsewhere after "
        f"{time.monotonic() - begun:.1f} s"
    )
    if how == "sleep":
        wait_for(lambda: hung_calls() == [("act", 1.0)])
        wait_for(lambda: f"has not returned from 'act' for {ACT_S}" in logged())
        assert "threading.Event().wait()" in logged(), (
            "the log lacks the line at which the policy hangs"
        )
    else:
        place = f'served_agents.py", line {line_of("sleep(10_000)")} in act'
        wait_for(lambda: place in logged())

    def replaced() -> bool:
        with RemoteAgent(server.url, transport="http") as agent:
            return agent.reset(Obs())["pid"] not in first

    wait_for(replaced, 240)
    print(f"{how}: replaced after {time.monotonic() - begun:.1f} s")
    wait_for(lambda: not psutil.pid_exists(hung), 240)
    print(f"{how}: its process ended after {time.monotonic() - begun:.1f} s")
    for agent in made:
        agent.close()
