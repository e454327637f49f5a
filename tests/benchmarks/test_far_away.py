"""A robot whose policy is far away, over a link with delay, loss and interruptions, and through a
tunnel.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from eval_fakes import wait_for

from benchmarks.far_away import PORT, robot, run, served
from benchmarks.far_carrier import Conditions
from benchmarks.far_link import FarLink
from benchmarks.far_robot import HZ, MAX_AGE_S
from benchmarks.hosts import Host, hosts
from benchmarks.line_process import LineProcess, our_environment

pytestmark = pytest.mark.hosts

ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(("", 9000)); print(1, flush=True)
while True: s.sendto(*s.recvfrom(99))
"""
ASK = """
import json, socket, struct, sys, time
for line in sys.stdin:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.settimeout(1.5)
    s.connect((sys.argv[1], 9000))
    for number in range(int(line)): s.send(struct.pack("id", number, time.monotonic()))
    took = {}
    try:
        while len(took) < int(line):
            number, sent = struct.unpack("id", s.recv(99))
            took[number] = time.monotonic() - sent
    except TimeoutError: pass
    print(json.dumps(sorted(took.values())), flush=True)
"""
SSHD = "/usr/sbin/sshd"
CONFIG = """
Port 2222
HostKey {folder}/host
AuthorizedKeysFile {folder}/user.pub
PidFile none
StrictModes no
UsePAM no
"""
# A user of Debian and Ubuntu; `sshd` runs as this user, and accepts only this one.
USER = "www-data"
DRIVE = """
import json, sys
from benchmarks.far_robot import FarRobot
from vlagents_ray import RemoteAgent
for url in sys.argv[1:]:
    with RemoteAgent(url) as agent:
        obs = FarRobot(agent.contract).observe()
        agent.reset(obs, "go")
        print(json.dumps([agent.transport, agent.codec.name, agent.act(obs).action.shape[0]]))
"""


class Far(NamedTuple):
    """Two hosts far from each other, with the policy's server on one of them."""

    cloud: Host
    home: Host
    link: FarLink
    server: LineProcess


@pytest.fixture(scope="module")
def far() -> Iterator[Far]:
    with hosts(2) as [cloud, home], FarLink(cloud, home) as link, served(cloud) as server:
        home.environment |= our_environment()
        yield Far(cloud, home, link, server)


def test_the_link_delays_loses_and_cuts_packets_and_heals(far: Far) -> None:
    echo = LineProcess("the echo", far.cloud.command([sys.executable, "-c", ECHO]), end_s=0.1)
    asker = LineProcess(
        "the asker", far.home.command([sys.executable, "-c", ASK, far.link.address])
    )
    with echo, asker:
        echo.read(30)

        def round_trips_s(count: int) -> list[float]:
            found: list[float] = asker.request(str(count), 60)
            return found

        far.link.set(Conditions())
        assert len(round_trips_s(50)) == 50
        far.link.set(Conditions(delay_ms=40))
        delayed = round_trips_s(50)
        assert len(delayed) == 50
        assert delayed[0] >= 0.08
        # In each direction, so about half of the round trips succeed.
        far.link.set(Conditions(loss=0.3))
        assert 5 < len(round_trips_s(50)) < 45
        far.link.set(Conditions(cut=True))
        assert round_trips_s(5) == []
        far.link.set(Conditions())
        assert len(round_trips_s(50)) == 50


def test_a_robot_stands_while_the_link_is_cut_and_then_goes_on_by_itself_with_what_it_sees_then(
    far: Far,
) -> None:
    with robot(far.home, f"http://{far.link.address}:{PORT}") as arm:
        _, before = far.server.request("sessions", 30)
        conditions = Conditions(delay_ms=40, loss=0.01, mbit=20)
        found, healed = run(
            arm, far.link, conditions, 3.5, 1.0, seconds=90, mode="async", recovers=True
        )
    wait_for(lambda: far.server.request("sessions", 30)[0] == 0)  # no session is left
    _, opened = far.server.request("sessions", 30)
    assert healed is not None
    ticks = found["ticks"]
    at, acted = np.array(ticks["at_s"]), np.array(ticks["acted"])
    assert len(found["barks"]) == 1, found["barks"]
    assert "server" in found["barks"][0]
    assert found["safe"]
    assert acted[-round(HZ) :].all()
    drove = np.flatnonzero(acted)
    # The tick of the observation from which each executed action was computed.
    seen = drove - np.array(ticks["age_ticks"])
    assert max(ticks["age_ticks"]) <= MAX_AGE_S * HZ + 1
    # The robot stood still at the end of the interruption.
    assert not ((at[drove] > healed - 1.0) & (at[drove] < healed)).any()
    # No action that was planned before the end is executed after it.
    assert (at[seen[at[drove] > healed]] > healed).all()
    assert ticks["twice"] == 0
    assert opened - before == 1 + found["resumed"]


@contextmanager
def tunnel(near: Host, far: Host, address: str, *forwarded: str) -> Iterator[None]:
    """Run `ssh` at `near` to the `sshd` of a user at `far`. The arguments are -L or -R with its
    ports.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for key in ("host", "user"):
            subprocess.run(
                ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / key], check=True
            )
        (folder / "config").write_text(CONFIG.format(folder=folder))
        for path in (folder, folder / "host", folder / "user.pub", folder / "config"):
            shutil.chown(path, USER, USER)
        as_user = ["setpriv", f"--reuid={USER}", f"--regid={USER}", "--clear-groups"]
        command = [*as_user, SSHD, "-D", "-e", "-f", str(folder / "config")]
        with far.start(command, stderr=subprocess.PIPE) as sshd:
            try:
                assert sshd.stderr is not None
                assert "listening" in sshd.stderr.readline()
                known = [
                    "-F",
                    "none",
                    "-o",
                    "StrictHostKeyChecking=no",
                    "-o",
                    f"UserKnownHostsFile={folder / 'known'}",
                ]
                options = [
                    "-f",
                    "-N",
                    "-o",
                    "BatchMode=yes",
                    "-o",
                    "ExitOnForwardFailure=yes",
                    *known,
                    *forwarded,
                ]
                with near.start(
                    ["ssh", *options, "-i", str(folder / "user"), "-p", "2222", f"{USER}@{address}"]
                ) as ssh:
                    assert ssh.wait(60) == 0  # it continues in the background
                yield
            finally:
                sshd.terminate()


def test_a_robot_reaches_its_policy_through_a_tunnel_from_either_side(far: Far) -> None:
    if not Path(SSHD).exists():
        pytest.skip(f"no {SSHD} (Debian: openssh-server)")
    far.link.set(Conditions(delay_ms=10))
    from_home = tunnel(far.home, far.cloud, far.link.address, "-L", f"9000:127.0.0.1:{PORT}")
    with (
        from_home,
        tunnel(far.cloud, far.home, far.link.other_address, "-R", f"9001:127.0.0.1:{PORT}"),
    ):
        urls = [f"http://127.0.0.1:{port}" for port in (9000, 9001)]
        said = far.home.run([sys.executable, "-c", DRIVE, *urls]).splitlines()
    assert [json.loads(line)[::2] for line in said] == [["websocket", 50]] * 2
