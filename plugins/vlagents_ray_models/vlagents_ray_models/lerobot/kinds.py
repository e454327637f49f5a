"""The types of LeRobot's policies, and how each computes the chunks of many sessions.

LeRobot's `select_action` stores observations, actions and plans in the policy object, for one
robot. The classes here call its stateless functions, and pass them the state of each session.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.dataset_contract import DatasetContract
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.base.model_inputs import GRIPPER
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import Change, FlowPasses, Guide, RandomSteps
from vlagents_ray.registry import require
from vlagents_ray_models.key_value_cache import cache_of, layers_of, stack_of
from vlagents_ray_models.pi0_passes import Pi0Passes

# The config's field, of LeRobot after 0.6.1, for π0.5; 0: without prefixes.
LONGEST_PREFIX = "rtc_training_max_delay"
# Fields of π0.5's config in the same versions.
_MEMORIES = ("use_visual_memory", "use_proprioceptive_memory")
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images"
FRAMES = (STATE, "observation.environment_state", IMAGES)  # inputs of each step of a history


class Kind:
    """The default for any type: one row at a time with a seed from its session, which is slow
    but exact.
    """

    batched = False
    # The config's rows of a chunk, by preference.
    lengths: ClassVar[tuple[str, ...]] = ("chunk_size", "n_action_steps")
    random: RandomSteps | None = None  # of the last sampled chunks
    # Number of rows that the last sampled chunks were given, by the row of the batch.
    given: Mapping[int, int] = {}

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        """Use a loaded policy, and mark its core functions for compilation if its type has any."""
        self.policy, self.config = policy, policy.config
        self.staging = Staging(policy.config.device)
        if type(self) is Kind and self.steps > 1:
            raise ConfigError(
                f"checkpoint: {policy.name!r} keeps {self.steps} observations by itself, so that "
                "sessions would mix; want another type, or a policy with n_obs_steps 1"
            )

    @property
    def steps(self) -> int:
        """The number of observations that the policy reads."""
        return int(self.config.n_obs_steps)

    @property
    def horizon(self) -> int:
        """The number of rows of a chunk, counted from the current tick."""
        return int(
            getattr(self.config, self.lengths[0], 0) or getattr(self.config, self.lengths[-1])
        )

    @property
    def dim(self) -> int:
        """The number of values in an action that the policy returns to its post-processor."""
        return int(self.config.action_feature.shape[0])

    @property
    def usual(self) -> int:
        """The number of rows that the policy executes before the next inference, from its
        config.
        """
        return min(int(getattr(self.config, "n_action_steps", self.horizon)), self.horizon)

    def observations(self, rows: Sequence[Row]) -> list[int]:
        """Return the indices of the rows whose observations `draw` needs: all, unless samples
        share one.
        """
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
        from vlagents_ray_models.sampling_rng import seeded

        [row] = rows
        with seeded(row.rng, require("torch").device(self.config.device)):
            self.policy.reset()
            return self._alone(batch, row)

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        return self.policy.predict_action_chunk(batch)


def row_draws(rows: Sequence[Row], *models: Any) -> AbstractContextManager[object]:
    """Return the context in which models draw each row's numbers from that row's generator."""
    from vlagents_ray_models.sampling_rng import RowDraws  # imports torch

    return RowDraws([row.rng for row in rows], *models)


def vectors(config: Any) -> list[str]:
    """Return the observation keys of the vectors that a policy reads."""
    features = {FRAMES[0]: config.robot_state_feature, FRAMES[1]: config.env_state_feature}
    return [key for key, feature in features.items() if feature]


def stacked(batch: dict[str, Any], config: Any, rows: int) -> dict[str, Any]:
    """Reshape (rows * steps, …) to (rows, steps, …), with the cameras in one tensor (rows,
    steps, cameras, 3, H, W).
    """
    if config.image_features:
        images = [batch[key] for key in config.image_features]
        batch = {**batch, IMAGES: require("torch").stack(images, dim=1)}
    return {key: batch[key].unflatten(0, (rows, -1)) for key in FRAMES if key in batch}


_TOKENS = ("observation.language.tokens", "observation.language.attention_mask")


class Diffusion(Kind):
    """Diffusion policies, with noise for the first sample and, with DDPM, for every denoising
    step.
    """

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        unet = policy.diffusion.unet
        denoise = compilation.core("denoise", unet.forward)
        self._encode = compilation.core("vision encoder", self._condition)
        unet.forward = lambda sample, times, global_cond: denoise(sample, times, global_cond)  # noqa: PLW0108 - named

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray_models.sampling_rng import generator_of

        model = self.policy.diffusion
        noise = np.stack(
            [row.noise(self.config.horizon, self.config.action_feature.shape[0]) for row in rows]
        )
        actions = model.conditional_sample(
            len(rows),
            global_cond=self._encode(*stacked(batch, self.config, len(rows)).values()),
            generator=[generator_of(row.rng) for row in rows],
            noise=self.staging.upload(noise),
        )
        return actions[:, self.steps - 1 :]

    def _condition(self, *inputs: Any) -> Any:
        names = [*vectors(self.config), *([IMAGES] if self.config.image_features else [])]
        return self.policy.diffusion._prepare_global_conditioning(
            dict(zip(names, inputs, strict=True))
        )


class MultiTaskDit(Kind):
    """The multi-task diffusion transformer of LeRobot 0.6, by diffusion or flow matching, with
    an instruction.
    """

    batched = True

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        seen = stacked(batch, self.config, len(rows))
        for name in _TOKENS:
            # The same in each step of a history.
            seen[name] = batch[name].unflatten(0, (len(rows), -1))[:, -1]
        condition = self.policy.observation_encoder.encode(seen)
        # DDPM's steps draw in the latter.
        own = self.policy.objective, require("diffusers.utils.torch_utils")
        with row_draws(rows, *own):
            actions = self.policy.objective.conditional_sample(
                self.policy.noise_predictor, len(rows), condition
            )
        return actions[:, self.steps - 1 :]


class Flow(Kind):
    """SmolVLA, π0 and π0.5: flow matching from noise of the sessions, guided by their leftovers.

    A checkpoint that was trained with prefixes is given the first rows of a leftover instead, and
    no guidance.
    """

    batched = True
    noise_level = 0.0  # as for `RandomSteps`

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        model, config = policy.model, self.config
        if policy.name == "smolvla":
            self.passes: FlowPasses = SmolVLAPasses(model, compilation)
        else:
            self.passes = Pi0Passes(model, compilation, stated=policy.name == "pi0")
        self.flow_steps = int(
            config.num_steps if policy.name == "smolvla" else config.num_inference_steps
        )
        if memories := [name for name in _MEMORIES if getattr(config, name, False)]:
            raise ConfigError(
                f"checkpoint: has {memories}, want none: the policy object keeps them, so that "
                "sessions would mix"
            )
        # The policy calls it after preparing the inputs and before converting the actions.
        model.sample_actions = self.passes.sample
        trained = getattr(policy.rtc_processor.rtc_config, "mode", "guided") == "trained"
        self.longest = int(getattr(config, LONGEST_PREFIX)) if trained else 0  # rows of a prefix
        self.passes.by_row = trained

    def observations(self, rows: Sequence[Row]) -> list[int]:
        return self._shared(rows)[0]

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        shape = (self.horizon, int(self.config.max_action_dim))
        convert = self.staging.upload
        # This noise is drawn before that of the steps, which only some rows draw.
        noise = convert(np.stack([row.noise(*shape) for row in rows]))
        self.random = RandomSteps.for_rows(
            rows, (self.flow_steps, *shape), self.noise_level, convert
        )
        changes: list[Change] = []
        frozen = None
        given_rows: dict[int, int] = {}
        if any(left is not None for left in leftovers):
            plans = [None if left is None else self._encoded(left) for left in leftovers]
            prefixes = None
            if self.longest:
                prefixes = Guide.for_rows(list(map(self._prefixed, rows, plans)), *shape)
            if prefixes is not None:
                for i, plan in enumerate(plans):
                    if plan is not None:
                        given_rows[i] = int(prefixes.frozen[i].sum())
                prefixes = prefixes.to(convert)
                noise = prefixes.insert_frozen(noise)
                frozen = prefixes.frozen
                changes.append(prefixes.keep)
            else:
                delays = [row.delay for row in rows]
                changes.append(guided(self.policy.rtc_processor, plans, delays, shape, convert))
        if self.random is not None:
            changes.append(self.random.change)
        self.given = given_rows
        return self.policy.predict_action_chunk(
            batch,
            noise=noise,
            owners=self._shared(rows)[1],
            fingerprints=[row.adapter for row in rows],
            steps=self.flow_steps,
            changes=changes,
            frozen=frozen,
        )

    def _shared(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return the rows whose observations are read, and for each row the index of its
        observations among them.
        """
        # Each row's state is added to its actions.
        if getattr(self.config, "use_relative_actions", False):
            return list(range(len(rows))), list(range(len(rows)))
        return shared_frames(rows)

    def _prefixed(self, row: Row, plan: Any) -> Row:
        """Return the row with its plan in the policy's units, and the number of its rows that
        are given.
        """
        # Before the first answer its delay is unknown.
        delay = min(row.delay or self.longest, self.longest)
        return replace(row, leftover=None if plan is None else fetch(plan), delay=delay)

    def _encoded(self, left: Any) -> Any:
        """Convert a leftover to the units of π0's ALOHA, if SmolVLA was trained in these."""
        if not getattr(self.config, "adapt_to_pi_aloha", False):
            return left
        return self.policy._pi_aloha_encode_actions_inv(left[None].clone())[0]


