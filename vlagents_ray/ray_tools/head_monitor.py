"""A monitor that detects the end of the cluster's head, or of Ray's daemon on this machine.

Ray kills a process one minute after the process has lost the cluster's head, and the process cannot
write anything before. Ray does not detect the end of its daemon (the raylet) on the same machine.
Most calls of Ray block in the meantime. The driver therefore checks both processes itself, and
exits in time.
"""

from __future__ import annotations

import logging
import os
import socket
from pathlib import Path
from time import monotonic, sleep

import ray

from vlagents_ray.errors import ClusterLost
from vlagents_ray.ray_tools.private import node_of_this_process
from vlagents_ray.ray_tools.session import started_here

log = logging.getLogger(__name__)

PERIOD_S = 2.0  # interval of the checks
ANSWER_S = 1.0  # timeout of a check, which blocks the driver
# Time after which Ray kills a process without a head.
_RAY_TIMEOUT = "RAY_gcs_rpc_server_reconnect_timeout_s"
_RAY_TIMEOUT_S = 60.0  # Ray's default for this time
# The share of Ray's timeout after which the head counts as lost. The remaining time is for an
# orderly end.
_SHARE = 0.4
_SOCKETS = Path("/proc/net/unix")
_LOOK_S = 0.05  # interval of the checks of `head_ends_within`, s


class HeadMonitor:
    """Checks whether the cluster's head accepts connections, and whether the local daemon's
    socket exists.
    """

    def __init__(self, cure: str) -> None:
        """Monitor the cluster of this process; `cure` is the end of the error message when the
        cluster is lost.
        """
        self.node = node_of_this_process()
        self._address = _address()
        host, port = self._address
        self._name = f"the head of the Ray cluster, {host}:{port},"
        self._cure = cure

        self._timeout_s = _SHARE * float(os.environ.get(_RAY_TIMEOUT) or _RAY_TIMEOUT_S)
        if started_here():
            # Nothing replaces a head that this process has started.
            self._timeout_s = min(self._timeout_s, PERIOD_S)

        # The socket of the local daemon; None if the system does not list its sockets.
        self._daemon = None if self.node is None else str(self.node.raylet_socket_name)
        if self._daemon is not None and not _exists(self._daemon):
            self._daemon = None

        self._checked = monotonic()  # time of the last check, s
        self._answered = self._checked  # time of the last check that the head answered, s

    def answers(self) -> bool:
        """Return whether the head answered the last check, which is repeated every `PERIOD_S`.

        Raises:
            ClusterLost: The head has not answered for too long, or the daemon on this machine has
                ended.
        """
        if monotonic() - self._checked > PERIOD_S:
            self._check()
        silent_s = self._checked - self._answered
        if silent_s > self._timeout_s:
            raise ClusterLost(f"{self._name} has not answered for {silent_s:.0f} s; {self._cure}")
        return silent_s == 0.0

    def _check(self) -> None:
        """Check the local daemon and the head once; raise `ClusterLost` if the daemon has ended."""
        if self._daemon is not None and not _exists(self._daemon):
            raise ClusterLost(f"Ray's daemon on this machine, the raylet, has ended; {self._cure}")

        try:
            socket.create_connection(self._address, ANSWER_S).close()
        except OSError as error:
            if self._checked == self._answered and self._timeout_s > PERIOD_S:
                log.warning(
                    "%s does not answer (%s): no worker is started until it does; this ends after "
                    "%.0f s",
                    self._name,
                    error,
                    self._timeout_s,
                )
            self._checked = monotonic()
        else:
            self._checked = monotonic()
            self._answered = self._checked


def head_is_gone() -> bool:
    """Return whether the head refuses connections.

    It does so from SIGTERM until its process ends, seconds later.
    """
    try:
        socket.create_connection(_address(), ANSWER_S).close()
    except OSError as error:
        return isinstance(error, ConnectionRefusedError)  # otherwise the head may be busy
    return False


def head_ends_within(seconds: float) -> bool:
    """Wait for at most this time until the head refuses connections; return whether it does."""
    end = monotonic() + seconds
    while not head_is_gone():
        if monotonic() >= end:
            return False
        sleep(_LOOK_S)
    return True


def _address() -> tuple[str, int]:
    host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
    return host.strip("[]"), int(port)


def _exists(unix_socket: str) -> bool:
    """Return whether a Unix socket is open. Its file may remain after the listener has ended."""
    try:
        return any(line.endswith(f" {unix_socket}") for line in _SOCKETS.read_text().splitlines())
    except OSError:  # The system is not Linux.
        return False
