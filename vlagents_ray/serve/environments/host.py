"""The process behind a replica, in which a policy runs whose packages, or Python, the replica cannot have.

    python -m vlagents_ray.serve.environments.host

It needs the light install and pydantic, not Ray. The first line of its standard input is `Settings`, as JSON. It
says one line of JSON when the policy is loaded, or why it is not: the address of its `LocalDoor`, by which
everything else goes, and the contract. A further byte asks it to close the policy and end. The end of its input, or its
parent's death, ends it at once.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, PolicyFailed, VLAgentsError
from vlagents_ray.interface import Agent
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import LocalDoor
from vlagents_ray.wire.messages import INNER_OPS, Limits

_PR_SET_PDEATHSIG = 1
# The replica has checked what it passes on, and forgets idle sessions.
_NO_LIMITS = Limits(**dict.fromkeys([limit.name for limit in fields(Limits)], 2**40))
_NEVER_S = 1e6


@dataclass(frozen=True, slots=True)
class Settings:
    """What a replica tells its child."""

    policy: str
    config: dict[str, Any]
    batch: int  # observations in one forward pass, at most
    version: str  # of the deployment: sessions move between equal ones only
    wrappers: Sequence[Any] = ()  # of the policy, as in a deployment file


def examine(policy: str, config: dict[str, Any], wrappers: Sequence[Any] = ()) -> dict[str, Any]:
    """Build the policy without loading it: its contract, if it states one already, or the error."""
    try:
        agent = build_agent(policy, config, wrappers)
    except VLAgentsError as error:
        return {"code": error.code, "error": str(error)}
    except Exception as error:  # noqa: BLE001 - whatever a policy raises when it is built
        return {"code": ConfigError.code, "error": f"policy {policy}: {type(error).__name__}: {error}"}
    contract = unloaded_contract(agent)
    return {"contract": None if contract is None else contract.to_json()}


def unloaded_contract(agent: Agent) -> Contract | None:
    """The contract of a policy that is not loaded, if it can state one."""
    try:
        return agent.contract
    except Exception:  # noqa: BLE001 - its own, for want of what `initialize` brings
        return None


def run() -> None:
    """Until the replica asks it to end, or is gone."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what anything prints goes to the replica's log
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    settings = Settings(**json.loads(_line()))
    over = threading.Event()
    threading.Thread(target=_wait_for_the_end, args=[over.set], daemon=True).start()

    def answer(said: dict[str, Any]) -> None:
        print(json.dumps(said), file=answers, flush=True)

    try:
        agent = build_agent(settings.policy, settings.config, settings.wrappers)
        engine = Engine(
            agent,
            max_batch_size=settings.batch,
            session_limit=sys.maxsize,
            session_idle_s=_NEVER_S,
            version=settings.version,
        )
        door = LocalDoor(engine, _NO_LIMITS, ops=INNER_OPS)
        door.open()
        engine.start()
    except Exception as error:
        logging.getLogger(__name__).exception("the policy did not load")
        cause = error.__cause__ if isinstance(error, PolicyFailed) else error  # what the policy itself raised
        answer({"error": f"{type(cause).__name__}: {cause}"})
        sys.exit(1)
    contract = engine.contract
    answer({"local": asdict(door.address), "contract": None if contract is None else contract.to_json()})
    over.wait()
    engine.close()
    door.close()


def _line() -> bytes:
    """The first line of the standard input, and nothing that follows it."""
    line = b""
    while not line.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            sys.exit(1)
        line += byte
    return line


def _wait_for_the_end(end: Callable[[], None]) -> None:
    if not os.read(0, 1):
        os._exit(1)
    end()
    os.read(0, 1)  # whoever asked has waited long enough
    os._exit(1)


if __name__ == "__main__":
    run()
