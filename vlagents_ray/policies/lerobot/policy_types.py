"""The types of LeRobot's policies, and how each one computes the chunks of many sessions.

LeRobot's `select_action` keeps observations, actions and plans in the policy object, for one robot. The classes here
use its functions without state, and pass them the state of each session.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.lerobot.kinds.diffusion import Diffusion, MultiTaskDit
from vlagents_ray.policies.lerobot.kinds.flow import Flow
from vlagents_ray.policies.lerobot.kinds.groot import Groot
from vlagents_ray.policies.lerobot.kinds.kind import IMAGES, Kind, stacked, vectors
from vlagents_ray.registry import require

RESIZING = {"groot", "smolvla", "pi0", "pi05", "pi0_fast", "wall_x"}  # they resize images themselves
MASKING = {"smolvla", "pi0", "pi05", "pi0_fast", "xvla"}


class ActPolicy(Kind):
    """ACT, whose latent is zero at inference, so that nothing is random."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._act = compilation.core("act", self._actions)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        return self._act(*(batch[key] for key in (*vectors(self.config), *self.config.image_features)))

    def _actions(self, *inputs: Any) -> Any:
        names = vectors(self.config)
        batch = dict(zip(names, inputs, strict=False))
        if images := inputs[len(names) :]:
            batch[IMAGES] = list(images)
        return self.policy.model(batch)[0]


class Fast(Kind):
    """π0-FAST, which decodes tokens only for the rows that are executed."""

    @property
    def horizon(self) -> int:
        return int(self.config.n_action_steps)


class Evo1(Kind):
    """EVO-1, whose post-processor takes away what its actions are padded with."""

    @property
    def dim(self) -> int:
        return int(self.config.max_action_dim)


class XVla(Kind):
    """X-VLA, which draws its noise itself and masks no padding, so that a batch needs instructions of one length."""

    @property
    def batched(self) -> bool:  # type: ignore[override]
        return bool(self.config.pad_language_to == "max_length")

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._look = policy.model.forward_vlm

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.sampling_rng import RowDraws

        firsts, owners = shared_frames(rows)

        def look(*inputs: Any) -> dict[str, Any]:
            """Run the vision-language encoder once for each observation."""
            return {name: one[owners] for name, one in self._look(*(each[firsts] for each in inputs)).items()}

        self.policy.model.forward_vlm = look
        with RowDraws([row.rng for row in rows]):
            return self.policy.predict_action_chunk(batch)


class VqBet(Kind):
    """VQ-BeT, which samples the codes of its residual VQ; checkpoints of its first training phase have none."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        if not policy.vqbet.action_head.vqvae_model.discretized.item():
            raise ConfigError("checkpoint: VQ-BeT's residual VQ is not trained in it; train on, or name a later step")

    @property
    def horizon(self) -> int:
        return int(self.config.action_chunk_size)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.sampling_rng import RowDraws

        with RowDraws([row.rng for row in rows]):
            return self.policy.vqbet(stacked(batch, self.config, len(rows)), rollout=True)


class Tdmpc(Kind):
    """TD-MPC, whose random trajectories and Q functions are shared by a batch, so that it runs one row at a time.

    The plan of a session's last tick, from which the next one starts, is in `row.memory`.
    """

    @property
    def horizon(self) -> int:
        if self.config.n_action_repeats > 1:
            return int(self.config.n_action_repeats)
        return int(self.config.horizon) if self.config.use_mpc else 1

    @property
    def usual(self) -> int:
        return self.horizon if self.config.n_action_repeats > 1 else int(self.config.n_action_steps)

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        torch, policy = require("torch"), self.policy
        if (mean := row.memory.get("mean")) is not None:
            policy._prev_mean = torch.from_numpy(mean).to(self.config.device)
        latent = policy.model.encode(batch)
        actions = policy.plan(latent) if self.config.use_mpc else policy.model.pi(latent)[None]  # (horizon, 1, D)
        actions = actions.clamp(-1, 1)
        if policy._prev_mean is not None:
            row.memory["mean"] = policy._prev_mean.cpu().numpy()
        repeats = self.config.n_action_repeats
        return (actions[:1].expand(repeats, -1, -1) if repeats > 1 else actions).transpose(0, 1)


class Single(Kind):
    """SAC, which LeRobot 0.6 calls `gaussian_actor`, with single actions and no state between them."""

    @property
    def horizon(self) -> int:
        return 1

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        return self.policy.select_action(batch)[:, None]


KINDS: Mapping[str, type[Kind]] = {
    "act": ActPolicy,
    "diffusion": Diffusion,
    "evo1": Evo1,
    "gaussian_actor": Single,
    "groot": Groot,
    "multi_task_dit": MultiTaskDit,
    "pi0": Flow,
    "pi05": Flow,
    "pi0_fast": Fast,
    "sac": Single,
    "smolvla": Flow,
    "tdmpc": Tdmpc,
    "vqbet": VqBet,
    "xvla": XVla,
}
