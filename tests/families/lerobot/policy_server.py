"""LeRobot's own policy server, in a process of its own that is forked from one with everything imported."""

# ruff: noqa: E402 - a torchvision without a build for this torch is prepared before anything imports it

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
from pathlib import Path
from typing import Any

from vlagents_ray.policies.base.accelerator import ensure_torchvision

ensure_torchvision()

import torch
from lerobot.async_inference.configs import PolicyServerConfig

with tempfile.TemporaryDirectory() as _logs, contextlib.chdir(_logs):  # it makes a folder of logs when it is imported
    from lerobot.async_inference.policy_server import serve


def start(port: int, folder: Path) -> Any:
    """Start a server, which writes its logs into a folder, and return its process."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=_serve, args=(port, folder), daemon=True)
    process.start()
    return process


def _serve(port: int, folder: Path) -> None:
    os.chdir(folder)
    torch.set_num_threads(1)
    serve(PolicyServerConfig(port=port, host="127.0.0.1", inference_latency=0))  # no answer is held back
