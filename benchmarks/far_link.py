"""A link between two hosts with delay, loss and cuts of IP packets, even if the kernel has no
netem.

Each host gets a TUN device, whose packets `benchmarks.far_carrier` carries to the other host. These
are real packets of the kernel's own TCP, with real retransmissions, congestion control and
head-of-line blocking.

    with hosts(2) as [cloud, home], FarLink(cloud, home) as link:
        link.set(Conditions(delay_ms=80, loss=0.02))
        home.run(["curl", f"http://{link.address}:8000/v1/metadata"])
        link.set(Conditions(cut=True))
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict

from benchmarks.far_carrier import DEVICE, Conditions
from benchmarks.hosts import Host
from benchmarks.line_process import LineProcess, our_environment

_MTU = 1500
# Addresses of RFC 2544 for tests of networks; hosts use the other half of the range.
_ADDRESSES = ("198.19.0.1", "198.19.0.2")
_START_S = 20.0
_ANSWER_S = 10.0


class FarLink:
    """A link between two hosts, and its process."""

    def __init__(
        self, one: Host, other: Host, congestion: str = "cubic", device: str = "", own: bool = False
    ) -> None:
        """Prepare the link, which starts when its context is entered.

        Args:
            one: The host with the address `address`.
            other: The host with the address `other_address`.
            congestion: TCP's congestion control, "cubic" or "bbr".
            device: The name of the device in either host, if a host has several.
            own: Whether the link carries packets to the hosts' own addresses, instead of two
                further addresses.
        """
        self._addresses = (one.address, other.address) if own else _ADDRESSES
        self.address, self.other_address = self._addresses
        self._ends, self._congestion, self._device = (one, other), congestion, device or DEVICE

    def __enter__(self) -> FarLink:
        command = [
            "setpriv",
            "--pdeathsig=KILL",
            "nsenter",
            f"--target={self._ends[0].switch}",
            "--net",
        ]
        command += [sys.executable, "-m", "benchmarks.far_carrier", self._device]
        command += [str(host.pid) for host in self._ends]
        self._process = LineProcess("the link", command, our_environment())
        try:
            self._process.read(_START_S)
            for host, near, far in zip(
                self._ends, self._addresses, reversed(self._addresses), strict=True
            ):
                host.run(["ip", "address", "add", near, "peer", far, "dev", self._device])
                host.run(["ip", "link", "set", self._device, "mtu", str(_MTU), "up"])
                host.run(
                    [
                        "ip",
                        "route",
                        "replace",
                        far,
                        "dev",
                        self._device,
                        "congctl",
                        self._congestion,
                    ]
                )
        except BaseException:
            self._process.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self._process.close()

    def set(self, conditions: Conditions) -> None:
        """Change the conditions of the link."""
        self._process.request(json.dumps(asdict(conditions)), _ANSWER_S)
