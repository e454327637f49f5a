"""LeRobot's own policy server, in a process of its own that is forked from one with everything imported."""

from __future__ import annotations

import multiprocessing
from typing import Any

_MODULES = "tests.families.lerobot.policy_server_modules"


def start(port: int) -> Any:
    """Start a server, and return its process."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_MODULES])
    process = context.Process(target=_serve, args=(port,), daemon=True)
    process.start()
    return process


def _serve(port: int) -> None:
    from tests.families.lerobot.policy_server_modules import PolicyServerConfig, serve, torch

    torch.set_num_threads(1)
    serve(PolicyServerConfig(port=port, host="127.0.0.1", inference_latency=0))  # no answer is held back
