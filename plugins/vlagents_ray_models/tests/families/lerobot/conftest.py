"""Checkpoints and sessions for LeRobot's tests."""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from vlagents_ray import Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray_models.lerobot import LeRobot
from vlagents_ray_models.lerobot.samplers import LONGEST_PREFIX

torch.set_num_threads(1)  # the models are too small for more: threads would wait for one another
# LeRobot 0.4 runs pi0 and pi0.5 only with a transformers that has openpi's changes, such as this
# module.
PATCHED = tiny.NEW or importlib.util.find_spec("transformers.models.siglip.check") is not None
LEFT_OUT: dict[str, str] = {}  # why a file is not run here, for docs/policies/verification.md
if tiny.NEW:
    of_both = (
        "adapters",
        "hilserl",
        "learning",
        "pi_recipe",
        "plugins",
        "prefix_training",
        "recipe",
    )
    LEFT_OUT |= dict.fromkeys(
        (f"test_{name}.py" for name in of_both),
        "it runs with LeRobot 0.4 only",
    )
else:
    LEFT_OUT |= {"test_rollout.py": "LeRobot 0.4 has no lerobot-rollout"}
if not PATCHED:
    LEFT_OUT |= dict.fromkeys(
        ("test_pi.py", "test_pi_calls.py", "test_pi_recipe.py"),
        "this transformers lacks openpi's changes",
    )
if not hasattr(PI05Config, LONGEST_PREFIX):
    LEFT_OUT["test_prefixes.py"] = "the newest release of LeRobot, 0.6.1, gives π0.5 no prefixes"
if importlib.util.find_spec("ray") is None:
    of_ray = (
        "test_async_client.py",
        "test_commands.py",
        "test_hilserl.py",
        "test_prefix_training.py",
        "test_training.py",
    )
    LEFT_OUT |= dict.fromkeys(of_ray, "this environment has no Ray")
collect_ignore = list(LEFT_OUT)

Load = Callable[..., LeRobot]
Made = Callable[[str], Path]
# LeRobot 0.4.4's VQ-BeT decorates with an autocast that torch has another name for.
FILTERS = [pytest.mark.filterwarnings("ignore:`torch.cuda.amp.autocast:FutureWarning")]
TASKS = ("pick up the cube", "open the drawer, then close it again", "push")


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Returns the checkpoint of a kind, which is written once."""

    @functools.cache
    def make(kind: str) -> Path:
        return tiny.make(tmp_path_factory.mktemp(kind), kind)

    return make


@pytest.fixture(scope="session")
def loaded(made: Made) -> Load:
    """Returns a policy with the checkpoint of a kind, which is loaded once for each setting."""

    @functools.cache
    def load(kind: str, **config: Any) -> LeRobot:
        policy = LeRobot.from_config({"checkpoint": str(made(kind)), **config})
        policy.initialize()
        return policy

    return load


@pytest.fixture
def connected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gives LeRobot's guidance the gradient of its velocity, as in the paper.

    LeRobot computes the velocity before it calls `requires_grad_`, so that its gradient is the
    identity.
    """
    denoise = RTCProcessor.denoise_step

    def denoise_with_gradient(self: Any, **options: Any) -> Any:
        step = options["original_denoise_step_partial"]
        if options["prev_chunk_left_over"] is None:
            return denoise(self, **options)
        connect = {"original_denoise_step_partial": lambda noisy: step(noisy.requires_grad_())}
        return denoise(self, **{**options, **connect})

    monkeypatch.setattr(RTCProcessor, "denoise_step", denoise_with_gradient)


def view(seed: int = 0, side: int = tiny.SIDE, **info: Any) -> Obs:
    """Return the observation of a robot."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (side, side, 3), dtype=np.uint8)
    return Obs(
        cameras={tiny.CAMERA: image},
        state={"joints": rng.uniform(-1, 1, tiny.STATE).astype(np.float32)},
        info=info,
    )


def begun(policy: LeRobot, number: int = 0) -> LeRobot:
    """Return the session of a robot as a server makes it, in an episode."""
    session = AgentCopies(policy).make()
    session.reset(view(number), TASKS[number % len(TASKS)], seed=number)
    assert isinstance(session, LeRobot)
    return session
