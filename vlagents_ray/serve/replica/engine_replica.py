"""The engine of a Serve replica: the settings of its policy, loading, requests through a handle, and health."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import ray

from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyFailed, VLAgentsError
from vlagents_ray.policies.base.accelerator import VISIBLE
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.messages import Limits, Request
from vlagents_ray.ray_tools.private import gpus_here
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.python_env.child_agent import make_agent, version_of
from vlagents_ray.serve.requests import Message
from vlagents_ray.serve.sessions import SessionFinder

logger = logging.getLogger(__name__)


class ReplicaEngine:
    """The engine of a replica, which is loaded after the first `configure`.

    A replica loads it in its own `reconfigure`, so that Serve reports RUNNING only when the policy can act. A policy
    that does not load therefore makes the start fail, with the reason in `serve status`.
    """

    def __init__(self, engine: Engine, limits: Limits, config: dict[str, Any]) -> None:
        """Serve `engine` within the `limits` of the decoders; `config` are the deployment's settings of the policy."""
        self.engine = engine
        self.limits = limits
        self._config = config
        self._configured = False

    @classmethod
    def from_args(
        cls, args: ServerArgs, check: Callable[[Contract | None], None], finder: SessionFinder | None = None
    ) -> ReplicaEngine:
        """Make the engine, without loading the policy; see `Engine` for the last two arguments."""
        if VISIBLE not in args.environment.env_vars:
            hide_gpus(ray.get_runtime_context().get_accelerator_ids().get("GPU", []))
        limits = args.limits.limits()
        engine = Engine(
            args.checkpoints.of(partial(make_agent, args), args.config),
            max_batch_size=args.batch.max_size,
            patience=args.batch.patience,
            batch_sizes=args.batch.sizes or (),
            session_limit=args.sessions.limit,
            session_idle_s=args.sessions.idle_s,
            version=version_of(args),
            check=check,
            limits=args.limits.call_limits(),
            reply_bytes=limits.reply_bytes,
            in_flight_bytes=limits.in_flight_bytes,
            finder=finder,
        )
        return cls(engine, limits, args.config)

    def configure(self, settings: dict[str, Any] | None) -> bool:
        """Apply the file's `user_config`, and return whether it is the first, after which the replica has to start.

        Later calls return at once and raise nothing, as an error would end the replica: the metadata and the log show
        the result of the swap.
        """
        config = {**self._config, **(settings or {})}
        if self._configured:
            logger.info("new settings, to be loaded beside the present ones: %s", config)
        self.engine.models.configure(config)
        first, self._configured = not self._configured, True
        return first

    async def load(self) -> None:
        """Load the policy."""
        try:
            await asyncio.to_thread(self.engine.start)
        except PolicyFailed as error:
            if not isinstance(error.__cause__, VLAgentsError):
                raise
            logger.exception("the policy did not load")
            # Errors of this package say what to do: `serve status` would show the tracebacks of both before it.
            raise PolicyFailed(str(error)) from None

    async def ask(self, session_id: str, frame: Any) -> tuple[list[Request], Message]:
        """Execute a frame of requests from inside the cluster; return the requests, and the answered message."""
        sender = Sender(self.engine, "handle", session_id, caller=NoKey.INSIDE, connected=False)
        message, decoded = sender.message(), Decoded([], {})
        try:
            admission = sender.admission(self.limits)  # the frame is in plasma
            decoded = await admission.decoded(partial(decode_requests, memoryview(frame)))
            message.decoded(decoded)
            await sender.ask(message, decoded, admission)
        except VLAgentsError as error:
            message.refuse(error)
        return decoded.requests, message

    async def call(self, session_id: str, frame: Any) -> bytes:
        """Execute a frame of requests from inside the cluster, and return the frame of the replies."""
        _, message = await self.ask(session_id, frame)
        return message.frame()

    async def check_health(self) -> None:
        """Raise if the policy died or hangs; includes the policy's own check."""
        await asyncio.to_thread(self.engine.check_health)


def hide_gpus(given: Sequence[str]) -> None:
    """Hide the node's GPUs from this process and its children, unless Ray has given it some.

    Ray itself does not hide them from a replica with `num_gpus: 0`, which would take memory of the first one,
    unreserved. It must be called before anything uses CUDA.
    """
    if given:
        return
    if found := gpus_here():
        logger.warning(
            "this node has %g GPUs, which are hidden from the policy, as its resources say num_gpus: 0; with "
            "resources: {num_gpus: 1} it gets one",
            found,
        )
    os.environ[VISIBLE] = ""