def guided(
    processor: Any,
    plans: Sequence[Any],
    delays: Sequence[int],
    shape: tuple[int, int],
    convert: Any,
) -> Change:
    """Return the change of velocities that leads chunks to the leftovers of their sessions, as
    LeRobot does.

    Args:
        processor: The policy's `RTCProcessor`, for its settings and its schedule.
        plans: The leftover of each of the B rows in the policy's units, (H', D'), or None.
        delays: For each row, the number of actions that will have been executed.
        shape: Rows and numbers of a chunk, (H, D).
        convert: Makes a tensor of an array, on the policy's device.
    """
    torch, settings = require("torch"), processor.rtc_config
    target, weights = torch.zeros(len(plans), *shape), torch.zeros(len(plans), shape[0], 1)
    for i, (plan, delay) in enumerate(zip(plans, delays, strict=True)):
        if plan is not None:
            part = plan[: shape[0]]
            target[i, : len(part), : part.shape[1]] = part
            horizon = min(settings.execution_horizon, len(part))
            weights[i, :, 0] = processor.get_prefix_weights(max(delay, 0), horizon, shape[0])
    target, weights = convert(target.numpy()), convert(weights.numpy())
    most = float(settings.max_guidance_weight)

    def change(velocity: Any, actions: Any, time: float) -> Any:
        end, done = actions - time * velocity, 1 - time
        strength = most if done == 0 else min(most, time / done * (time**2 + done**2) / time**2)
        return velocity - strength * weights * (target - end)

    return change


