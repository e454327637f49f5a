"""The placement of processes and their transports, on a real Ray cluster of three nodes, with a
robot on a host outside it.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from eval_fakes import PYTHONPATH
from simulated_hosts import Host, RayCluster, hosts, ray_cluster

pytestmark = pytest.mark.hosts

PLACED = [sys.executable, "-m", "placement_commands"]
CPUS = 2  # CPUs of each node, which therefore has room for two workers
STORE = {"object_store_memory": "200000000"}


@dataclass(frozen=True, slots=True)
class Served:
    """A server whose application "one" has a replica on host2, and "two" has replicas on host2 and
    host3.
    """

    cluster: RayCluster
    robot: Host

    def play(
        self, app: str, workers: int, out: Path, transport: str = "auto"
    ) -> Counter[tuple[str, str]]:
        """Run an evaluation, and return the number of its workers by host and transport."""
        said = self.cluster.head.run([*PLACED, "play", app, str(workers), transport, str(out)])
        found = json.loads(said.splitlines()[-1])
        assert found["episodes"] == 2 * workers
        return Counter((host, way) for host, way in found["workers"])


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    environment = {"PYTHONPATH": PYTHONPATH}
    with (
        hosts(4) as [head, second, third, robot],
        ray_cluster([head], CPUS, environment, **STORE) as cluster,
    ):
        for host, resources in ((second, {"of_one": 1, "of_two": 1}), (third, {"of_two": 1})):
            cluster.join(host, CPUS, resources=json.dumps(resources), **STORE)
        robot.environment |= environment
        with head.start([*PLACED, "serve"], stdin=-1, stdout=-1) as server:
            assert server.stdin is not None
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            yield Served(cluster, robot)
            server.stdin.close()
            server.wait(180)


def test_workers_fill_the_replicas_node_first_and_reach_it_without_a_copy_then_spill(
    served: Served, tmp_path: Path
) -> None:
    found = served.play("one", 4, tmp_path)
    assert found["host2", "shm"] == CPUS
    assert sum(found.values()) == 4
    assert {way for host, way in found if host != "host2"} == {"handle"}


def test_plasma_is_there_on_the_replicas_node(served: Served, tmp_path: Path) -> None:
    assert served.play("one", 2, tmp_path, "plasma") == {("host2", "plasma"): 2}


def test_workers_are_shared_over_the_nodes_of_several_replicas(
    served: Served, tmp_path: Path
) -> None:
    wanted = {("host2", "shm"): 2, ("host3", "shm"): 2}
    # A replica that pauses for 0.3 s is not offered to a worker on its node.
    for attempt in ("1", "2", "3"):
        found = served.play("two", 4, tmp_path / attempt)
        if found == wanted:
            break
    assert found == wanted


def test_a_robot_outside_the_cluster_comes_by_websocket_or_http(served: Served) -> None:
    served.robot.limit("1gbit")
    said = served.robot.run([*PLACED, "robot", f"http://{served.cluster.head.address}:8000/one"])
    assert json.loads(said.splitlines()[-1]) == ["websocket", "http"]
