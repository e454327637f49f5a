"""The student's learner: behaviour cloning, and PPO with or without the advice of a teacher."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.client import RemoteAgent
from vlagents_ray.interface import Obs
from vlagents_ray.learn.tabletop.colours import named_colour
from vlagents_ray.learn.tabletop.student import inputs, make_network
from vlagents_ray.registry import require

if TYPE_CHECKING:
    from typing_extensions import Self

DISCOUNT, TRACE = 0.98, 0.95  # gamma and lambda of generalised advantage estimation (arXiv 1506.02438)
_CLIP = 0.2  # of PPO's ratio (arXiv 1707.06347)
_RATE, _LOOK_RATE = 2e-3, 1e-2  # learning rates of the network, and of its choice of colours
_BATCH = 256
_PPO = 0.01  # weight of PPO's loss beside the teacher's advice


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


def advice(teacher: RemoteAgent, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Ask a served teacher what it would have done at each observation of whole episodes.

    Each episode is a session of the teacher, and one message asks for the next step of all of them, so that its server
    computes them in batches.

    Args:
        teacher: The teacher's client.
        columns: The transitions of whole episodes.

    Returns:
        Its actions, (T, 4) float32.
    """
    starts = np.flatnonzero(columns["t"] == 0)
    lengths = np.diff([*starts, len(columns["t"])])
    seen, texts = observations(columns), columns["instruction"]
    sessions = teacher.sessions(len(starts))
    for answer in teacher.reset_batch([seen[i] for i in starts], [texts[i] for i in starts], sessions):
        if isinstance(answer, Exception):
            raise answer
    actions = np.empty_like(columns["action"])
    for step in range(max(lengths)):
        going = np.flatnonzero(lengths > step)
        acts = teacher.act_batch([seen[starts[i] + step] for i in going], [sessions[i] for i in going])
        for i, act in zip(going, acts, strict=True):
            if isinstance(act, Exception):
                raise act
            actions[starts[i] + step] = act.action
    for session in sessions:
        session.close()
    return actions


def advantages(columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the advantages of the actions, and the targets of the values, each (T,) float32.

    Step limits alone end episodes, so that the value of what would follow is that of the last observation.
    """
    found = np.zeros(len(columns["reward"]), np.float32)
    following, later = 0.0, 0.0
    for i in reversed(range(len(found))):
        if i + 1 == len(found) or columns["t"][i + 1] == 0:
            following, later = float(columns["value"][i]), 0.0
        value = float(columns["value"][i])
        later = columns["reward"][i] + DISCOUNT * following - value + DISCOUNT * TRACE * later
        found[i], following = later, value
    return found, found + columns["value"]


class NetworkLearner:
    """Trains the network of a student by behaviour cloning; reinforcement is that of the classes below it."""

    make_network = staticmethod(make_network)

    def __init__(self, seed: int = 0) -> None:
        """Make a new network."""
        self._torch, self._seed = require("torch"), seed
        self.network = self.make_network(seed)
        self._rng = np.random.default_rng(seed)
        look = list(self.network.look.parameters())
        others = [one for name, one in self.network.named_parameters() if not name.startswith("look.")]
        self._optimizer = self._torch.optim.Adam([{"params": look, "lr": _LOOK_RATE}, {"params": others, "lr": _RATE}])

    def state(self) -> dict[str, Any]:
        """Return the weights, for a `Publisher`."""
        return dict(self.network.state_dict())

    def imitate(self, seen: np.ndarray, actions: np.ndarray, steps: int) -> float:
        """Take steps towards actions; return the error of the last step.

        Args:
            seen: Inputs of the network, (T, INPUTS).
            actions: What is to be done at each, (T, 4).
            steps: The number of steps.
        """
        error = self._torch.zeros(())
        for rows in self._batches(len(seen), steps):
            error = self._error(seen, actions, rows)
            self._step(error)
        return float(error.detach())

    def copy(self) -> Self:
        """Return another learner with the same weights, and an optimizer that begins anew."""
        other = type(self)(self._seed)
        other.network.load_state_dict(self.network.state_dict())
        return other

    def _error(self, seen: np.ndarray, actions: np.ndarray, rows: np.ndarray) -> Any:
        """Return the error of the network's actions in some rows: the mean squared one."""
        mean, _ = self.network(self._tensor(seen, rows))
        return ((mean - self._tensor(actions, rows)) ** 2).mean()

    def _clipped(self, ratio: Any, gain: Any) -> Any:
        """Return the clipped objective of PPO for ratios of probabilities, and advantages."""
        return self._torch.minimum(ratio * gain, ratio.clamp(1 - _CLIP, 1 + _CLIP) * gain).mean()

    def _batches(self, number: int, steps: int) -> Sequence[np.ndarray]:
        return [self._rng.integers(number, size=min(_BATCH, number)) for _ in range(steps)]

    def _tensor(self, values: np.ndarray, rows: np.ndarray) -> Any:
        return self._torch.from_numpy(np.asarray(values, np.float32)[rows])

    def _step(self, loss: Any) -> None:
        self._optimizer.zero_grad()
        loss.backward()
        self._torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self._optimizer.step()


class Learner(NetworkLearner):
    """Trains the student's network."""

    def improve(
        self, columns: Mapping[str, np.ndarray], steps: int, advised: tuple[np.ndarray, np.ndarray] | None = None
    ) -> None:
        """Take steps of PPO on the transitions of the student's own episodes.

        Args:
            columns: The transitions.
            steps: The number of steps.
            advised: Inputs and what the teacher would have done at each: then the squared error to that is a part of
                the loss, which makes it refined policy distillation (RPD, arXiv 2503.05833).
        """
        torch = self._torch
        seen, (gain, targets) = inputs_of(columns), advantages(columns)
        gain = (gain - gain.mean()) / (gain.std() + 1e-6)
        taught = self._batches(len(advised[0]), steps) if advised else []
        for step, rows in enumerate(self._batches(len(seen), steps)):
            mean, value = self.network(self._tensor(seen, rows))
            normal = torch.distributions.Normal(mean, self.network.log_std.exp())
            logprob = normal.log_prob(self._tensor(columns["action"], rows)).sum(-1)
            ratio = (logprob - self._tensor(columns["logprob"], rows)).exp()
            loss = ((value - self._tensor(targets, rows)) ** 2).mean() - self._clipped(ratio, self._tensor(gain, rows))
            if advised:
                loss = _PPO * loss + self._error(*advised, taught[step])
            self._step(loss)