class SmolVLAPasses(FlowPasses):
    """The passes of SmolVLA, whose images are encoded from their patches."""

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Use the passes of a `VLAFlowMatching`, which then also accepts patches in place of
        images.
        """
        super().__init__(model, compilation)
        self._vlm = model.vlm_with_expert.get_vlm_model()
        # LeRobot 0.4 stores keys and values by name, (B, L, heads, D); later versions in a cache of
        # transformers.
        self._by_name = (
            "fill_kv_cache" in inspect.signature(model.vlm_with_expert.forward).parameters
        )
        # Of an image's patches, (L,), by its height and width.
        self._positions: dict[tuple[int, int], Any] = {}
        self._embed_image = model.vlm_with_expert.embed_image
        model.vlm_with_expert.embed_image = self._embed

    def encode_images(self, images: Sequence[Any]) -> list[Any]:
        """Return the patches of images (P, 3, H, W) in the format of the vision model, (P, L,
        E).
        """
        vision = self._vlm.vision_model
        places = vision.embeddings.position_embedding
        found = []
        for image in images:
            patches = (
                vision.embeddings.patch_embedding(image.to(vision.dtype)).flatten(2).transpose(1, 2)
            )
            found.append(patches + places(self._positions_of(image)))
        return found

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *patches: Any
    ) -> tuple[Any, Any]:
        embedded, present, causal = self.model.embed_prefix(
            patches, cameras.unbind(1), tokens, mask, state=state
        )
        _, cache = self.model.vlm_with_expert.forward(
            attention_mask=self.module.make_att_2d_masks(present, causal),
            position_ids=present.cumsum(1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=True,
            **({"fill_kv_cache": True} if self._by_name else {}),
        )
        if self._by_name:
            layers = [(layer["key_states"], layer["value_states"]) for layer in cache.values()]
        else:
            layers = layers_of(cache)
        return stack_of(layers), present.long()

    def velocity(self, encoded: Any, present: Any, state: Any, actions: Any, times: Any) -> Any:
        layers = encoded.unbind(1)
        if self._by_name:
            cache = {
                i: {"key_states": layer[:, 0], "value_states": layer[:, 1]}
                for i, layer in enumerate(layers)
            }
        else:
            cache = cache_of(layers)
        return self.model.denoise_step(
            prefix_pad_masks=present.bool(), past_key_values=cache, x_t=actions, timestep=times
        )

    def _embed(self, patches: Any) -> Any:
        if patches.ndim == 4:  # an image, in LeRobot's own training pass
            return self._embed_image(patches)
        vision = self._vlm.vision_model
        hidden = vision.encoder(inputs_embeds=patches, attention_mask=None).last_hidden_state
        return self._vlm.connector(vision.post_layernorm(hidden))

    def _positions_of(self, image: Any) -> Any:
        """Return the positions that the vision model gives to the patches of an image of this
        size.
        """
        size = (image.shape[-2], image.shape[-1])
        if size not in self._positions:
            torch, vision = require("torch"), self._vlm.vision_model
            found: list[Any] = []
            hook = vision.embeddings.position_embedding.register_forward_pre_hook(
                lambda _, given: found.extend(given)
            )
            with hook, self.adapters.rows(()):  # the image belongs to no row
                patches = [length // vision.patch_size for length in size]
                vision.embeddings(
                    image[:1].to(vision.dtype),
                    torch.ones(1, *patches, dtype=torch.bool, device=image.device),
                )
            self._positions[size] = found[0][0].clone()
        return self._positions[size]


_BOUNDS = ("min", "max")  # statistics that scale states and actions


class Groot(Kind):
    """GR00T N1.7: flow matching from noise drawn for each session.

    The layers above its language model do not mask padding, so only observations whose prompts have
    the same number of tokens share a pass.
    """

    batched = True

    @property
    def horizon(self) -> int:
        longest = int(self.policy._groot_model.config.action_horizon)
        return int(self.policy._resolve_prediction_horizon(require("torch").empty(1, longest, 1)))

    @property
    def usual(self) -> int:
        return min(int(self.policy._action_queue_steps), self.horizon)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        groups: dict[int, list[int]] = {}
        for place, length in enumerate(batch["attention_mask"].sum(1).tolist()):
            groups.setdefault(int(length), []).append(place)
        chunks: list[Any] = [None] * len(rows)
        for length, places in groups.items():
            with row_draws([rows[place] for place in places], self.policy._groot_model.action_head):
                drawn = self.policy.predict_action_chunk(_part(batch, places, length, len(rows)))
            for place, chunk in zip(places, drawn, strict=True):
                chunks[place] = chunk
        return require("torch").stack(chunks).float()


def _part(
    batch: Mapping[str, Any], places: Sequence[int], length: int, rows: int
) -> dict[str, Any]:
    """Return the inputs of some rows, whose prompts have `length` tokens, without the padding
    before them.
    """
    grid = batch["image_grid_thw"]
    patches = batch["pixel_values"].split(grid.prod(1).tolist())  # one for each image
    views = len(grid) // rows
    images = [place * views + view for place in places for view in range(views)]
    padded = batch["input_ids"].shape
    found = {
        "pixel_values": require("torch").cat([patches[i] for i in images]),
        "image_grid_thw": grid[images],
    }
    for name, value in batch.items():
        if name not in found and hasattr(value, "shape") and value.shape[:1] == (rows,):
            of_tokens = value.shape[:2] == padded
            found[name] = value[places][:, -length:] if of_tokens else value[places]
    return found


def require_groot_statistics(before: Sequence[Any], after: Sequence[Any], settings: Any) -> None:
    """Raise `ConfigError` unless GR00T's processors have usable bounds; LeRobot replaces missing
    ones by 0 and 1.
    """
    torch = require("torch")
    pack, decode = _step(before, "embodiment_tag"), _step(after, "env_action_dim")
    if pack is None or decode is None:
        raise ConfigError(
            "checkpoint: misses the steps of GR00T N1.7's processors; save it with LeRobot 0.6 "
            "again"
        )
    if pack.embodiment_tag not in pack.embodiment_mapping:
        raise ConfigError(
            f"checkpoint: got the embodiment {pack.embodiment_tag!r}, want one of "
            f"{sorted(pack.embodiment_mapping)}: LeRobot would act as the first of them"
        )
    sources = [
        ("policy_preprocessor.json", STATE, pack.stats),
        ("policy_preprocessor.json", ACTION, pack.stats),
    ]
    if hasattr(decode, "stats"):
        sources.append(("policy_postprocessor.json", ACTION, decode.stats))
    features = {**settings.input_features, **settings.output_features}
    for file, key, stats in sources:
        have = {
            name: torch.as_tensor(value).float()
            for name, value in ((stats or {}).get(key) or {}).items()
        }
        width = features[key].shape[0]
        missing = [name for name in _BOUNDS if name not in have or not have[name].isfinite().all()]
        short = [name for name in _BOUNDS if name in have and have[name].numel() < width]
        if missing or short:
            raise ConfigError(
                f"checkpoint: {file} has no usable {missing or short} of {key!r}, has "
                f"{sorted(have)}, want {width} numbers each; without them its inputs and actions "
                "are wrong: save it with its dataset's statistics"
            )


def groot_dataset(before: Sequence[Any]) -> DatasetContract | None:
    """Return the parts of the state that NVIDIA's checkpoint names; None if no name has a
    meaning.
    """
    pack = _step(before, "embodiment_tag")
    names = ((getattr(pack, "modality_config", None) or {}).get("state") or {}).get(
        "modality_keys"
    ) or ()
    stats = (getattr(pack, "raw_stats", None) or {}).get("state") or {}
    widths = {name: len(stats.get(name, {}).get("min", ())) for name in names}
    if not widths or not all(widths.values()) or widths.get(GRIPPER, 1) != 1:
        return None
    specs = {name: StateSpec(width) for name, width in widths.items() if name != GRIPPER}
    return DatasetContract(Contract(state=specs), tuple(names))


def _step(steps: Sequence[Any], attribute: str) -> Any:
    return next((step for step in steps if hasattr(step, attribute)), None)


class ActPolicy(Kind):
    """ACT, whose latent is zero at inference, so that nothing is random."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._act = compilation.core("act", self._actions)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        return self._act(
            *(batch[key] for key in (*vectors(self.config), *self.config.image_features))
        )

    def _actions(self, *inputs: Any) -> Any:
        names = vectors(self.config)
        batch = dict(zip(names, inputs, strict=False))
        if images := inputs[len(names) :]:
            batch[IMAGES] = list(images)
        return self.policy.model(batch)[0]


