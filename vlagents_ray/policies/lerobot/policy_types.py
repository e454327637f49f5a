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
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, RandomSteps
from vlagents_ray.policies.flow_passes import FlowPasses, Pi0Passes
from vlagents_ray.policies.lerobot.guidance import Guidance
from vlagents_ray.policies.lerobot.smolvla import SmolVLAPasses
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

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        """Use a loaded policy, and mark its cores for compilation if its type has any."""
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

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._act = compilation.core("act", self._actions)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        return self._act(*(batch[key] for key in (*_vectors(self.config), *self.config.image_features)))

    def _actions(self, *inputs: Any) -> Any:
        vectors = _vectors(self.config)
        batch = dict(zip(vectors, inputs, strict=False))
        if images := inputs[len(vectors) :]:
            batch[IMAGES] = list(images)
        return self.policy.model(batch)[0]


class Flow(Kind):
    """SmolVLA, π0 and π0.5: flow matching from noise of the sessions, guided by their leftovers.

    What an observation is encoded to is shared by the samples of its session.
    """

    batched = True
    noise_level = 0.0  # as for `RandomSteps`

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self.guidance = Guidance(policy.rtc_processor)
        model = policy.model
        if policy.name == "smolvla":
            self.passes: FlowPasses = SmolVLAPasses(model, compilation)
        else:
            self.passes = Pi0Passes(model, compilation, stated=policy.name == "pi0")
        model.sample_actions = (
            self.passes.sample
        )  # which the policy calls between its own preparation of inputs and actions

    @property
    def flow_steps(self) -> int:
        """The number of steps from noise to actions."""
        config = self.config
        return int(config.num_steps if config.type == "smolvla" else config.num_inference_steps)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        return shared_frames(rows)[0]

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        torch = require("torch")
        shape = (self.horizon, int(self.config.max_action_dim))

        def convert(array: np.ndarray) -> Any:
            return torch.from_numpy(array).to(self.config.device)

        noise = convert(np.stack([row.noise(*shape) for row in rows]))  # before the steps', which only some rows draw
        self.random = RandomSteps.of(rows, (self.flow_steps, *shape), self.noise_level, convert)
        changes: list[Change] = []
        if any(left is not None for left in leftovers):
            plans = [None if left is None else self._encoded(left) for left in leftovers]
            changes.append(self.guidance.towards(plans, [row.delay for row in rows], shape, self.config.device))
        if self.random is not None:
            changes.append(self.random.change)
        return self.policy.predict_action_chunk(
            batch,
            noise=noise,
            owners=shared_frames(rows)[1],
            fingerprints=[row.adapter for row in rows],
            steps=self.flow_steps,
            changes=changes,
        )

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

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._look = policy.model.forward_vlm

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.lerobot.sampling_rng import RowDraws

        firsts, owners = shared_frames(rows)

        def look(*inputs: Any) -> dict[str, Any]:
            """Run the vision-language encoder once for each observation."""
            return {name: one[owners] for name, one in self._look(*(each[firsts] for each in inputs)).items()}

        self.policy.model.forward_vlm = look
        with RowDraws([row.rng for row in rows]):
            return self.policy.predict_action_chunk(batch)


class Diffusion(Kind):
    """Diffusion policies, with noise for the first sample and, with DDPM, for every denoising step."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        unet = policy.diffusion.unet
        self._denoise, self._look = compilation.core("denoise", unet.forward), compilation.core("look", self._condition)
        unet.forward = self._forward

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.lerobot.sampling_rng import generator_of

        torch, model = require("torch"), self.policy.diffusion
        noise = np.stack([row.noise(self.config.horizon, self.config.action_feature.shape[0]) for row in rows])
        actions = model.conditional_sample(
            len(rows),
            global_cond=self._look(*_stacked(batch, self.config, len(rows)).values()),
            generator=[generator_of(row.rng) for row in rows],
            noise=torch.from_numpy(noise).to(self.config.device),
        )
        return actions[:, self.steps - 1 :]

    def _forward(self, sample: Any, times: Any, global_cond: Any) -> Any:
        return self._denoise(sample, times, global_cond)

    def _condition(self, *inputs: Any) -> Any:
        names = [*_vectors(self.config), *([IMAGES] if self.config.image_features else [])]
        return self.policy.diffusion._prepare_global_conditioning(dict(zip(names, inputs, strict=True)))


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


def _vectors(config: Any) -> list[str]:
    """Return the observation keys of the vectors that a policy reads."""
    features = {FRAMES[0]: config.robot_state_feature, FRAMES[1]: config.env_state_feature}
    return [key for key, feature in features.items() if feature]


def _stacked(batch: dict[str, Any], config: Any, rows: int) -> dict[str, Any]:
    """Reshape (rows * steps, …) to (rows, steps, …), with the cameras in one tensor (rows, steps, cameras, 3, H, W)."""
    if config.image_features:
        images = [batch[key] for key in config.image_features]
        batch = {**batch, IMAGES: require("torch").stack(images, dim=1)}
    return {key: batch[key].unflatten(0, (rows, -1)) for key in FRAMES if key in batch}
