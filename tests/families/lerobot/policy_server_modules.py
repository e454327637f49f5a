"""What LeRobot's policy server imports; all that its process logs would go to a file in the current folder."""

# ruff: noqa: E402 - a torchvision without a build for this torch is prepared before anything imports it

from __future__ import annotations

import contextlib
import logging
import tempfile

from vlagents_ray.policies.base.accelerator import ensure_torchvision

ensure_torchvision()

import torch
from lerobot.async_inference.configs import PolicyServerConfig

with tempfile.TemporaryDirectory() as _folder, contextlib.chdir(_folder):
    from lerobot.async_inference.policy_server import serve
for _handler in logging.getLogger().handlers[:]:
    if isinstance(_handler, logging.FileHandler):
        logging.getLogger().removeHandler(_handler)

__all__ = ["PolicyServerConfig", "serve", "torch"]
