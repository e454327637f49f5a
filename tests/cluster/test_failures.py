"""What is lost when machines and networks of a cluster fail: time and attempts, no episode and no result."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from long_evaluation import Evaluation, cluster_of, serving, until, workers_on

from benchmarks.hosts import Host, HostFailed, hosts, ray_cluster
from vlagents_ray.client.credentials import KEY_VARIABLE

pytestmark = [pytest.mark.hosts, pytest.mark.slow]

MEMORY = Path("/proc/meminfo")


@contextlib.contextmanager
def cut_off(host: Host, seconds: float) -> Iterator[None]:
    """A partition of that length, at least; the block runs meanwhile."""
    healed = time.monotonic() + seconds
    host.cut()
    yield
    time.sleep(max(0.0, healed - time.monotonic()))
    host.heal()


@contextlib.contextmanager
def out_of_memory(host: Host, folder: Path) -> Iterator[None]:
    """As far as Ray's memory monitor there can see."""
    fake = folder / "meminfo"
    none = re.sub(r"(?m)^(MemFree|MemAvailable|Buffers|Cached|SReclaimable):.*", r"\1: 0 kB", MEMORY.read_text())
    fake.write_text(none)
    host.run(["mount", "--bind", str(fake), str(MEMORY)])
    yield
    host.run(["umount", str(MEMORY)])


def test_lost_nodes_and_partitions_cost_attempts_alone(tmp_path: Path) -> None:
    """Two nodes with a replica and a worker each, and one with two workers."""
    episodes = 600
    run = Evaluation(tmp_path, episodes, workers=4)
    with hosts(5) as [head, one, two, simulating, spare]:
        nodes = [(one, 1, True), (two, 1, True), (simulating, 2, False)]
        with (
            cluster_of(head, nodes, run) as cluster,
            serving(head, tmp_path, replicas=2) as token,
            run.running(head, token=token),
        ):
            with cut_off(two, 3.0):
                pass
            run.goes_on()
            assert run.attempts() == [], "a short partition costs time alone"
            with cut_off(two, 20.0):
                run.goes_on()
            run.goes_on()
            simulating.kill()
            until(lambda: "the worker on host4 died" in run.said())
            run.goes_on()
            cluster.join(spare, 2)
            until(lambda: workers_on(spare) == 2)
            two.kill()
            run.goes_on()
            run.hurry.touch()
            assert run.ends() == 0, run.said()
            for host in (head, one, spare):
                until(lambda host=host: workers_on(host) == 0)
    run.is_whole(episodes)


@pytest.mark.alone
def test_a_robot_outside_of_the_cluster_keeps_its_loop_beside_an_evaluation(tmp_path: Path) -> None:
    run = Evaluation(tmp_path, episodes=1000, workers=2)
    with (
        hosts(3) as [head, one, robot],
        cluster_of(head, [(one, 2, True)], run),
        serving(head, tmp_path, replicas=1) as token,
        run.running(head, token=token),
    ):
        robot.limit("1gbit")
        robot.environment |= {KEY_VARIABLE: token}
        loop = ["--hz", "50", "--seconds", "20", "--transport", "websocket", "--safe", "hold"]
        code = "from vlagents_ray.cli import main; main()"
        command = [sys.executable, "-c", code, "robot", f"http://{head.name}:8000", *loop]
        for attempt in (1, 2, 3):  # a machine that stands still for a second spoils one
            try:
                robot.run(command)  # it fails if a tick has no action of the policy
            except HostFailed:
                if attempt == 3:
                    raise
            else:
                break
        assert run.attempts() == []
        run.goes_on()


def test_memory_that_runs_out_costs_attempts_and_a_lost_head_a_resumption(tmp_path: Path) -> None:
    """The driver runs at the node that is left, which then becomes the head of another cluster."""
    episodes = 400
    run = Evaluation(tmp_path, episodes, workers=2)
    with hosts(2) as [head, one]:
        with cluster_of(head, [(one, 2, False)], run, RAY_gcs_rpc_server_reconnect_timeout_s="20"):
            with run.running(one):
                with out_of_memory(one, tmp_path):
                    until(lambda: any("low on memory" in attempt.error for attempt in run.attempts()))
                run.goes_on(by=4)
                head.kill()
                run.goes_on(by=2)
                assert run.ends() == 1
            assert "ClusterLost: the head of the Ray cluster, 198.18.0.1:6379, has not answered" in run.said()
            assert json.loads((run.out / "summary.json").read_text())["state"] == "stopped"
            until(lambda: workers_on(one) == 0)
        with ray_cluster([one]), run.running(one, "--resume"):
            run.hurry.touch()
            assert run.ends() == 0, run.said()
    run.is_whole(episodes)
