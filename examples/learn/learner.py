"""The student's learner: behaviour cloning, and PPO with or without the advice of a teacher."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from colours import named_colour
from student import ACTION, INPUTS, LookingNetwork, Network, inputs, seeded

from vlagents_ray.client import RemoteAgent
from vlagents_ray.interface import Obs

# Gamma and lambda of generalised advantage estimation (arXiv 1506.02438)
DISCOUNT, TRACE = 0.98, 0.95
_CLIP = 0.2  # clip of PPO's ratio (arXiv 1707.06347)
_RATE, _LOOK_RATE = 2e-3, 1e-2  # learning rates of the network, and of its attention to colours
_PPO = 0.01  # weight of PPO's loss relative to the loss of the teacher's advice


def observations(columns: Mapping[str, np.ndarray]) -> list[Obs]:
    """Return the observations of transitions, in their order."""
    return [
        Obs(cameras={"front": image}, gripper=float(gripper), state={"xyzrpy": state})
        for image, gripper, state in zip(
            columns["cameras.front"], columns["gripper"], columns["state.xyzrpy"], strict=True
        )
    ]


def inputs_of(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the network's inputs for transitions, (T, INPUTS) float32."""
    rows = zip(observations(columns), columns["instruction"], strict=True)
    return np.stack([inputs(obs, named_colour(text)) for obs, text in rows])


