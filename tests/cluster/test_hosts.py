"""Simulated hosts on one machine: shared and separate resources, complete removal, and Ray on
several of them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from simulated_hosts import Host, HostFailed, hosts, ray_cluster

from vlagents_ray.evaluate import Results
from vlagents_ray.protocol.messages import boot_id

pytestmark = pytest.mark.hosts

REACH = (
    "import socket, sys; socket.create_connection((sys.argv[1], 9000), float(sys.argv[2])).recv(1)"
)
LISTEN = (
    "import socket; s = socket.create_server(('', 9000)); print('listening', flush=True)\n"
    "while True: s.accept()[0].sendall(b'x')"
)
WHERE = """
import ray, socket
ray.init(logging_level="WARNING")
@ray.remote(num_cpus=1, scheduling_strategy="SPREAD")
class Here:
    def where(self): return socket.gethostname()
print(*sorted(ray.get([one.where.remote() for one in [Here.remote(), Here.remote()]])))
"""


def reaches(one: Host, other: Host, within_s: float = 30.0) -> bool:
    try:
        one.run([sys.executable, "-c", REACH, other.name, f"{within_s}"])
    except HostFailed:
        return False
    return True


def test_hosts_are_machines_of_their_own_until_they_are_killed() -> None:
    with hosts(2) as [one, other]:
        boots = {
            host.run(["cat", "/proc/sys/kernel/random/boot_id"]).strip() for host in (one, other)
        }
        assert len(boots | {boot_id()}) == 3
        assert one.run(["hostname"]).strip() == "host1"
        other.run(["touch", "/dev/shm/mine"])
        assert "mine" not in one.run(["ls", "/dev/shm"])
        with other.start([sys.executable, "-c", LISTEN], stdout=-1) as listening:
            assert listening.stdout is not None
            assert listening.stdout.readline() == "listening\n"
            assert reaches(one, other)
            other.limit("10mbit")
            assert reaches(one, other)
            other.cut()
            assert not reaches(one, other, within_s=1.0)
            other.heal()
            assert reaches(one, other)
            other.kill()
            assert listening.wait(60) != 0
        assert not reaches(one, other, within_s=1.0)
        pids = [one.pid, other.pid]
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_a_command_that_fails_says_what_it_said() -> None:
    with hosts(1) as [one], pytest.raises(HostFailed, match="ended with 3: nothing"):
        one.run(["sh", "-c", "echo nothing; exit 3"])


def test_ray_runs_over_several_hosts() -> None:
    with hosts(2) as both, ray_cluster(both, cpus=1) as cluster:
        assert cluster.python(WHERE).split() == ["host1", "host2"]


EVALUATE = [
    sys.executable,
    "-c",
    "from vlagents_ray.cli import main; main()",
    "eval",
    "tabletop",
    "--policy=scripted",
]


@pytest.mark.ray
def test_without_an_address_an_evaluation_has_a_ray_of_its_own(tmp_path: Path) -> None:
    show = [
        sys.executable,
        "-c",
        "import ray; ray.init(logging_level='ERROR'); print(ray.nodes()[0]['NodeID'])",
    ]
    with hosts(1) as [host], ray_cluster([host]):
        host.run([*EVALUATE, "--episodes=1", f"--out={tmp_path / 'out'}"])
        node = host.run(show).split()[-1]
    found = Results.load(tmp_path / "out")
    assert [one.result.status for one in found.cases[0].episodes] == ["done"]
    assert found.workers[0].node != node
