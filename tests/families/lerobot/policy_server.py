"""LeRobot's own policy server, as a process: `python policy_server.py PORT`; nothing is waited for in an answer."""

# ruff: noqa: E402 - a torchvision without a build for this torch is prepared before anything imports it

from __future__ import annotations

import sys
from pathlib import Path

if __name__ == "__main__":  # as a script, only this folder is on the path
    sys.path.insert(0, str(Path(__file__).parents[3]))

from vlagents_ray.policies.base.accelerator import ensure_torchvision

ensure_torchvision()

import torch
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.policy_server import serve

if __name__ == "__main__":
    torch.set_num_threads(1)
    serve(PolicyServerConfig(port=int(sys.argv[1]), host="127.0.0.1", inference_latency=0))
