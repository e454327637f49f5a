"""The link between hosts far from each other does to packets what it was told, and nothing else."""

from __future__ import annotations

import json
import sys

import pytest

from benchmarks.far_link import Conditions, FarLink
from benchmarks.hosts import Host, hosts

pytestmark = pytest.mark.hosts

ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.bind(("", 9000)); print("bound", flush=True)
while True: s.sendto(*s.recvfrom(99))
"""
ASK = """
import json, socket, struct, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); s.settimeout(1.5)
s.connect((sys.argv[1], 9000))
for i in range(int(sys.argv[2])): s.send(struct.pack("id", i, time.monotonic()))
took = {}
try:
    while len(took) < int(sys.argv[2]):
        number, sent = struct.unpack("id", s.recv(99))
        took[number] = time.monotonic() - sent
except (TimeoutError, ConnectionRefusedError): pass
print(json.dumps(sorted(took.values())))
"""


def asked(host: Host, address: str, count: int) -> list[float]:
    """The round trips, s, of those of `count` datagrams that came back."""
    found: list[float] = json.loads(host.run([sys.executable, "-c", ASK, address, str(count)]))
    return found


def test_it_delays_loses_and_cuts_packets_and_heals() -> None:
    with hosts(2) as [cloud, home], FarLink(cloud, home) as link:
        with cloud.start([sys.executable, "-c", ECHO], stdout=-1) as echo:
            assert echo.stdout is not None
            assert echo.stdout.readline() == "bound\n"
            assert len(asked(home, link.address, 100)) == 100
            link.set(Conditions(delay_ms=40))
            delayed = asked(home, link.address, 100)
            assert len(delayed) == 100
            assert delayed[0] >= 0.08
            link.set(Conditions(loss=0.3))  # each way: about half comes back
            assert 20 < len(asked(home, link.address, 100)) < 80
            link.set(Conditions(cut=True))
            assert asked(home, link.address, 10) == []
            link.set(Conditions())
            assert len(asked(home, link.address, 100)) == 100
            echo.terminate()