def episodes(columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row and the number of rows of each episode, (E,) int64 each."""
    starts = np.flatnonzero(columns["t"] == 0)
    return starts, np.diff([*starts, len(columns["t"])])


def advice(teacher: RemoteAgent, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Request the action of a served teacher for each observation of whole episodes.

    Each episode is a session of the teacher. One message contains the next step of all sessions, so
    that the server computes the actions in batches.

    Args:
        teacher: The teacher's client.
        columns: The transitions of whole episodes.

    Returns:
        The teacher's actions, (T, 4) float32.
    """
    starts, lengths = episodes(columns)
    seen, texts = observations(columns), columns["instruction"]
    actions = np.empty_like(columns["action"])
    with ExitStack() as opened:
        sessions = teacher.sessions(len(starts))
        for session in sessions:
            opened.callback(session.close)
        for answer in teacher.reset_batch(
            [seen[i] for i in starts], [texts[i] for i in starts], sessions
        ):
            if isinstance(answer, Exception):
                raise answer
        for step in range(max(lengths)):
            going = np.flatnonzero(lengths > step)
            acts = teacher.act_batch(
                [seen[starts[i] + step] for i in going], [sessions[i] for i in going]
            )
            for i, act in zip(going, acts, strict=True):
                if isinstance(act, Exception):
                    raise act
                actions[starts[i] + step] = act.action
    return actions


def until_solved(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which transitions are used for learning, (T,) bool: all until the one that solves the
    task.
    """
    (starts, lengths), success = episodes(columns), columns["success"]
    before = np.cumsum(success) - success  # number of solved steps before each row
    kept: np.ndarray = before == np.repeat(before[starts], lengths)
    return kept


def advantages(
    columns: Mapping[str, np.ndarray], discount: float = DISCOUNT
) -> tuple[np.ndarray, np.ndarray]:
    """Return the advantages of the actions, and the targets of the values, each (T,) float32.

    The reward is 1 for the step that solves the task. This step ends the episode here, and later
    advantages and targets are 0. If the step limit ends an episode, the value of the last
    observation replaces the remaining rewards.
    """
    value, success, kept = columns["value"], columns["success"], until_solved(columns)
    gain = np.zeros(len(value), np.float32)
    following, later = 0.0, 0.0
    for i in reversed(np.flatnonzero(kept)):
        last = i + 1 == len(value) or columns["t"][i + 1] == 0
        if last or success[i]:
            following, later = (0.0 if success[i] else float(value[i])), 0.0
        later = (
            float(success[i]) + discount * following - float(value[i]) + discount * TRACE * later
        )
        gain[i], following = later, float(value[i])
    return gain, np.where(kept, gain + value, 0.0).astype(np.float32)


class NetworkLearner(ABC):
    """Trains a student's network with behaviour cloning, and with the algorithm of a subclass on
    the student's episodes.
    """

    want: tuple[str, ...]
    """The values that the student returns for `improve`, in addition to its actions."""
    network_class: type[LookingNetwork]
    batch = 256
    """The number of transitions in a step."""
    steps_at_once = 500
    """The number of steps of `improve` on the same transitions, unless the plan sets another
    number.
    """
    rate: float | None = None
    """The learning rate of `improve`; None uses the rates of `imitate`."""

    def __init__(self, seed: int = 0) -> None:
        """Make a new network."""
        self._seed = seed
        self.steps = 0
        """The number of steps so far."""
        self.network = seeded(self.network_class, seed)
        look = list(self.network.look.parameters())
        others = [
            one for name, one in self.network.named_parameters() if not name.startswith("look.")
        ]
        self._optimizer = torch.optim.Adam(
            [{"params": look, "lr": _LOOK_RATE}, {"params": others, "lr": _RATE}]
        )
        self._seen = np.empty((0, INPUTS), np.float32)
        self._advised = np.empty((0, ACTION), np.float32)  # the teacher's action for each input

    def state(self) -> dict[str, Any]:
        """Return the weights, for a `Publisher`."""
        return dict(self.network.state_dict())

    def checkpoint(self) -> dict[str, Any]:
        """Return the state that `restore` needs to continue."""
        return {
            "steps": self.steps,
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "seen": torch.from_numpy(self._seen),
            "advised": torch.from_numpy(self._advised),
        }

    def restore(self, checkpoint: Mapping[str, Any]) -> None:
        """Continue from a checkpoint."""
        self.steps = checkpoint["steps"]
        self.network.load_state_dict(checkpoint["network"])
        # Copied, since torch would share and change it.
        self._optimizer.load_state_dict(deepcopy(checkpoint["optimizer"]))
        self._seen, self._advised = checkpoint["seen"].numpy(), checkpoint["advised"].numpy()

    def add_advice(self, seen: np.ndarray, actions: np.ndarray) -> None:
        """Add actions of the teacher to the data for imitation.

        Args:
            seen: The inputs of the network, (T, INPUTS).
            actions: The teacher's actions, (T, 4).
        """
        self._seen = np.concatenate([self._seen, seen])
        self._advised = np.concatenate([self._advised, actions])

    def imitate(self, steps: int) -> float:
        """Take optimizer steps towards the teacher's advice, and return the error of the last
        step.
        """
        error, rng = torch.zeros(()), self._generator()
        for _ in range(steps):
            error = self._distance_to_advice(rng)
            self._step(error)
        return float(error.detach())

    @abstractmethod
    def improve(self, columns: Mapping[str, np.ndarray], steps: int) -> None:
        """Take optimizer steps on the transitions of the student's own episodes.

        Args:
            columns: The transitions, with the values that the learner needs.
            steps: The number of steps.
        """

    def _begin_improving(self) -> np.random.Generator:
        if self.rate is not None:
            for group in self._optimizer.param_groups:
                group["lr"] = self.rate
        return self._generator()

    def _distance_to_advice(self, rng: np.random.Generator) -> Any:
        rows = self._drawn(rng, len(self._seen))
        return self._error(self._tensor(self._seen, rows), self._advised[rows])

    def _error(self, seen: Any, actions: np.ndarray) -> Any:
        """Return the mean squared error of the network's actions."""
        mean, _ = self.network(seen)
        return ((mean - torch.from_numpy(actions)) ** 2).mean()

    def _clipped(self, ratio: Any, gain: Any) -> Any:
        """Return the clipped objective of PPO for ratios of probabilities, and advantages."""
        return torch.minimum(ratio * gain, ratio.clamp(1 - _CLIP, 1 + _CLIP) * gain).mean()

    def _generator(self) -> np.random.Generator:
        """Return a random generator that is the same after a restore."""
        return np.random.default_rng([self._seed, self.steps])

    def _drawn(self, rng: np.random.Generator, number: int) -> np.ndarray:
        """Return the rows of a batch."""
        return rng.integers(number, size=min(self.batch, number))

    def _tensor(self, values: np.ndarray, rows: np.ndarray) -> Any:
        return torch.from_numpy(np.asarray(values, np.float32)[rows])

    def _step(self, loss: Any) -> None:
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()
        self.steps += 1


class PPOLearner(NetworkLearner):
    """Trains the student's network with PPO."""

    want = ("logprob", "value")
    # Uses the transitions of 32 episodes ten times; more steps would fit their noise.
    steps_at_once = 40
    rate: float | None = 1e-4
    network_class = Network

    def improve(self, columns: Mapping[str, np.ndarray], steps: int) -> None:
        rng = self._begin_improving()
        seen, (gain, targets), kept = (
            inputs_of(columns),
            advantages(columns),
            np.flatnonzero(until_solved(columns)),
        )
        gain = (gain - gain[kept].mean()) / (gain[kept].std() + 1e-6)
        for _ in range(steps):
            rows = kept[self._drawn(rng, len(kept))]
            mean, value = self.network(self._tensor(seen, rows))
            normal = torch.distributions.Normal(mean, self.network.log_std.exp())
            logprob = normal.log_prob(self._tensor(columns["action"], rows)).sum(-1)
            ratio = (logprob - self._tensor(columns["logprob"], rows)).exp()
            loss = ((value - self._tensor(targets, rows)) ** 2).mean() - self._clipped(
                ratio, self._tensor(gain, rows)
            )
            self._step(self._advised_loss(loss, rng))

    def _advised_loss(self, loss: Any, _: np.random.Generator) -> Any:
        return loss


class RPDLearner(PPOLearner):
    """Trains with refined policy distillation (arXiv 2503.05833), which adds the distance to a
    teacher's advice to PPO's loss.
    """

    # More steps, since the advice has no noise and stays valid.
    steps_at_once = NetworkLearner.steps_at_once
    rate = None

    def _advised_loss(self, loss: Any, rng: np.random.Generator) -> Any:
        return _PPO * loss + self._distance_to_advice(rng)
