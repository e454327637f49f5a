"""The samplers of LeRobot's policy types, which compute the chunks of many sessions.

LeRobot's `select_action` stores observations, actions and plans of a single robot in the policy
object. The classes here call the policy's stateless functions, and pass the state of each session
to them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
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
from vlagents_ray.policies.flow import Change, FlowPasses, Guidance, Guide, RandomSteps
from vlagents_ray.registry import require
from vlagents_ray_models.key_value_cache import cache_of, layers_of, stack_of
from vlagents_ray_models.pi0_passes import Pi0Passes

# A field of π0.5's config in LeRobot after 0.6.1. It is 0 if the policy was trained without
# prefixes.
LONGEST_PREFIX = "rtc_training_max_delay"
# Fields of π0.5's config in the same versions.
_MEMORIES = ("use_visual_memory", "use_proprioceptive_memory")

# Keys of LeRobot's observations and actions.
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images"
FRAMES = (STATE, "observation.environment_state", IMAGES)  # keys of the inputs that have a history
_TOKENS = ("observation.language.tokens", "observation.language.attention_mask")


class Sampler:
    """Computes the chunks of a policy.

    This base class supports any policy type. It computes one row at a time with a seed from the
    row's session, which is slow but exact.
    """

    batched = False  # whether `draw` accepts several rows
    variation: str | None = None  # see `ModelPolicy.variation`
    # Fields of the config that may contain the number of rows of a chunk, in order of preference.
    lengths: ClassVar[tuple[str, ...]] = ("chunk_size", "n_action_steps")
    random_steps: RandomSteps | None = None  # random steps of the last call of `draw`
    # For the last call of `draw`: index of a row -> number of rows at the beginning of its chunk
    # that were inputs, since they were already planned.
    prefix_rows: Mapping[int, int] = {}

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        """Use a loaded policy, and compile its core functions if its type supports that.

        Raises:
            ConfigError: The policy object stores the state of a session.
        """
        self.policy, self.config = policy, policy.config
        self.staging = Staging(policy.config.device)
        if type(self) is Sampler and self.steps > 1:
            raise ConfigError(
                f"checkpoint: {policy.name!r}: expected n_obs_steps 1, got {self.steps}, which "
                "the policy keeps by itself, so that sessions would mix; use another type, or "
                "train with n_obs_steps 1"
            )

    @property
    def steps(self) -> int:
        """The number of observations that the policy reads."""
        return int(self.config.n_obs_steps)

    @property
    def horizon(self) -> int:
        """The number of rows of a chunk, counted from the current tick."""
        preferred, alternative = self.lengths[0], self.lengths[-1]
        return int(getattr(self.config, preferred, 0) or getattr(self.config, alternative))

    @property
    def dim(self) -> int:
        """The number of values in an action that the policy returns to its post-processor."""
        return int(self.config.action_feature.shape[0])

    @property
    def default_execute(self) -> int:
        """The number of rows that LeRobot executes before the next inference, from the config."""
        return min(int(getattr(self.config, "n_action_steps", self.horizon)), self.horizon)

    def observed_rows(self, rows: Sequence[Row]) -> list[int]:
        """Return the indices of the rows whose observations `draw` reads.

        These are all rows, unless several samples share an observation.
        """
        return list(range(len(rows)))

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        """Compute chunks in the policy's own units.

        Args:
            batch: The output of the policy's pre-processor, for the rows of `observed_rows`.
            rows: The rows of the batch.
            leftovers: The leftover actions of each row, (H', D) in the same units, or None.

        Returns:
            The chunks, (B, horizon, D).
        """
        from vlagents_ray_models.sampling_rng import seeded

        [row] = rows
        with seeded(row.rng, require("torch").device(self.config.device)):
            self.policy.reset()
            return self._draw_one(batch, row)

    def _draw_one(self, batch: dict[str, Any], row: Row) -> Any:
        """Compute the chunk of a single row, (1, horizon, D), with the seed already set."""
        return self.policy.predict_action_chunk(batch)


def row_draws(rows: Sequence[Row], *models: Any) -> AbstractContextManager[object]:
    """Return the context in which models draw random numbers for each row from the row's own
    generator.
    """
    from vlagents_ray_models.sampling_rng import RowDraws  # imports torch

    return RowDraws([row.rng for row in rows], *models)


def vectors(config: Any) -> list[str]:
    """Return the observation keys of the vectors that a policy reads."""
    features = {FRAMES[0]: config.robot_state_feature, FRAMES[1]: config.env_state_feature}
    return [key for key, feature in features.items() if feature]


def stacked(batch: dict[str, Any], config: Any, rows: int) -> dict[str, Any]:
    """Group the observations of each row, and stack its cameras.

    Args:
        batch: Tensors (rows * steps, …) by observation key.
        config: LeRobot's config object of the policy.
        rows: The number of rows.

    Returns:
        Tensors (rows, steps, …) by observation key; the images are one tensor, (rows, steps,
        cameras, 3, H, W).
    """
    if config.image_features:
        images = [batch[key] for key in config.image_features]
        batch = {**batch, IMAGES: require("torch").stack(images, dim=1)}
    return {key: batch[key].unflatten(0, (rows, -1)) for key in FRAMES if key in batch}


class DiffusionSampler(Sampler):
    """Diffusion policies, with noise for the first sample and, with DDPM, for every denoising
    step.
    """

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        unet = policy.diffusion.unet
        denoise = compilation.core("denoise", unet.forward)
        self._encode = compilation.core("vision encoder", self._condition)

        # LeRobot passes `global_cond` as a keyword argument, but a compiled core accepts only
        # positional arguments.
        def forward(sample: Any, times: Any, global_cond: Any) -> Any:
            return denoise(sample, times, global_cond)

        unet.forward = forward

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray_models.sampling_rng import generator_of

        model = self.policy.diffusion
        shape = (self.config.horizon, self.config.action_feature.shape[0])
        noise = np.stack([row.noise(*shape) for row in rows])
        observations = stacked(batch, self.config, len(rows))
        actions = model.conditional_sample(
            len(rows),
            global_cond=self._encode(*observations.values()),
            generator=[generator_of(row.rng) for row in rows],
            noise=self.staging.upload(noise),
        )
        return actions[:, self.steps - 1 :]

    def _condition(self, *inputs: Any) -> Any:
        names = vectors(self.config)
        if self.config.image_features:
            names.append(IMAGES)
        observations = dict(zip(names, inputs, strict=True))
        return self.policy.diffusion._prepare_global_conditioning(observations)


class MultiTaskDitSampler(Sampler):
    """The multi-task diffusion transformer of LeRobot 0.6, which reads an instruction and uses
    diffusion or flow matching.
    """

    batched = True

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        observations = stacked(batch, self.config, len(rows))
        for name in _TOKENS:
            # The tokens are the same in each step of a history.
            observations[name] = batch[name].unflatten(0, (len(rows), -1))[:, -1]

        condition = self.policy.observation_encoder.encode(observations)
        objective = self.policy.objective
        # The steps of DDPM draw noise in a module of diffusers.
        with row_draws(rows, objective, require("diffusers.utils.torch_utils")):
            actions = objective.conditional_sample(
                self.policy.noise_predictor, len(rows), condition
            )
        return actions[:, self.steps - 1 :]


class FlowSampler(Sampler):
    """The sampler of SmolVLA, π0 and π0.5.

    These policies use flow matching from the sessions' noise, guided by their leftover plans. A
    checkpoint that was trained with prefixes is not guided. It reads the first rows of a leftover
    plan as an input.
    """

    batched = True
    noise_level = 0.0  # noise level of `RandomSteps`

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        model, config = policy.model, self.config
        if policy.name == "smolvla":
            self.passes: FlowPasses = SmolVLAPasses(model, compilation)
            # Measured with 16 rows on a CPU, in episodes with several instructions.
            self.variation = "the bits of a row depend on the other rows"
            self.flow_steps = int(config.num_steps)
        else:
            self.passes = Pi0Passes(model, compilation, takes_state=policy.name == "pi0")
            self.flow_steps = int(config.num_inference_steps)

        memories = [name for name in _MEMORIES if getattr(config, name, False)]
        if memories:
            raise ConfigError(
                f"checkpoint: expected none of {memories}, got some, which the policy object "
                "keeps, so that sessions would mix"
            )

        # The policy calls this function after preparing the inputs and before converting the
        # actions.
        model.sample_actions = self.passes.sample
        self.longest = 0  # longest prefix, rows
        if getattr(policy.rtc_processor.rtc_config, "mode", "guided") == "trained":
            self.read_prefixes(int(getattr(config, LONGEST_PREFIX)))

    def read_prefixes(self, longest: int) -> None:
        """Begin chunks with at most this number of given rows, in place of guidance."""
        self.longest = longest
        self.passes.by_row = True

    def observed_rows(self, rows: Sequence[Row]) -> list[int]:
        return self._shared(rows)[0]

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        shape = (self.horizon, int(self.config.max_action_dim))
        upload = self.staging.upload
        # This noise is drawn before the noise of the steps, which is drawn for only some of the
        # rows.
        noise = upload(np.stack([row.noise(*shape) for row in rows]))
        self.random_steps = RandomSteps.for_rows(
            rows, (self.flow_steps, *shape), self.noise_level, upload
        )

        changes: list[Change] = []
        guidance: Guidance | None = None
        frozen = None
        prefix_rows: dict[int, int] = {}
        if any(leftover is not None for leftover in leftovers):
            plans = [
                None if leftover is None else self._encoded(leftover) for leftover in leftovers
            ]
            prefixes = None
            if self.longest:
                prefixes = Guide.for_rows(list(map(self._prefixed, rows, plans)), *shape)

            if prefixes is not None:
                for i, count in enumerate(prefixes.frozen.sum((1, 2))):
                    if count:
                        prefix_rows[i] = int(count)
                prefixes = prefixes.to(upload)
                noise = prefixes.insert_frozen(noise)
                frozen = prefixes.frozen
                changes.append(prefixes.keep)
            elif not self.longest:
                processor, delays = self.policy.rtc_processor, [row.delay for row in rows]
                guide = guide_of(processor, plans, delays, shape)
                if guide is not None:
                    limit = float(processor.rtc_config.max_guidance_weight)
                    guidance = partial(guide.to(upload).steer, limit=limit)
        if self.random_steps is not None:
            changes.append(self.random_steps.change)
        self.prefix_rows = prefix_rows

        return self.policy.predict_action_chunk(
            batch,
            noise=noise,
            owners=self._shared(rows)[1],
            steps=self.flow_steps,
            changes=changes,
            guidance=guidance,
            frozen=frozen,
        )

    def _shared(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return the rows whose observations are read, and for each row the index of its
        observations among them.
        """
        # With relative actions, the state of each row is added to the row's actions.
        if getattr(self.config, "use_relative_actions", False):
            return list(range(len(rows))), list(range(len(rows)))
        return shared_frames(rows)

    def _prefixed(self, row: Row, plan: Any) -> Row:
        """Return the row with its plan in the policy's units.

        Its delay is set to the number of rows of the plan that the policy reads.
        """
        leftover = None if plan is None else fetch(plan)
        return replace(row, leftover=leftover, delay=min(row.delay, self.longest))

    def _encoded(self, leftover: Any) -> Any:
        """Convert a leftover plan to the units of π0's ALOHA, if SmolVLA was trained in these
        units.
        """
        if not getattr(self.config, "adapt_to_pi_aloha", False):
            return leftover
        return self.policy._pi_aloha_encode_actions_inv(leftover[None].clone())[0]


def guide_of(
    processor: Any, plans: Sequence[Any], delays: Sequence[int], shape: tuple[int, int]
) -> Guide | None:
    """Return the guide of chunks that continue the leftover plans of their sessions, with the
    weights of LeRobot's schedule.

    Args:
        processor: The policy's `RTCProcessor`, for its settings and its schedule.
        plans: The leftover plan of each of the B rows in the policy's units, (H', D'), or None.
        delays: The number of actions of each row that will have been executed when the chunk
            arrives.
        shape: The number of rows of a chunk and of values of a row, (H, D).

    Returns:
        The guide; None if no row has both a leftover plan and a delay.
    """
    rows, dim = shape
    target = np.zeros((len(plans), rows, dim), np.float32)
    weights = np.zeros((len(plans), rows, 1), np.float32)
    for i, (plan, delay) in enumerate(zip(plans, delays, strict=True)):
        if plan is None or delay <= 0 or not len(plan):
            continue
        leftover = fetch(plan[:rows])
        target[i, : len(leftover), : leftover.shape[1]] = leftover
        horizon = min(processor.rtc_config.execution_horizon, len(leftover))
        weights[i, :, 0] = processor.get_prefix_weights(delay, horizon, rows)
    # The weights of LeRobot's schedule include the frozen rows.
    return Guide(target, np.zeros_like(weights), weights) if weights.any() else None


def accept_times_of_rows(model: Any) -> None:
    """Let SmolVLA's `embed_suffix` also accept a flow time for each row of a chunk, (B, H).

    Each row is embedded alone, with its time.

    Args:
        model: A `VLAFlowMatching`.
    """
    embed: Callable[[Any, Any], tuple[Any, Any, Any]] = model.embed_suffix

    def embed_with_times(actions: Any, times: Any) -> tuple[Any, Any, Any]:
        if times.ndim == 1:
            return embed(actions, times)
        embedded, _, _ = embed(actions.flatten(0, 1)[:, None], times.flatten())
        _, present, causal = embed(actions, times[:, 0])
        return embedded.unflatten(0, times.shape)[:, :, 0], present, causal

    model.embed_suffix = embed_with_times


class SmolVLAPasses(FlowPasses):
    """The forward passes of SmolVLA, which encode images from their patches."""

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Use the forward passes of a `VLAFlowMatching`, which then also accepts patches instead of
        images.
        """
        super().__init__(model, compilation)
        self._vlm = model.vlm_with_expert.get_vlm_model()
        # LeRobot 0.4 stores keys and values by name, (B, L, heads, D). Later versions store them in
        # a cache of transformers.
        parameters = inspect.signature(model.vlm_with_expert.forward).parameters
        self._by_name = "fill_kv_cache" in parameters
        # Height and width of an image -> the positions of its patches, (L,).
        self._positions: dict[tuple[int, int], Any] = {}
        accept_times_of_rows(model)
        self._embed_image = model.vlm_with_expert.embed_image
        model.vlm_with_expert.embed_image = self._embed

    def encode_images(self, images: Sequence[Any]) -> list[Any]:
        """Return the patches of images (P, 3, H, W) in the format of the vision model, (P, L,
        E).
        """
        embeddings = self._vlm.vision_model.embeddings
        dtype = self._vlm.vision_model.dtype
        encoded = []
        for image in images:
            patches = embeddings.patch_embedding(image.to(dtype)).flatten(2).transpose(1, 2)
            positions = embeddings.position_embedding(self._positions_of(image))
            encoded.append(patches + positions)
        return encoded

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

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        encoded, present, _ = constants
        layers = encoded.unbind(1)
        if self._by_name:
            cache = {}
            for i, layer in enumerate(layers):
                cache[i] = {"key_states": layer[:, 0], "value_states": layer[:, 1]}
        else:
            cache = cache_of(layers)
        return self.model.denoise_step(
            prefix_pad_masks=present.bool(), past_key_values=cache, x_t=actions, timestep=times
        )

    def _embed(self, patches: Any) -> Any:
        if patches.ndim == 4:  # the input is an image in LeRobot's own training pass
            return self._embed_image(patches)
        vision = self._vlm.vision_model
        hidden = vision.encoder(inputs_embeds=patches, attention_mask=None).last_hidden_state
        return self._vlm.connector(vision.post_layernorm(hidden))

    def _positions_of(self, image: Any) -> Any:
        """Return the positions, (L,), that the vision model assigns to the patches of images of
        this size.
        """
        size = (image.shape[-2], image.shape[-1])
        if size not in self._positions:
            torch, vision = require("torch"), self._vlm.vision_model
            captured: list[Any] = []
            hook = vision.embeddings.position_embedding.register_forward_pre_hook(
                lambda _, inputs: captured.extend(inputs)
            )
            with hook:
                patches = [length // vision.patch_size for length in size]
                mask = torch.ones(1, *patches, dtype=torch.bool, device=image.device)
                vision.embeddings(image[:1].to(vision.dtype), mask)
            self._positions[size] = captured[0][0].clone()
        return self._positions[size]


_BOUNDS = ("min", "max")  # statistics that scale states and actions


class GrootSampler(Sampler):
    """GR00T N1.7: flow matching from noise drawn for each session.

    The layers above its language model do not mask padding, so only observations whose prompts have
    the same number of tokens share a pass.
    """

    batched = True
    variation = "prompts of different lengths are computed in separate passes"

    @property
    def horizon(self) -> int:
        longest = int(self.policy._groot_model.config.action_horizon)
        return int(self.policy._resolve_prediction_horizon(require("torch").empty(1, longest, 1)))

    @property
    def default_execute(self) -> int:
        return min(int(self.policy._action_queue_steps), self.horizon)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        by_length: dict[int, list[int]] = {}  # number of tokens -> indices of rows
        for i, length in enumerate(batch["attention_mask"].sum(1).tolist()):
            by_length.setdefault(int(length), []).append(i)

        chunks: list[Any] = [None] * len(rows)
        for length, indices in by_length.items():
            inputs = _select_rows(batch, indices, length, len(rows))
            with row_draws([rows[i] for i in indices], self.policy._groot_model.action_head):
                drawn = self.policy.predict_action_chunk(inputs)
            for i, chunk in zip(indices, drawn, strict=True):
                chunks[i] = chunk
        return require("torch").stack(chunks).float()


def _select_rows(
    batch: Mapping[str, Any], indices: Sequence[int], length: int, rows: int
) -> dict[str, Any]:
    """Return GR00T's inputs for the selected rows, without the padding before their prompts.

    Args:
        batch: The inputs of all rows.
        indices: The selected rows.
        length: The number of tokens in the prompts of these rows.
        rows: The number of all rows.
    """
    # Number of patches of each image in time and space, (rows * views, 3).
    grid = batch["image_grid_thw"]
    patches = batch["pixel_values"].split(grid.prod(1).tolist())  # a tensor for each image
    views = len(grid) // rows
    images: list[int] = []
    for i in indices:
        images.extend(range(i * views, (i + 1) * views))

    selected = {
        "pixel_values": require("torch").cat([patches[i] for i in images]),
        "image_grid_thw": grid[images],
    }
    padded_shape = batch["input_ids"].shape
    for name, value in batch.items():
        if name in selected or not hasattr(value, "shape") or value.shape[:1] != (rows,):
            continue
        is_padded = value.shape[:2] == padded_shape
        selected[name] = value[indices][:, -length:] if is_padded else value[indices]
    return selected


def require_groot_statistics(before: Sequence[Any], after: Sequence[Any], settings: Any) -> None:
    """Check that GR00T's processors have usable bounds.

    LeRobot would replace missing bounds with 0 and 1.

    Args:
        before: The steps of the pre-processor.
        after: The steps of the post-processor.
        settings: LeRobot's config object of the policy.

    Raises:
        ConfigError: Bounds of the state or the actions are missing, too few or not finite, or the
            embodiment is unknown.
    """
    pack, decode = _find_step(before, "embodiment_tag"), _find_step(after, "env_action_dim")
    if pack is None or decode is None:
        raise ConfigError(
            "checkpoint: misses the steps of GR00T N1.7's processors; save it with LeRobot 0.6 "
            "again"
        )
    if pack.embodiment_tag not in pack.embodiment_mapping:
        raise ConfigError(
            f"checkpoint: expected an embodiment of {sorted(pack.embodiment_mapping)}, got "
            f"{pack.embodiment_tag!r}, for which LeRobot would act as the first of them"
        )

    sources = [
        ("policy_preprocessor.json", STATE, pack.stats),
        ("policy_preprocessor.json", ACTION, pack.stats),
    ]
    if hasattr(decode, "stats"):
        sources.append(("policy_postprocessor.json", ACTION, decode.stats))

    as_tensor = require("torch").as_tensor
    features = {**settings.input_features, **settings.output_features}
    for file, key, by_feature in sources:
        statistics = (by_feature or {}).get(key) or {}
        bounds = {name: as_tensor(value).float() for name, value in statistics.items()}
        width = features[key].shape[0]
        missing = [
            name for name in _BOUNDS if name not in bounds or not bounds[name].isfinite().all()
        ]
        short = [name for name in _BOUNDS if name in bounds and bounds[name].numel() < width]
        if missing or short:
            raise ConfigError(
                f"checkpoint: {file}: expected {width} finite numbers in each of "
                f"{missing or short} of {key!r}, got {sorted(bounds)}; without them its "
                "inputs and actions are wrong: save it with its dataset's statistics"
            )


def groot_dataset(before: Sequence[Any]) -> DatasetContract | None:
    """Return the parts of the state that NVIDIA's checkpoint contains.

    Args:
        before: The steps of the pre-processor.

    Returns:
        A contract with these parts; None if a part's width is unknown, or its "gripper" is not a
        single number.
    """
    pack = _find_step(before, "embodiment_tag")
    state_config = (getattr(pack, "modality_config", None) or {}).get("state") or {}
    names = state_config.get("modality_keys") or ()
    statistics = (getattr(pack, "raw_stats", None) or {}).get("state") or {}
    widths = {name: len(statistics.get(name, {}).get("min", ())) for name in names}
    if not widths or not all(widths.values()) or widths.get(GRIPPER, 1) != 1:
        return None

    specs = {name: StateSpec(width) for name, width in widths.items() if name != GRIPPER}
    return DatasetContract(Contract(state=specs), tuple(names))


def _find_step(steps: Sequence[Any], attribute: str) -> Any:
    """Return the first step that has an attribute; None if there is none."""
    return next((step for step in steps if hasattr(step, attribute)), None)


class ActSampler(Sampler):
    """The sampler of ACT, whose latent is zero at inference, so that actions are deterministic."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._act = compilation.core("act", self._actions)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        names = [*vectors(self.config), *self.config.image_features]
        return self._act(*(batch[name] for name in names))

    def _actions(self, *inputs: Any) -> Any:
        names = vectors(self.config)
        batch = dict(zip(names, inputs, strict=False))
        images = inputs[len(names) :]
        if images:
            batch[IMAGES] = list(images)
        return self.policy.model(batch)[0]


class FastSampler(Sampler):
    """The sampler of π0-FAST, which decodes only the tokens of rows that are executed."""

    lengths = ("n_action_steps",)


class Evo1Sampler(Sampler):
    """The sampler of EVO-1, whose post-processor removes the padding of actions."""

    @property
    def dim(self) -> int:
        return int(self.config.max_action_dim)


class XVlaSampler(Sampler):
    """The sampler of X-VLA.

    X-VLA draws its noise itself and does not mask padding, so all instructions of a batch must have
    the same length.
    """

    @property
    def batched(self) -> bool:  # type: ignore[override]
        return bool(self.config.pad_language_to == "max_length")

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        self._forward_vlm = policy.model.forward_vlm

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        firsts, owners = shared_frames(rows)

        def forward_vlm(*inputs: Any) -> dict[str, Any]:
            """Run the vision-language encoder once for each observation."""
            outputs = self._forward_vlm(*(values[firsts] for values in inputs))
            return {name: values[owners] for name, values in outputs.items()}

        self.policy.model.forward_vlm = forward_vlm
        with row_draws(rows, self.policy.model):
            return self.policy.predict_action_chunk(batch)


class VqBetSampler(Sampler):
    """The sampler of VQ-BeT.

    VQ-BeT samples the codes of its residual VQ. Checkpoints of its first training phase have no
    codes.
    """

    batched = True
    lengths = ("action_chunk_size",)

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


class TdmpcSampler(Sampler):
    """The sampler of TD-MPC.

    It computes one row at a time, since the rows of a batch would share random trajectories and Q
    functions. `row.memory` contains the plan of the session's last tick, from which the next plan
    starts.
    """

    @property
    def horizon(self) -> int:
        if self.config.n_action_repeats > 1:
            return int(self.config.n_action_repeats)
        return int(self.config.horizon) if self.config.use_mpc else 1

    @property
    def default_execute(self) -> int:
        return self.horizon if self.config.n_action_repeats > 1 else int(self.config.n_action_steps)

    def _draw_one(self, batch: dict[str, Any], row: Row) -> Any:
        torch, policy = require("torch"), self.policy
        previous_mean = row.memory.get("mean")
        if previous_mean is not None:
            policy._prev_mean = torch.from_numpy(previous_mean).to(self.config.device)

        latent = policy.model.encode(batch)
        # (horizon, 1, D)
        actions = policy.plan(latent) if self.config.use_mpc else policy.model.pi(latent)[None]
        actions = actions.clamp(-1, 1)
        if policy._prev_mean is not None:
            row.memory["mean"] = fetch(policy._prev_mean)

        repeats = self.config.n_action_repeats
        if repeats > 1:
            actions = actions[:1].expand(repeats, -1, -1)
        return actions.transpose(0, 1)


class SacSampler(Sampler):
    """The sampler of SAC, which LeRobot 0.6 calls `gaussian_actor`.

    SAC returns single actions, and keeps no state between them.
    """

    @property
    def horizon(self) -> int:
        return 1

    @property
    def dim(self) -> int:
        # The discrete action of the gripper is the last value.
        return super().dim + (self.config.num_discrete_actions is not None)

    def _draw_one(self, batch: dict[str, Any], row: Row) -> Any:
        # The network of the gripper accepts no other inputs.
        inputs = {key: batch[key] for key in self.config.input_features}
        return self.policy.select_action(inputs)[:, None]


# Policy types that resize images themselves.
RESIZING = {"groot", "smolvla", "pi0", "pi05", "pi0_fast", "wall_x"}
# Policy types that mask missing cameras.
MASKING = {"smolvla", "pi0", "pi05", "pi0_fast", "xvla"}

# Policy type -> its sampler. `Sampler` itself supports all other types.
SAMPLERS: Mapping[str, type[Sampler]] = {
    "act": ActSampler,
    "diffusion": DiffusionSampler,
    "evo1": Evo1Sampler,
    "gaussian_actor": SacSampler,
    "groot": GrootSampler,
    "multi_task_dit": MultiTaskDitSampler,
    "pi0": FlowSampler,
    "pi05": FlowSampler,
    "pi0_fast": FastSampler,
    "sac": SacSampler,
    "smolvla": FlowSampler,
    "tdmpc": TdmpcSampler,
    "vqbet": VqBetSampler,
    "xvla": XVlaSampler,
}
