"""Frames in plasma between environment actors and a replica on their node, on a real cluster with a
small object store.
"""

from __future__ import annotations

import contextlib
import gc
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
from eval_fakes import wait_for
from plasma_env import EnvActor
from ray._private import ray_constants
from ray._private.internal_api import memory_summary
from ray._private.worker import global_worker
from readme_blocks import ENV, ROOT

from vlagents_ray import ConnectionLost, Obs, PolicyUnavailable, RemoteAgent
from vlagents_ray.client.transports import shm
from vlagents_ray.client.transports.serve_handle import PlasmaTransport
from vlagents_ray.errors import DeadlineExceeded, MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.messages import PlasmaAddress, Request
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.ray_tools.session import local_servers
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import Server, running_server

APP = "Echo"
STORE = 100 * 10**6
LIMIT = 40 * 10**6


@pytest.fixture(scope="module", autouse=True)
def served() -> Iterator[Server]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_constants, "DEFAULT_OBJECT_STORE_MAX_MEMORY_BYTES", STORE)
        document = deployment(
            "served_agents:Echo", limits={"body_bytes": LIMIT, "pixels": LIMIT // 3}
        )
        with running_server(document, num_cpus=4) as server:
            yield server


LEARNER = """
import sys

import ray
import my_env  # beside the script, as a user has it

import vlagents_ray
from vlagents_ray import Obs, RemoteAgent


@ray.remote(num_cpus=0)
class Env:
    def play(self):
        with RemoteAgent("serve://Echo", transport="plasma") as agent:
            agent.reset(my_env.obs(), "of an actor")
            act = agent.act(my_env.obs())
            return agent.transport, act.info["instruction"], act.action.tolist()


server = vlagents_ray.join(sys.argv[1], log_to_driver=False)  # others may run here
assert vlagents_ray.join(sys.argv[1]) == server
print(server.apps, *ray.get([Env.remote().play.remote() for _ in range(2)]))
with RemoteAgent("serve://Echo") as agent:
    agent.reset(my_env.obs(), "of the driver")
    print(agent.act(my_env.obs()).info["instruction"])
ray.shutdown()
"""
ENV_MODULE = """
import numpy as np
from vlagents_ray import Obs


def obs():
    return Obs({"front": np.full((8, 8, 3), 7, np.uint8)})
"""


def test_a_ray_program_of_the_user_joins_the_server_and_its_actors_act_over_plasma(
    served: Server, tmp_path: Path
) -> None:
    """The program has only its own files, and no variable of the server's process."""
    (tmp_path / "my_env.py").write_text(ENV_MODULE)
    script = tmp_path / "learner.py"
    script.write_text(LEARNER)
    ran = of_the_user(script, served.url)
    played = "('plasma', 'of an actor', [7.0])"
    assert ran.stdout.splitlines() == [f"{(APP,)} {played} {played}", "of the driver"], ran.stderr


UNCHANGED = """
import ray

ray.init("auto", log_to_driver=False)
print("Echo" in str(ray.util.list_named_actors(all_namespaces=True)))
"""


def test_a_ray_program_that_cannot_be_changed_joins_by_the_variables_of_the_docs(
    served: Server, tmp_path: Path
) -> None:
    [line] = re.findall(
        r"`(RAY_ENABLE\S+=0) (RAY_AUTH_MODE=token)`", (ROOT / "docs" / "connecting.md").read_text()
    )
    (tmp_path / "learner.py").write_text(UNCHANGED)
    [server] = [server for server in local_servers() if server.url == served.url]
    # Other clusters may run on this machine, which "auto" may find first.
    this = {"RAY_ADDRESS": server.ray_address, "RAY_AUTH_TOKEN_PATH": server.token_file}
    ran = of_the_user(
        tmp_path / "learner.py", served.url, **this, **dict(one.split("=") for one in line)
    )
    assert ran.stdout == "True\n", ran.stderr


def of_the_user(
    script: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run a user's script without the variables of the server's process."""
    environment = {
        name: value for name, value in ENV.items() if not name.startswith("RAY_") and name != MARK
    }
    return subprocess.run(
        [sys.executable, str(script), *arguments],
        cwd=script.parent,
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )


@pytest.fixture
def agent() -> Iterator[RemoteAgent]:
    with RemoteAgent(f"serve://{APP}", transport="plasma") as agent:
        agent.reset(frame(), "a task")
        yield agent


@pytest.fixture
def transport() -> Iterator[PlasmaTransport]:
    """Yield a transport that is closed even if its test fails."""
    with contextlib.closing(PlasmaTransport(APP)) as transport:
        yield transport


def frame(size: int = 8, pixel: int = 0, **info: Any) -> Obs:
    return Obs({"front": np.full((size, size, 3), pixel, np.uint8)}, info=info)


def objects() -> int:
    """Return the number of objects in the node's store."""
    found = re.search(
        r"(\d+) objects",
        memory_summary(ray.get_runtime_context().gcs_address, stats_only=True).partition(
            "Plasma memory usage"
        )[2],
    )
    assert found is not None
    return int(found[1])


def held(agent: RemoteAgent) -> tuple[int, int]:
    """Return the numbers of threads and descriptors of the replica."""
    info = agent.act(frame()).info
    return info["threads"], info["descriptors"]


def test_frames_and_replies_of_any_size(agent: RemoteAgent) -> None:
    for pixel, size in enumerate((8, 400, 1400, 8, 900)):
        for reply_bytes in (0, 60_000, 70_000, 3_000_000):
            act = agent.act(frame(size, pixel, reply_bytes=reply_bytes))
            assert act.action.tolist() == [pixel]
            assert len(act.info["big"]) == reply_bytes


def test_env_actors_keep_their_sessions_apart() -> None:
    envs = [EnvActor.remote(APP, size=size) for size in (8, 64, 224, 300)]
    pids = ray.get([env.open.remote() for env in envs])
    for pid, told in zip(pids, ray.get([env.act.remote(100) for env in envs]), strict=True):
        assert told == {f"of {pid}"}
    for env in envs:
        ray.kill(env)


def test_an_idle_connection_takes_no_cpu(agent: RemoteAgent) -> None:
    pid = agent.reset(frame())["pid"]

    def used_s() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before = used_s()
    time.sleep(1)
    assert used_s() - before < 0.5


def test_a_late_reply_is_discarded(transport: PlasmaTransport, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    transport.connect(30)
    assert transport.call([Request("reset", frame(), request_id="r")], 60)[0].error is None
    with pytest.raises(DeadlineExceeded):
        transport.call([Request("act", frame(pixel=1, gate=str(gate)), request_id="late")], 0.05)
    with pytest.raises(DeadlineExceeded):  # the channel still contains the first frame
        transport.call([Request("act", frame(pixel=2), request_id="too-soon")], 0.05)
    gate.touch()
    [reply] = transport.call([Request("act", frame(pixel=3), request_id="now")], 60)
    assert (reply.request_id, reply.act and reply.act.action.tolist()) == ("now", [3])


def test_connections_leave_nothing(agent: RemoteAgent) -> None:
    def cycle() -> None:
        with RemoteAgent(f"serve://{APP}", transport="plasma") as other:
            other.reset(frame(200), "short")
            other.act(frame(200))

    cycle()
    before = objects(), held(agent)
    for _ in range(30):
        cycle()
    # A leak would leave 30 or more. Two are resources that a process creates once when it first
    # needs them, such as the thread that polls while a batch of several sessions is slow.
    wait_for(lambda: held(agent)[1] <= before[1][1] + 2)
    wait_for(lambda: held(agent)[0] <= before[1][0] + 2)
    # Two channels exist at the same time if one client ends after the next has begun.
    wait_for(lambda: objects() <= before[0] + 1)


def test_killed_env_actors_leave_nothing(agent: RemoteAgent) -> None:
    before = objects(), held(agent)
    choose = random.Random(3)
    for storm in (False, True) * 3:
        env = EnvActor.remote(APP)
        pid = ray.get(env.open.remote())
        if storm:
            env.storm.remote()
            time.sleep(choose.uniform(0.05, 0.15))
        os.kill(pid, signal.SIGKILL)
    # A leak would leave six or more. Ray's own threads and descriptors come and go.
    wait_for(lambda: held(agent)[1] <= before[1][1] + 2)
    wait_for(lambda: held(agent)[0] <= before[1][0] + 2)
    # One channel is reused. Of three processes killed in a storm, hardly any is killed during the
    # microseconds of a write.
    wait_for(lambda: objects() <= before[0] + 2 + 2)


def test_an_env_actor_that_dies_while_it_writes_costs_its_channel_and_nothing_else(
    agent: RemoteAgent,
) -> None:
    env = EnvActor.remote(APP, size=600)  # a channel size that no other test uses
    ray.get(env.open.remote())
    lost = ray.get(env.channel.remote())
    with pytest.raises(ray.exceptions.RayActorError):
        ray.get(env.die_writing.remote())
    for pixel in range(3):
        with RemoteAgent(f"serve://{APP}", transport="plasma") as other:
            other.reset(frame(850))
            assert other._connection.transport._channel.binary() != lost  # type: ignore[attr-defined]
            assert other.act(frame(pixel=pixel)).action.tolist() == [pixel]


def test_faults_are_answered_and_harm_nobody(
    agent: RemoteAgent, transport: PlasmaTransport
) -> None:
    transport.connect(30)
    transport.call([Request("reset", frame(), request_id="r")], 60)
    connection, key = transport._open(1), transport._channel.binary()
    free = PlasmaAddress.REQUEST.pack(os.urandom(28), 0)
    for message, said in (
        (b"short", "bytes"),
        (PlasmaAddress.REQUEST.pack(key, 0), "expected a frame"),
        (free, "lease"),
    ):
        connection.send(message)
        shm.wait(transport._poller, time.monotonic() + 60)
        [reply] = transport._receive(connection)
        error = reply.error
        assert isinstance(error, MalformedMessage)
        assert said in str(error)
    assert agent.act(frame(pixel=1)).action.tolist() == [1]


def test_what_is_too_large_is_refused_and_said(agent: RemoteAgent) -> None:
    with pytest.raises(MessageTooLarge, match=str(LIMIT)):
        agent.act(frame(echo=np.zeros(2 * LIMIT + 1, np.uint8)))
    with pytest.raises(MessageTooLarge, match=f"object store has {STORE}.*object_store_memory"):
        agent.act(frame(echo=np.zeros(LIMIT - 1000, np.uint8)))
    assert agent.act(frame(pixel=9)).action.tolist() == [9]


def test_auto_takes_plasma_where_the_socket_of_shared_memory_does_not_reach(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.select.reaches", lambda _: False)
    with RemoteAgent(f"serve://{APP}") as other:
        other.reset(frame(), "x")
        assert other.transport == "plasma"
        assert other.act(frame(pixel=5)).action.tolist() == [5]


@pytest.mark.parametrize("first", [8, 3600])
def test_auto_goes_on_by_the_handle_where_the_store_has_no_room_for_a_channel(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.select.reaches", lambda _: False)
    with RemoteAgent(f"serve://{APP}") as other:
        other.reset(frame(first), "x")
        act = other.act(frame(3600, pixel=6))  # 39 MB, so the channel has 64 MB
        assert other.transport == "handle"
        assert (act.action.tolist(), act.info["instruction"]) == ([6], "x")
        assert act.info.get("resumed", False) is (first == 8)


def test_a_killed_replica_is_noticed_and_the_next_one_serves() -> None:
    """This is the last test, since it replaces the replica."""
    agent = RemoteAgent(f"serve://{APP}", transport="plasma", resume=False)
    pid = agent.reset(frame(), "before")["pid"]
    folder = Path(global_worker.node.plasma_store_socket_name).parent
    names, channel = set(folder.glob("vla*")), agent._connection.transport._channel.hex()
    # Without garbage collection, a leftover traceback of the loss would keep its objects; the
    # channel must not be among them.
    gc.disable()
    os.kill(pid, signal.SIGKILL)
    begun = time.monotonic()
    with pytest.raises(ConnectionLost):
        agent.act(frame())
    assert time.monotonic() - begun < 25, "the loss was noticed only after the time limit"

    def again() -> bool:
        try:
            return bool(agent.reset(frame(), "after")["pid"] != pid)
        except PolicyUnavailable:
            return False

    wait_for(again)
    assert agent.act(frame()).info["instruction"] == "after"
    left = set(folder.glob("vla*"))
    assert (len(names), len(left)) == (1, 1)
    assert len(names - left) == 1  # the socket of the killed replica
    wait_for(lambda: channel not in memory_summary(ray.get_runtime_context().gcs_address))
    gc.enable()
    agent.close()
