"""A link between two hosts that delays, loses and cuts IP packets, also where the kernel has no netem.

Each host gets a TUN device, whose packets this process carries to the other: real packets of the kernel's own TCP, so
that retransmissions, congestion control and head-of-line blocking are real, too.

    with hosts(2) as [cloud, home], FarLink(cloud, home) as link:
        link.set(Conditions(delay_ms=80, loss=0.02))
        home.run(["curl", f"http://{link.address}:8000/v1/metadata"])
        link.set(Conditions(cut=True))
"""

from __future__ import annotations

import fcntl
import heapq
import json
import os
import random
import select
import struct
import subprocess
import sys
import time
from dataclasses import asdict, dataclass

from benchmarks.hosts import Host
from vlagents_ray.bench.line_process import LineProcess, our_environment
from vlagents_ray.bench.peers.peer import die_with_parent

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h
_MTU = 1500
_ADDRESSES = ("198.19.0.1", "198.19.0.2")  # RFC 2544's, for tests of networks; hosts have the other half
_QUEUE_S = 0.2  # what a full queue of the link delays; what comes then is dropped
_START_S = 20.0
_ANSWER_S = 10.0


@dataclass(frozen=True, slots=True)
class Conditions:
    """What a link does to the packets of either direction."""

    delay_ms: float = 0.0  # each way
    loss: float = 0.0  # share of the packets, each by itself
    mbit: float = 1000.0  # Mbit/s
    cut: bool = False  # whether it carries nothing; what is on its way is lost as well


class FarLink:
    """A link between two hosts, and the process that is the link."""

    def __init__(self, one: Host, other: Host, congestion: str = "cubic") -> None:
        """Name the ends, and TCP's congestion control, "cubic" or "bbr"; the link begins with `with`."""
        self.address, self.other_address = _ADDRESSES
        self._ends, self._congestion = (one, other), congestion

    def __enter__(self) -> FarLink:
        switch = ["nsenter", f"--target={self._ends[0].switch}", "--net"]
        command = [*switch, sys.executable, "-m", "benchmarks.far_link", *(str(host.pid) for host in self._ends)]
        self._process = LineProcess("the link", command, our_environment())
        try:
            self._process.read(_START_S)
            for host, near, far in zip(self._ends, _ADDRESSES, reversed(_ADDRESSES), strict=True):
                host.run(["ip", "address", "add", near, "peer", far, "dev", "far"])
                host.run(["ip", "link", "set", "far", "mtu", str(_MTU), "up"])
                host.run(["ip", "route", "replace", far, "dev", "far", "congctl", self._congestion])
        except BaseException:
            self._process.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self._process.close()

    def set(self, conditions: Conditions) -> None:
        """Change what the link does, from now on."""
        self._process.request(json.dumps(asdict(conditions)), _ANSWER_S)


class _Carrier:
    """The two devices, and the packets on their way."""

    def __init__(self, pids: list[str]) -> None:
        self._devices = [_device(f"far{number}") for number in range(2)]
        for number, pid in enumerate(pids):
            subprocess.run(["ip", "link", "set", f"far{number}", "netns", pid, "name", "far"], check=True)  # noqa: S607
        self._conditions = Conditions()
        self._way: list[tuple[float, int, int, bytes]] = []  # when it is due, its number, device, and the packet
        self._count = 0
        self._free_at = [0.0, 0.0]  # when the last packet to a device has left its sender
        self._random = random.Random(0)

    def run(self) -> None:
        """Carry packets until standard input ends, each line of which is new conditions."""
        poll = select.poll()
        for source in (sys.stdin.fileno(), *self._devices):
            poll.register(source, select.POLLIN)
        while True:
            wait_s = self._way[0][0] - time.monotonic() if self._way else 3600.0
            for ready, _ in poll.poll(max(0.0, wait_s * 1e3)):
                if ready == sys.stdin.fileno():
                    line = os.read(ready, 2**16)
                    if not line:
                        return
                    self._change(Conditions(**json.loads(line)))
                    print("true", flush=True)  # noqa: T201 - the answer
                else:
                    self._take(self._devices.index(ready))
            now = time.monotonic()
            while self._way and self._way[0][0] <= now:
                _, _, device, packet = heapq.heappop(self._way)
                self._write(device, packet)

    def _change(self, conditions: Conditions) -> None:
        self._conditions = conditions
        if conditions.cut:
            self._way.clear()
            self._free_at = [0.0, 0.0]

    def _take(self, source: int) -> None:
        try:
            packet = os.read(self._devices[source], 2**16)
        except BlockingIOError:
            return
        known, target, now = self._conditions, 1 - source, time.monotonic()
        begins = max(now, self._free_at[target])
        if known.cut or begins - now > _QUEUE_S or self._random.random() < known.loss:
            return
        self._free_at[target] = begins + len(packet) * 8 / (known.mbit * 1e6)
        self._count += 1
        heapq.heappush(self._way, (self._free_at[target] + known.delay_ms / 1e3, self._count, target, packet))

    def _write(self, device: int, packet: bytes) -> None:
        try:
            os.write(self._devices[device], packet)
        except OSError:  # the host is gone, or its device is not up yet: as lost as on any link
            return


def _device(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return device


def main() -> None:
    """Run the process that is the link, in the network namespace of the switch."""
    die_with_parent()
    carrier = _Carrier(sys.argv[1:])
    print("true", flush=True)  # noqa: T201 - it is there
    carrier.run()


if __name__ == "__main__":
    main()
