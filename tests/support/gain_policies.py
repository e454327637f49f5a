"""Policies with one parameter, which a learner trains, in this process and in a child process."""

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
    """Acts with its one parameter, and what a session has drawn."""

    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {"layer": {"gain": np.zeros(2, np.float32)}}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.rng = np.random.default_rng(kwargs.get("seed", 0))
        return {"gain": float(self.tree["layer"]["gain"][0])}

    def act(self, obs: Obs) -> Act:
        return Act(np.append(self.tree["layer"]["gain"], self.rng.random()))


class Doubled(Gain):
    """Computes its actions from twice its parameter, which it computes once for each version, in
    place.
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
    """Its process ends when the values of a push are checked."""

    def initialize(self) -> None:
        super().initialize()
        trainable.accepted = lambda *_, **__: os._exit(9)

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        super().load_parameters(values)


class Counting(Doubled):
    """States how many versions its process holds."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        held = [one for one in gc.get_objects() if isinstance(one, WeightsVersion)]
        return super().reset(obs, instruction, **kwargs) | {"versions": len(held)}


class OnSharedMemory(TrainableAgent):
    """Has a torch layer in memory of the CPU that takes the place of a GPU's."""

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
    """The parameters with that gain."""
    return {"layer/gain": np.full(2, gain, np.float32)}


def in_child(policy: str = "Gain", **config: Any) -> Any:
    """The proxy of one of these policies, or of "module:Class", in a child process."""
    from vlagents_ray.serve.python_env.child_agent import ChildAgent
    from vlagents_ray.serve.python_env.child_main import Settings
    from vlagents_ray.serve.python_env.child_process import ChildProgram

    here, policy = Path(__file__).parent, policy if ":" in policy else f"gain_policies:{policy}"
    paths = os.pathsep.join([str(here), str(here.parents[1])])
    return ChildAgent(
        ChildProgram(sys.executable, Settings(policy, config, 16, "1"), {"PYTHONPATH": paths})
    )
