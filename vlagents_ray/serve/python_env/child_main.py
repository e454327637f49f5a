"""The child process of a replica, which runs a policy with packages, or a Python, that the replica
cannot use.

    python -m vlagents_ray.serve.python_env.child_main

The process needs the light install and pydantic, not Ray. The first line of its standard input is
`Settings`, as JSON. It writes a line of JSON for each step of a long load and, when the policy is
loaded, a line with the contract and the address of its `ShmServer`, which receives all requests; if
the policy does not load, that line contains the error. At the next line of input, the process
closes the policy and ends. It ends immediately at the end of its input or when its parent ends.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, BinaryIO

from vlagents_ray.errors import (
    ConfigError,
    NotTrainable,
    PolicyFailed,
    VLAgentsError,
)
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.program import software
from vlagents_ray.policies.wrapper import build_agent, require_trainable, unloaded_contract
from vlagents_ray.protocol.messages import INNER_OPS, MessageLimits
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout
from vlagents_ray.serve.queue.call_limits import CallLimits
from vlagents_ray.serve.weights import WeightUpdates
from vlagents_ray.weights.trainable import dtype_name

# The replica checks requests, removes idle sessions and detects calls that take too long, so the
# child does none of this.
_NO_LIMITS = MessageLimits(**dict.fromkeys([limit.name for limit in fields(MessageLimits)], 2**40))
_NEVER_S = 1e6
_CHECK_S = 1.0  # interval of the health checks, which are the same as in a replica


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings that a replica sends to its child."""

    policy: str
    config: dict[str, Any]
    batch: int  # maximum number of observations in one forward pass
    version: str  # version of the deployment: sessions move only between equal versions
    wrappers: Sequence[Any] = ()  # wrappers of the policy, as in a deployment file
    # Whether passes have `batch` rows, so that the bits of an action do not depend on its batch.
    invariant: bool = False


def examine(policy: str, config: dict[str, Any], wrappers: Sequence[Any] = ()) -> dict[str, Any]:
    """Build the policy without loading it, and return its contract, if the policy already has one,
    or the error.

    Returns:
        `{"contract": ...}`, as JSON values or None, or `{"code": ..., "error": ...}`.
    """
    try:
        agent = build_agent(policy, config, wrappers)
    except VLAgentsError as error:
        return {"code": error.code, "error": str(error)}
    except Exception as error:  # noqa: BLE001 - a policy may raise any error when it is built
        return {
            "code": ConfigError.code,
            "error": f"policy {policy}: {type(error).__name__}: {error}",
        }
    contract = unloaded_contract(agent)
    return {"contract": None if contract is None else contract.to_json()}


def run() -> None:
    """Run the policy until the replica closes it or ends."""
    die_with_parent()
    reports = own_stdout()  # printed text goes to the replica's log
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    stream = os.fdopen(0, "rb", closefd=False)
    line = stream.readline()
    if not line:
        sys.exit(1)
    settings = Settings(**json.loads(line))
    over = threading.Event()

    def report(document: dict[str, Any]) -> None:
        print(json.dumps(document), file=reports, flush=True)

    def report_step(step: str) -> None:
        report({"step": step})

    threading.Thread(target=_follow_input, args=[stream, over], daemon=True).start()

    try:
        agent = build_agent(settings.policy, settings.config, settings.wrappers)
        engine_settings = EngineSettings(
            max_batch_size=settings.batch,
            # The replica rejects a policy for which this does not hold.
            invariant="auto" if settings.invariant else False,
            session_limit=sys.maxsize,
            session_idle_s=_NEVER_S,
            version=settings.version,
            limits=CallLimits(_NEVER_S, _NEVER_S, _NEVER_S),
            # No limit, since the replica applies its own limit.
            reply_bytes=MessageLimits().body_bytes,
            in_flight_bytes=_NO_LIMITS.in_flight_bytes,
        )
        engine = Engine(agent, engine_settings, on_step=report_step)
        server = ShmServer(engine, _NO_LIMITS, NoKey.INSIDE, INNER_OPS)
        server.open()
        engine.start()
    except Exception as error:
        logging.getLogger(__name__).exception("the policy did not load")
        # The cause of `PolicyFailed` is the policy's own error.
        cause = error.__cause__ if isinstance(error, PolicyFailed) else error
        report({"error": f"{type(cause).__name__}: {cause}"})
        sys.exit(1)

    contract = None if engine.contract is None else engine.contract.to_json()
    model = engine.model
    report(
        {
            "local": asdict(server.address),
            "contract": contract,
            "weights": model.weights,
            "uncompiled": model.uncompiled,
            "devices": model.devices,
            "variation": model.variation,
            "trained": _describe_trained(agent, engine.weights),
            "software": software(),
        }
    )

    while not over.wait(_CHECK_S):
        try:
            engine.health.check()
        except Exception:
            logging.getLogger(__name__).exception(
                "the process ends, so that the replica is replaced"
            )
            os._exit(1)

    engine.close()
    server.close()


def _describe_trained(agent: Agent, updates: WeightUpdates) -> dict[str, Any]:
    """Return the types and shapes of the values that a learner trains, by name, or the reason why
    there are none.
    """
    values = {}
    try:
        for name, value in require_trainable(agent).parameters().items():
            values[name] = [dtype_name(value), list(value.shape)]
    except NotTrainable as error:
        return {"refusal": str(error)}

    return {
        "values": values,
        "fingerprint": updates.version_named(0).fingerprint,
        "gpus": updates.newest().gpus,
    }


def _follow_input(stream: BinaryIO, over: threading.Event) -> None:
    """Set `over` at the next line of the input, and end the process at the end of the input."""
    if stream.readline():
        over.set()
        stream.readline()
    os._exit(1)


if __name__ == "__main__":
    run()