class Fast(Kind):
    """π0-FAST, which decodes only the tokens of rows that are executed."""

    lengths = ("n_action_steps",)


class Evo1(Kind):
    """EVO-1, whose post-processor removes the padding of actions."""

    @property
    def dim(self) -> int:
        return int(self.config.max_action_dim)


class XVla(Kind):
    """X-VLA, which draws its noise itself and does not mask padding, so a batch needs
    instructions of one length.
    """

    @property
    def batched(self) -> bool:  # type: ignore[override]
        return bool(self.config.pad_language_to == "max_length")

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._look = policy.model.forward_vlm

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        firsts, owners = shared_frames(rows)

        def look(*inputs: Any) -> dict[str, Any]:
            """Run the vision-language encoder once for each observation."""
            return {
                name: one[owners]
                for name, one in self._look(*(each[firsts] for each in inputs)).items()
            }

        self.policy.model.forward_vlm = look
        with row_draws(rows, self.policy.model):
            return self.policy.predict_action_chunk(batch)


class VqBet(Kind):
    """VQ-BeT, which samples the codes of its residual VQ; checkpoints of its first training
    phase have no codes.
    """

    batched, lengths = True, ("action_chunk_size",)

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        if not policy.vqbet.action_head.vqvae_model.discretized.item():
            raise ConfigError(
                "checkpoint: VQ-BeT's residual VQ is not trained in it; train on, or name a later "
                "step"
            )

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        with row_draws(rows, self.policy.vqbet):
            return self.policy.vqbet(stacked(batch, self.config, len(rows)), rollout=True)


