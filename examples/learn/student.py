"""The student: a small trainable policy for images and words that also estimates a value, for
reinforcement learning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from colours import BINS, WORDS, named_colour, places
from torch import nn

from vlagents_ray.contract import Contract
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import MissingCamera, MissingState
from vlagents_ray.interface import BEHAVIOUR, WANT, Act, Agent, Obs, TrainableAgent

ACTION = 4  # number of values of an action: x, y, z, gripper
STATE = 4  # number of values of the robot's state: x, y, z, gripper
INPUTS = 3 * BINS + STATE + len(WORDS)  # number of values of an input
_LOOKS = 3  # number of positions that the network attends to
FEATURES = _LOOKS * 9 + STATE  # number of inputs of the network's heads
_ROWS = 16  # number of rows of a forward pass
_METRES = 5.0  # scale of the robot's position, units per m


def inputs(obs: Obs, colour: str) -> np.ndarray:
    """Return the network's input for an observation, (INPUTS,) float32.

    Args:
        obs: The observation, with the camera "front", the state "xyzrpy" and the gripper.
        colour: The puck's colour, one of `WORDS`.
    """
    if "front" not in obs.cameras:
        raise MissingCamera("front", have=obs.cameras)
    if "xyzrpy" not in obs.state:
        raise MissingState("xyzrpy", have=obs.state)
    robot = [*(_METRES * obs.state["xyzrpy"][:3]), float(obs.gripper or 0.0)]
    word = [float(colour == one) for one in WORDS]
    return np.concatenate([places(obs.cameras["front"]).ravel(), robot, word]).astype(np.float32)


class LookingNetwork(nn.Module):
    """A network that attends to the positions of the colours that the word selects, and to the
    fingers.
    """

    def __init__(self) -> None:
        super().__init__()
        self.look = nn.Linear(len(WORDS), BINS * _LOOKS)
        self.aim = nn.Linear(2, 2)  # from positions in the camera's frame to the robot's frame
        with torch.no_grad():
            self.aim.weight.copy_(torch.eye(2) * _METRES / 10)
            self.aim.bias.zero_()

    def features(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the inputs of the network's heads, (B, FEATURES), from inputs (B, INPUTS)."""
        seen, robot, word = inputs.split([3 * BINS, STATE, len(WORDS)], dim=-1)
        seen = seen.unflatten(-1, (BINS, 3))
        scores = 8 * self.look(word).unflatten(-1, (_LOOKS, BINS)) + torch.log(
            seen[:, None, :, 0] + 1e-4
        )
        looked = scores.softmax(-1) @ seen  # (B, LOOKS, 3)
        away = self.aim(looked[..., 1:]) - robot[:, None, :2]
        scales = [away, torch.tanh(4 * away), torch.tanh(20 * away)]
        return torch.cat([torch.cat([looked, *scales], -1).flatten(1), robot], -1)


def head(out: int) -> nn.Module:
    """Return a new perceptron from features to `out` numbers."""
    hidden = 192
    return nn.Sequential(
        nn.Linear(FEATURES, hidden),
        nn.SiLU(),
        nn.Linear(hidden, hidden),
        nn.SiLU(),
        nn.Linear(hidden, out),
    )


class Network(LookingNetwork):
    """Maps inputs (B, INPUTS) to means of actions (B, 4) and values (B,); `log_std` is (4,)."""

    def __init__(self) -> None:
        super().__init__()
        self.policy, self.value = head(ACTION), head(1)
        self.log_std = nn.Parameter(torch.full((ACTION,), -2.3))

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.features(inputs)
        return self.policy(features), self.value(features).squeeze(-1)


def seeded(make: Callable[[], nn.Module], seed: int) -> Any:
    """Return a new network with random weights of this seed, without changing torch's generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


class Student(TrainableAgent):
    """Returns the mean of a normal distribution as action, or draws from the distribution if a
    log-probability is requested.
    """

    trainable = "network"
    shared = ("network",)
    behaviour: tuple[str, ...] = ("logprob", "value")  # values that it returns for a learner
    network_class: type[LookingNetwork] = Network

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self.network: Any = None
        self._colour = ""
        self._draws = np.random.default_rng(seed)

    def initialize(self) -> None:
        torch.set_num_threads(1)
        self.network = seeded(self.network_class, self.seed)

    @property
    def contract(self) -> Contract:
        return replace(
            Tabletop.known_contract({"width": None, "height": None}), behaviour=self.behaviour
        )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of `tabletop/lift`.

        Raises:
            InvalidObservation: The instruction names no puck.
        """
        self._colour = named_colour(instruction)
        self._draws = np.random.default_rng(kwargs.get("seed") or 0)
        return {}

    def act(self, obs: Obs) -> Act:
        return self.act_batch([obs], [self])[0]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Compute the actions of all sessions.

        All passes have the same size, so that a result does not depend on other sessions.
        """
        rows = np.zeros((-len(obs) // _ROWS * -_ROWS, INPUTS), np.float32)
        for row, one, session in zip(rows, obs, sessions, strict=False):
            row[:] = inputs(one, session._colour)
        with torch.inference_mode():
            passes = [self.network(part) for part in torch.from_numpy(rows).split(_ROWS)]
            outputs = [torch.cat(parts)[: len(obs)].numpy() for parts in zip(*passes, strict=True)]
        answers: list[Act | Exception] = []
        for one, session, *own in zip(obs, sessions, *outputs, strict=True):
            if wanted := one.info.get(WANT):
                action, said = self._draw(session._draws, *own)
                answers.append(Act(action, info={BEHAVIOUR: {name: said[name] for name in wanted}}))
            else:
                answers.append(Act(self._best(*own)))
        return answers

    def _best(self, *outputs: Any) -> np.ndarray:
        """Return the action for one row of the network's outputs, (4,) float32."""
        mean: np.ndarray = outputs[0]
        return mean

    def _draw(self, draws: np.random.Generator, *outputs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Return an action drawn from the distribution, and its values for a learner."""
        mean, value = outputs
        log_std = self.network.log_std.detach().numpy()
        drawn = draws.standard_normal(ACTION).astype(np.float32)
        logprob = -0.5 * drawn**2 - log_std - 0.5 * math.log(2 * math.pi)
        return mean + np.exp(log_std) * drawn, {"logprob": logprob[None], "value": float(value)}
