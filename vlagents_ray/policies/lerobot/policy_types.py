"""The types of LeRobot's policies, and how each one computes the chunks of many sessions.

LeRobot's `select_action` keeps observations, actions and plans in the policy object, for one robot. The classes here
use its functions without state, and pass them the state of each session.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.flow import RandomSteps
from vlagents_ray.policies.lerobot.guidance import Guidance
from vlagents_ray.registry import require

IMAGES = "observation.images"
FRAMES = (
    "observation.state",
    "observation.environment_state",
    IMAGES,
)  # inputs of each step of a history
RESIZING = {"smolvla", "pi0", "pi05", "pi0_fast", "wall_x"}  # they resize images themselves
MASKING = {"smolvla", "pi0", "pi05", "pi0_fast", "xvla"}
REFUSED = {
    "reward_classifier": "it returns rewards, not actions",
    "sarm": "it returns rewards, not actions",
    "groot": "its statistics cannot be checked in LeRobot 0.4.4; serve it with GR00T's own code",
}


class Kind:
    """The default for any type: one row at a time with a seed of its session, which is slow and exact."""

    batched = False
    random: RandomSteps | None = None  # of the last chunks that were drawn

    def __init__(self, policy: Any) -> None:
        self.policy, self.config = policy, policy.config
        if type(self) is Kind and self.steps > 1:
            raise ConfigError(
                f"checkpoint: {policy.name!r} keeps {self.steps} observations by itself, so that sessions would mix; "
                f"want one of {sorted(KINDS)}, or a policy with n_obs_steps 1"
            )

    @property
    def steps(self) -> int:
        """The number of observations that the policy gets."""
        return int(self.config.n_obs_steps)

    @property
    def horizon(self) -> int:
        """The number of rows of a chunk, from the current tick on."""
        return int(getattr(self.config, "chunk_size", 0) or self.config.n_action_steps)

    @property
    def usual(self) -> int:
        """The number of rows that the policy executes before the next inference, by its config."""
        return min(int(getattr(self.config, "n_action_steps", self.horizon)), self.horizon)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        """Return the indices of the rows whose observations `draw` needs: all, unless samples share one."""
        return list(range(len(rows)))

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        """Compute chunks in the policy's own units.

        Args:
            batch: The output of the policy's pre-processor, for the rows of `observations`.
            rows: The rows of the batch.
            leftovers: The leftover actions of each row, (H', D) in the same units, or None.

        Returns:
            The chunks, (B, horizon, D).
        """
        from vlagents_ray.policies.lerobot.sampling_rng import seeded

        [row] = rows
        with seeded(row.rng, require("torch").device(self.config.device)):
            self.policy.reset()
            return self._alone(batch, row)

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        return self.policy.predict_action_chunk(batch)


class ActPolicy(Kind):
    """ACT, whose latent is zero at inference, so that nothing is random."""

    batched = True

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        return self.policy.predict_action_chunk(batch)


class Flow(Kind):
    """SmolVLA, π0 and π0.5: flow matching from noise of the sessions, guided by their leftovers.

    What an observation is encoded to is shared by the samples of its session.
    """

    batched = True
    noise_level = 0.0  # as for `RandomSteps`

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        self.guidance = Guidance(policy.rtc_processor)
        policy.model.rtc_processor = self.guidance

    @property
    def flow_steps(self) -> int:
        """The number of steps from noise to actions."""
        config = self.config
        return int(config.num_steps if config.type == "smolvla" else config.num_inference_steps)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        return self._shared(rows)[0]

    def _shared(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return `shared_frames`, or each row by itself in a compiled model, which has few sizes of batches."""
        each = list(range(len(rows)))
        return (each, each) if self.config.compile_model else shared_frames(rows)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        torch = require("torch")
        shape = (self.horizon, int(self.config.max_action_dim))

        def convert(array: np.ndarray) -> Any:
            return torch.from_numpy(array).to(self.config.device)

        wanted: dict[str, Any] = {"noise": convert(np.stack([row.noise(*shape) for row in rows]))}
        if any(left is not None for left in leftovers):
            wanted |= self._guide(rows, leftovers, shape)
        self.random = RandomSteps.of(rows, (self.flow_steps, *shape), self.noise_level, convert)
        return self._follow(batch, rows, {**wanted, "execution_horizon": self.random})

    def _follow(self, batch: dict[str, Any], rows: Sequence[Row], wanted: dict[str, Any]) -> Any:
        firsts, owners = self._shared(rows)
        if len(firsts) == len(rows):
            return self.policy.predict_action_chunk(batch, **wanted)
        model, caches = self.policy.model, list[Any]()
        step = model.denoise_step

        def denoise_step(x_t: Any, past_key_values: Any, **encoded: Any) -> Any:
            """Denoise the actions of all rows with what was encoded for their observations."""
            if not caches:  # in the first of the steps
                caches.append(_indexed(past_key_values, owners))
            each = {name: tensor[owners] for name, tensor in encoded.items()}
            return step(x_t=x_t, past_key_values=caches[0], **each)

        model.denoise_step = denoise_step
        try:
            return self.policy.predict_action_chunk(batch, **wanted)
        finally:
            del model.denoise_step

    def _guide(self, rows: Sequence[Row], leftovers: Sequence[Any], shape: tuple[int, int]) -> dict[str, Any]:
        torch = require("torch")
        target, weights = torch.zeros(len(rows), *shape), torch.zeros(len(rows), shape[0], 1)
        for i, (row, left) in enumerate(zip(rows, leftovers, strict=True)):
            if left is not None:
                part = self._encoded(left)[: shape[0]]
                target[i, : len(part), : part.shape[1]] = part
                weights[i, :, 0] = self.guidance.weights(row.delay, len(part), shape[0])
        device = self.config.device
        return {"prev_chunk_left_over": target.to(device), "inference_delay": weights.to(device)}

    def _encoded(self, left: Any) -> Any:
        """Convert a leftover to the units of π0's ALOHA, if SmolVLA was trained in these."""
        if not getattr(self.config, "adapt_to_pi_aloha", False):
            return left
        return self.policy._pi_aloha_encode_actions_inv(left[None].clone())[0]


class Fast(Kind):
    """π0-FAST, which decodes tokens only for the rows that are executed."""

    @property
    def horizon(self) -> int:
        return int(self.config.n_action_steps)


class XVla(Kind):
    """X-VLA, which draws its noise itself and masks no padding, so that a batch needs instructions of one length."""

    @property
    def batched(self) -> bool:  # type: ignore[override]
        return bool(self.config.pad_language_to == "max_length")

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.lerobot.sampling_rng import RowDraws

        with RowDraws([row.rng for row in rows]):
            return self.policy.predict_action_chunk(batch)


class Diffusion(Kind):
    """Diffusion policies, with noise for the first sample and, with DDPM, for every denoising step."""

    batched = True

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.lerobot.sampling_rng import generator_of

        torch, model = require("torch"), self.policy.diffusion
        noise = np.stack([row.noise(self.config.horizon, self.config.action_feature.shape[0]) for row in rows])
        actions = model.conditional_sample(
            len(rows),
            global_cond=model._prepare_global_conditioning(_stacked(batch, self.config, len(rows))),
            generator=[generator_of(row.rng) for row in rows],
            noise=torch.from_numpy(noise).to(self.config.device),
        )
        return actions[:, self.steps - 1 :]


class VqBet(Kind):
    """VQ-BeT, which samples the codes of its residual VQ; checkpoints of its first training phase have none."""

    batched = True

    def __init__(self, policy: Any) -> None:
        super().__init__(policy)
        if not policy.vqbet.action_head.vqvae_model.discretized.item():
            raise ConfigError("checkpoint: VQ-BeT's residual VQ is not trained in it; train on, or name a later step")

    @property
    def horizon(self) -> int:
        return int(self.config.action_chunk_size)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.lerobot.sampling_rng import RowDraws

        with RowDraws([row.rng for row in rows]):
            return self.policy.vqbet(_stacked(batch, self.config, len(rows)), rollout=True)


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
    """SAC, with single actions and no state between them."""

    @property
    def horizon(self) -> int:
        return 1

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        return self.policy.select_action(batch)[:, None]


KINDS: Mapping[str, type[Kind]] = {
    "act": ActPolicy,
    "diffusion": Diffusion,
    "pi0": Flow,
    "pi05": Flow,
    "pi0_fast": Fast,
    "sac": Single,
    "smolvla": Flow,
    "tdmpc": Tdmpc,
    "vqbet": VqBet,
    "xvla": XVla,
}


def _indexed(cache: Any, index: list[int]) -> Any:
    """Return a cache of keys and values with a row for each of `index`: SmolVLA's, or one of transformers."""
    if isinstance(cache, dict):
        return {layer: {name: kept[index] for name, kept in both.items()} for layer, both in cache.items()}
    cache.batch_select_indices(require("torch").tensor(index))
    return cache


def _stacked(batch: dict[str, Any], config: Any, rows: int) -> dict[str, Any]:
    """Reshape (rows * steps, …) to (rows, steps, …), with the cameras in one tensor (rows, steps, cameras, 3, H, W)."""
    if config.image_features:
        images = [batch[key] for key in config.image_features]
        batch = {**batch, IMAGES: require("torch").stack(images, dim=1)}
    return {key: batch[key].unflatten(0, (rows, -1)) for key in FRAMES if key in batch}
