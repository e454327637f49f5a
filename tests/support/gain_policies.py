"""Policies with one parameter that a learner trains, in this process and in a child process."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.serve.weights import WeightsVersion
from vlagents_ray.weights import trainable


class Gain(TrainableAgent):
    """A policy that returns its parameter and a random number of the session."""

    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {"layer": {"gain": np.zeros(2, np.float32)}}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.rng = np.random.default_rng(kwargs.get("seed", 0))
        return {"gain": float(self.tree["layer"]["gain"][0])}

    def act(self, obs: Obs) -> Act:
        return Act(np.append(self.tree["layer"]["gain"], self.rng.random()))


class Doubled(Gain):
    """A policy that doubles its parameter in place once per version, and computes its actions from
    the doubled value.
    """

    def initialize(self) -> None:
        super().initialize()
        self.twice = np.zeros(2, np.float32)

    def shared_objects(self) -> list[Any]:
        return [*super().shared_objects(), self.twice]

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        np.copyto(self.tree["layer"]["gain"], values["layer/gain"])
        np.copyto(self.twice, 2 * values["layer/gain"])

    def act(self, obs: Obs) -> Act:
        return Act(np.append(self.twice / 2, self.rng.random()))


class DyingInAPush(Gain):
    """A policy whose process ends when the values of a push are checked."""

    def initialize(self) -> None:
        super().initialize()
        trainable.accepted = lambda *_, **__: os._exit(9)

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        super().load_parameters(values)


class Counting(Doubled):
    """A policy that reports how many versions of weights its process keeps."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        held = [one for one in gc.get_objects() if isinstance(one, WeightsVersion)]
        return super().reset(obs, instruction, **kwargs) | {"versions": len(held)}


class OnSharedMemory(TrainableAgent):
    """A policy with a torch layer in shared CPU memory, which simulates a GPU's memory."""

    trainable: ClassVar[str | None] = "layer"

    def initialize(self) -> None:
        import torch
        from shared_cpu_memory import SharedCpuMemory

        SharedCpuMemory().install()
        self.layer = torch.nn.Linear(2, 2)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"weight": float(self.layer.weight[0, 1])}

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1))


def gains(gain: float) -> dict[str, Any]:
    """Return the parameters with that gain."""
    return {"layer/gain": np.full(2, gain, np.float32)}


def in_child(policy: str = "Gain", **config: Any) -> Any:
    """Return the proxy of one of these policies, or of the policy "module:Class", in a child
    process.
    """
    from vlagents_ray.serve.python_env.child_agent import ChildAgent
    from vlagents_ray.serve.python_env.child_main import Settings
    from vlagents_ray.serve.python_env.child_process import ChildProgram

    here, policy = Path(__file__).parent, policy if ":" in policy else f"gain_policies:{policy}"
    paths = os.pathsep.join([str(here), str(here.parents[1])])
    return ChildAgent(
        ChildProgram(sys.executable, Settings(policy, config, 16, "1"), {"PYTHONPATH": paths})
    )
