"""The process that carries the packets of a link between two hosts: `python -m
benchmarks.far_carrier DEVICE PID PID`.

Its arguments are the device's name in the hosts, and the first process of each host. It answers
each line of `Conditions` with a line. It imports only the standard library, so that it starts
quickly.
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
from dataclasses import dataclass

DEVICE = "far"  # name of the device in each host, unless a host has several devices
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h
_QUEUE_S = 0.2  # delay of a full queue of the link, s; further packets are dropped


@dataclass(frozen=True, slots=True)
class Conditions:
    """The treatment of packets in each direction."""

    delay_ms: float = 0.0  # delay in each direction, ms
    loss: float = 0.0  # share of lost packets; each packet is drawn separately
    mbit: float = 1000.0  # rate, Mbit/s
    cut: bool = False  # whether the link carries nothing; packets in transit are also lost


class _Carrier:
    """The two devices, and the packets in transit."""

    def __init__(self, device: str, *pids: str) -> None:
        names = [f"{device}-{number}" for number in range(2)]  # names in the switch's namespace
        self._devices = [_device(name) for name in names]
        for name, pid in zip(names, pids, strict=True):
            subprocess.run(["ip", "link", "set", name, "netns", pid, "name", device], check=True)  # noqa: S607
        self._conditions = Conditions()
        # Due time, number, device, and the packet.
        self._way: list[tuple[float, int, int, bytes]] = []
        self._count = 0
        # Time at which the last packet to each device left its sender, s.
        self._free_at = [0.0, 0.0]
        self._random = random.Random(0)

    def run(self) -> None:
        """Carry packets until standard input ends; each of its lines sets new conditions."""
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
        heapq.heappush(
            self._way, (self._free_at[target] + known.delay_ms / 1e3, self._count, target, packet)
        )

    def _write(self, device: int, packet: bytes) -> None:
        try:
            os.write(self._devices[device], packet)
        except OSError:  # the host has ended, or its device is not up yet, so the packet is lost
            return


def _device(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return device


def main() -> None:
    """Run the process of the link, in the network namespace of the switch."""
    carrier = _Carrier(*sys.argv[1:])
    print("true", flush=True)  # noqa: T201 - reports that the process is ready
    carrier.run()


if __name__ == "__main__":
    main()
