"""Swaps the checkpoints of running applications, one after another.

A swap is Serve's own update of a running application: the deployment is deployed again with another
step in `user_config`, which each replica loads in place of the old one. A replica that is killed
meanwhile, or that starts later, therefore gets the new step from Serve's controller.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass

from ray import serve

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.policies.base.checkpoint import CHECKPOINT_STEP
from vlagents_ray.ray_tools import private
from vlagents_ray.serve.launch.deployment_file import with_user_config
from vlagents_ray.serve.launch.server import Server, last_message, load_failure

log = logging.getLogger(__name__)

# Time limit of a swap, s. Serve updates the replicas one after another, and may first have to
# start a machine for a replica that was lost.
SWAP_S = 3600.0


@dataclass(frozen=True, slots=True)
class _Swap:
    """A swap of an application's checkpoint."""

    app: str
    step: int
    earlier: str  # Serve's last message about the application before the swap
    deadline: float  # end of the time limit, s, of `time.monotonic`


class ServedCheckpoints:
    """The checkpoints of a server's applications, as
    `vlagents_ray.evaluate.driver.CheckpointSwaps`.
    """

    def __init__(self, server: Server, applications: Mapping[str, str]) -> None:
        """Swap checkpoints of a running server.

        Args:
            server: The server. Serve must have deployed it from a file with a `user_config`.
            applications: The name of the application of each policy.
        """
        self._deployed = server.deployed
        self._applications = applications
        self._swaps: dict[str, _Swap] = {}  # last swap of each policy

    def begin(self, policy: str, step: int) -> None:
        """Begin to load the checkpoint of a training step; without effect if it is loaded."""
        app = self._applications[policy]
        earlier = last_message(serve.status().applications[app])
        self._swaps[policy] = _Swap(app, step, earlier, time.monotonic() + SWAP_S)
        changed = with_user_config(self._deployed, app, {CHECKPOINT_STEP: step})
        if changed != self._deployed:
            log.info("policy %r: loading %s %d", policy, CHECKPOINT_STEP, step)
            self._deployed = changed
            private.serve_client().deploy_apps(changed.for_serve())

    def is_done(self, policy: str) -> bool:
        """Return whether all replicas of the policy act with the checkpoint.

        Raises:
            ConfigError: The checkpoint cannot be loaded.
            PolicyUnavailable: It is not loaded within the time limit.
        """
        swap = self._swaps[policy]
        app = serve.status().applications[swap.app]
        subject = f"policy {policy!r}: {CHECKPOINT_STEP} {swap.step}"
        failure = load_failure(app, swap.earlier)
        if failure is not None:
            raise ConfigError(f"{subject}: {failure}")
        if app.status == "RUNNING":
            return True
        if time.monotonic() > swap.deadline:
            raise PolicyUnavailable(
                f"{subject} is not loaded within {SWAP_S:g} s: the application is {app.status}"
            )
        return False
