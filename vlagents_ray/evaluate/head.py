"""Does the cluster's head still answer?

Ray ends a process that has lost its head, after a minute and on the spot: nothing can be said or written any more.
And most of what one asks Ray meanwhile waits for it. So the driver looks for itself, and gives up in time.
"""

from __future__ import annotations

import logging
import os
import socket
from time import monotonic

import ray

from vlagents_ray.errors import ClusterLost

log = logging.getLogger(__name__)

PERIOD_S = 2.0  # between two looks
ANSWER_S = 1.0  # for one; the driver does nothing else meanwhile
_RAYS_PATIENCE = "RAY_gcs_rpc_server_reconnect_timeout_s"  # with a head that does not answer, as set for its processes
_RAYS_PATIENCE_S = 60.0
_SHARE = 0.6  # of Ray's patience; the rest is for leaving in order


class Head:
    """The head of the cluster that this process is in, as its socket answers."""

    def __init__(self) -> None:
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._address = host.strip("[]"), int(port)
        self._name = f"the head of the Ray cluster, {host}:{port},"
        self._patience_s = _SHARE * float(os.environ.get(_RAYS_PATIENCE) or _RAYS_PATIENCE_S)
        self._looked = self._answered = monotonic()

    def answers(self) -> bool:
        """Did it, the last time somebody looked, `PERIOD_S` ago at most? `ClusterLost` once it is silent for long."""
        if monotonic() - self._looked > PERIOD_S:
            self._look()
        silent_s = self._looked - self._answered
        if silent_s > self._patience_s:
            raise ClusterLost(
                f"{self._name} has not answered for {silent_s:.0f} s; what was played is kept: go on with --resume "
                f"when there is a cluster again"
            )
        return silent_s == 0.0

    def _look(self) -> None:
        try:
            socket.create_connection(self._address, ANSWER_S).close()
        except OSError as error:
            if self._looked == self._answered:
                log.warning(
                    "%s does not answer (%s): no worker is started until it does; this ends after %.0f s",
                    self._name, error, self._patience_s,
                )  # fmt: skip
            self._looked = monotonic()
        else:
            self._looked = self._answered = monotonic()