class Tdmpc(Kind):
    """TD-MPC, which runs one row at a time, since the rows of a batch would share random
    trajectories and Q functions.

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
        # (horizon, 1, D)
        actions = policy.plan(latent) if self.config.use_mpc else policy.model.pi(latent)[None]
        actions = actions.clamp(-1, 1)
        if policy._prev_mean is not None:
            row.memory["mean"] = fetch(policy._prev_mean)
        repeats = self.config.n_action_repeats
        return (actions[:1].expand(repeats, -1, -1) if repeats > 1 else actions).transpose(0, 1)


class Single(Kind):
    """SAC, which LeRobot 0.6 calls `gaussian_actor`, with single actions and no state between
    them.
    """

    @property
    def horizon(self) -> int:
        return 1

    @property
    def dim(self) -> int:
        # The gripper's choice, which comes last.
        return super().dim + (self.config.num_discrete_actions is not None)

    def _alone(self, batch: dict[str, Any], row: Row) -> Any:
        # The gripper's network takes no others.
        inputs = {key: batch[key] for key in self.config.input_features}
        return self.policy.select_action(inputs)[:, None]


# Types that resize images themselves.
RESIZING = {"groot", "smolvla", "pi0", "pi05", "pi0_fast", "wall_x"}
MASKING = {"smolvla", "pi0", "pi05", "pi0_fast", "xvla"}

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
