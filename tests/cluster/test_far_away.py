"""A robot on another host than its policy: over a network that is interrupted, and through a
tunnel.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from eval_fakes import PYTHONPATH, wait_for
from far_robot import HZ, MAX_AGE_S
from simulated_hosts import Host, hosts

from benchmarks.line_process import LineProcess

pytestmark = pytest.mark.hosts

PORT = 8000
START_S = 180.0
RUN_S = 90.0
CUT_AFTER_S, CUT_S = 1.0, 3.5
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
from far_robot import FarRobot
from vlagents_ray import RemoteAgent
for url in sys.argv[1:]:
    with RemoteAgent(url) as agent:
        obs = FarRobot(agent.contract).observe()
        agent.reset(obs, "go")
        print(json.dumps([agent.transport, agent.codec.name, agent.act(obs).action.shape[0]]))
"""


class Far(NamedTuple):
    """Two hosts, with the policy's server on one of them."""

    cloud: Host
    home: Host
    server: LineProcess


def process(host: Host, *words: str) -> LineProcess:
    """Start a process of `far_robot` on a host."""
    return LineProcess(words[0], host.command([sys.executable, "-m", "far_robot", *words]))


@pytest.fixture(scope="module")
def far() -> Iterator[Far]:
    with hosts(2) as both:
        cloud, home = both
        for host in both:
            host.environment["PYTHONPATH"] = PYTHONPATH
        with process(cloud, "serve", str(PORT)) as server:
            server.read(START_S)
            yield Far(cloud, home, server)


def test_a_robot_stands_while_the_link_is_cut_and_then_goes_on_by_itself_with_what_it_sees_then(
    far: Far,
) -> None:
    with process(far.home, "drive", f"http://{far.cloud.address}:{PORT}") as arm:
        arm.read(START_S)
        _, before = far.server.request("sessions", 30)
        arm.send(json.dumps({"seconds": RUN_S}))
        assert arm.read(START_S) == "begun"
        time.sleep(CUT_AFTER_S)
        far.home.cut()
        time.sleep(CUT_S)
        far.home.heal()
        healed = time.monotonic()
        found = arm.read(RUN_S + START_S)
    wait_for(lambda: far.server.request("sessions", 30)[0] == 0)  # no session is left
    _, opened = far.server.request("sessions", 30)
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
    from_home = tunnel(far.home, far.cloud, far.cloud.address, "-L", f"9000:127.0.0.1:{PORT}")
    with (
        from_home,
        tunnel(far.cloud, far.home, far.home.address, "-R", f"9001:127.0.0.1:{PORT}"),
    ):
        urls = [f"http://127.0.0.1:{port}" for port in (9000, 9001)]
        said = far.home.run([sys.executable, "-c", DRIVE, *urls]).splitlines()
    assert [json.loads(line)[::2] for line in said] == [["websocket", 50]] * 2
