"""π0 in Hugging Face transformers: PaliGemma and an action expert with flow matching.

A checkpoint is the folder of `PI0ForConditionalGeneration.save_pretrained` and
`PI0Processor.save_pretrained`. The module `vlagents_ray_models.openpi` runs Physical Intelligence's
own code and checkpoints.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import AdapterConfig, ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.adapter import LoraAdapter
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained
from vlagents_ray.policies.base.config import Guidance, NoiseLevel
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    choose_cameras,
    resize_with_pad,
    state_vector,
)
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import OFFERED, FlowPasses
from vlagents_ray.registry import require
from vlagents_ray_models.action_tokens import action_tokens
from vlagents_ray_models.attention_config import AttentionConfig
from vlagents_ray_models.gemma_layers import Attention, GemmaLayers, compile_vision_layers
from vlagents_ray_models.key_value_cache import cache_of, layers_of, stack_of

logger = logging.getLogger(__name__)

# openpi's names, in the order of the image tokens.
CAMERAS = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
# The defaults: openpi's name of each camera -> our camera, and the parts of LIBERO's state.
DEFAULT_CAMERAS = {"base_0_rgb": "front", "left_wrist_0_rgb": "wrist"}
DEFAULT_STATE = ("xyz_axis_angle", "gripper_qpos")
_ROUNDING = 1e-5  # rounding error of float32 for pixels of about 1
_EPSILON = 1e-8  # added to a standard deviation by PI0Processor
_BILINEAR = 2  # Pillow's number of the bilinear filter
_PROCESSOR = "processor_config.json"
_STATISTICS = ("state_mean", "state_std", "actions_mean", "actions_std")


InputStyle = Literal["transformers", "openpi"]


class Pi0Config(AttentionConfig, AdapterConfig):
    """Settings of π0, in addition to the settings of all models."""

    cameras: dict[str, str] | None = Field(
        default=None,
        description=f"those of {', '.join(CAMERAS)} that it was trained with -> ours; unset: "
        f"{DEFAULT_CAMERAS}",
    )
    images: InputStyle | None = Field(
        default=None,
        description="the code that prepared images and instructions in training: openpi for "
        "weights that were converted from openpi; unset: transformers, unless its image processor "
        "resizes bilinearly "
        "or does not pad",
    )
    steps: int | None = Field(
        default=None, ge=1, description="steps of the flow; unset: the checkpoint's, usually 10"
    )
    max_tokens: int = Field(
        default=48,
        ge=1,
        description="tokens of an instruction, as in training; a longer one is an error",
    )
    guidance: Guidance = 5.0
    noise_level: NoiseLevel = 0.0


@dataclass(frozen=True)
class LoadedPi0:
    """The model and its processor."""

    network: Any
    processor: Any
    dtype: Any
    passes: Pi0HfPasses
    staging: Staging
    scale: tuple[Any, Any, Any]  # result of `_scale`

    def normalised_plan(self, row: Row) -> Row:
        """Return the row with its leftover plan in the model's units."""
        if row.leftover is None:
            return row
        mean, std = self._statistics()
        return replace(row, leftover=(row.leftover - mean) / std)

    def actions(self, flow: np.ndarray) -> np.ndarray:
        """Convert the model's output, (..., max_action_dim), to actions (..., D) in the robot's
        units.
        """
        mean, std = self._statistics()
        return np.asarray(flow[..., : len(mean)] * std + mean)

    def _statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean and the standard deviation of actions, each (D,) float32."""
        mean, std = self.processor.actions_mean, self.processor.actions_std
        return np.asarray(mean, np.float32), np.asarray(std, np.float32) + np.float32(_EPSILON)


class Pi0(ModelPolicy):
    """The policy π0: chunks by flow matching, with one forward pass for all sessions of a batch."""

    Config: ClassVar[type] = Pi0Config
    trainable = network = "model.network"
    config: Pi0Config
    model: LoadedPi0 | None

    def __init__(self, config: Pi0Config) -> None:
        super().__init__(config)
        self.cameras = _cameras(config.cameras)
        self.state = tuple(config.state or DEFAULT_STATE)

    @property
    def contract(self) -> Contract:
        model = self.model
        horizon = None if model is None else model.network.config.chunk_size
        action = ActionSpec(dim=None if model is None else len(model.processor.actions_mean))
        behaviour = self.offered(OFFERED if self.config.noise_level else ())
        return self.make_contract(
            self.cameras, self.state, horizon, action=action, behaviour=behaviour
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else len(self.model.processor.state_mean)

    @property
    def continues_plans(self) -> bool:
        """Whether a chunk continues the executed plan, which requires `actions: chunk`."""
        return self.config.actions == "chunk"

    def load(self) -> LoadedPi0:
        """Read the checkpoint.

        Raises:
            ConfigError: The checkpoint is incomplete, or its image processor does more than scale
                pixels.
        """
        path = find_checkpoint(
            self.config.checkpoint,
            self.config.checkpoint_step,
            needs=["config.json", _PROCESSOR, "*.safetensors"],
        )
        device = torch_device(self.config.device)
        dtype = torch_dtype(self.config.dtype, device)

        ensure_torchvision()
        model_class = require("transformers").PI0ForConditionalGeneration
        network = from_pretrained(model_class, path, dtype=dtype)
        network = network.eval().requires_grad_(False).to(device)
        passes = Pi0HfPasses(network, self.compilation, self.config.attention)

        processor, staging = _processor(path, self.adapter), Staging(device)
        style = self._style(processor)
        logger.info("images and instructions are prepared as in %s; `images` changes that", style)
        return LoadedPi0(network, processor, dtype, passes, staging, _scale(processor, staging))

    def merge_products(self) -> None:
        self.loaded().passes.merge_products()

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the model's inputs for one row: resized images, normalised state, and the
        episode's tokens.

        Several threads call this method, so it never uses the tokenizer, whose padding is mutable
        state.
        """
        model, torch = self.loaded(), require("torch")
        cameras = camera_images(obs, self.cameras)
        images = self._resized([cameras[name] for name in self.cameras])

        processor = model.processor
        state = np.zeros(processor.max_state_dim, np.float32)
        values = state_vector(obs, self.state, self.state_dim)
        state[: len(values)] = processor.normalize(torch.from_numpy(values), "state")

        inputs = {**self._current_episode().prompt, **images, "state": state}
        staged: StagedRow = model.staging.stage(inputs)
        return staged

    def _style(self, processor: Any) -> InputStyle:
        """Return which code prepared images and instructions in the checkpoint's training."""
        if self.config.images is not None:
            return self.config.images
        images = processor.image_processor
        resizes_as_openpi = images.resample is not None and int(images.resample) == _BILINEAR
        if images.do_resize and images.do_pad and not resizes_as_openpi:
            return "transformers"
        return "openpi"

    def _resized(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Resize the images (H, W, 3) of all cameras, and pad them with zeros.

        Returns:
            "images" (cameras, S, S, 3) uint8. If images are prepared as in transformers, also
            "sizes" (cameras, 2) int64: height and width, px, of the resized images, which are at
            the upper left. transformers pads images after it has scaled the colours.
        """
        processor = self.loaded().processor.image_processor
        height, width = processor.pad_size["height"], processor.pad_size["width"]
        if self._style(self.loaded().processor) == "openpi":
            return {"images": np.stack([resize_with_pad(image, height, width) for image in images])}

        padded = np.zeros((len(images), height, width, 3), np.uint8)
        sizes = np.zeros((len(images), 2), np.int64)
        for i, image in enumerate(images):
            resized = processor(
                [image],
                do_rescale=False,
                do_normalize=False,
                do_pad=False,
                input_data_format="channels_last",
                return_tensors="np",
            )["pixel_values"][0]
            _, rows, columns = resized.shape
            sizes[i] = rows, columns
            padded[i, :rows, :columns] = np.moveaxis(resized, 0, -1)
        return {"images": padded, "sizes": sizes}

    def _begin(self, instruction: str, seed: int) -> None:
        """Begin an episode and tokenize its instruction.

        Raises:
            InvalidObservation: The instruction is longer than in training, or contains the token of
                an image. It is never truncated.
        """
        super()._begin(instruction, seed)
        if self.model is None:
            return

        processor, max_tokens = self.model.processor, self.config.max_tokens
        patches = len(self.cameras) * processor.image_seq_length
        text = _openpi_text(instruction) if self._style(processor) == "openpi" else instruction
        tokens = processor.tokenizer(
            [f"{processor.image_token * patches}{processor.tokenizer.bos_token}{text}\n"],
            padding="max_length",
            max_length=patches + max_tokens,
            padding_side="right",
            return_tensors="np",
        )

        text_tokens = int(tokens["attention_mask"].sum()) - patches
        if text_tokens > max_tokens:
            raise InvalidObservation(
                f"instruction: expected at most {max_tokens} tokens, as in training, got "
                f"{text_tokens}; shorten it, or set the policy's max_tokens"
            )
        if int((tokens["input_ids"] == processor.image_token_id).sum()) != patches:
            raise InvalidObservation(
                f"instruction: expected words, got {processor.image_token!r} in {instruction!r}; "
                "leave it out, as it stands for an image"
            )
        self._current_episode().prompt = {name: array[0] for name, array in tokens.items()}

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks of rows, in one pass for each step of the flow."""
        model = self.loaded()
        settings = model.network.config
        noise_shape = (settings.chunk_size, settings.max_action_dim)
        firsts, owners = shared_frames(rows)
        with require("torch").inference_mode():
            inputs = self._inputs([rows[i] for i in firsts])
            flows, behaviours = model.passes.chunks(
                [model.normalised_plan(row) for row in rows],
                [
                    [inputs["pixel_values"]],
                    inputs["pixel_attention_mask"].unbind(1),
                    inputs["input_ids"],
                    inputs["attention_mask"],
                    inputs["state"],
                ],
                owners,
                noise=np.stack([row.noise(*noise_shape) for row in rows]),
                steps=self.config.steps or settings.num_inference_steps,
                config=self.config,
                dim=len(model.processor.actions_mean),
                convert=model.staging.upload,
            )

        predictions = []
        for i, flow in enumerate(flows):
            predictions.append(Prediction(model.actions(flow), behaviour=behaviours.get(i, {})))
        return predictions

    def _inputs(self, rows: Sequence[Row]) -> Mapping[str, Any]:
        """Return the inputs of the network for the last observations of rows, under transformers'
        names.

        The images are scaled on the device, in the same way as in the image processor.
        """
        model, torch = self.loaded(), require("torch")
        inputs: dict[str, Any] = model.staging.stack([row.frames[-1] for row in rows])
        images = inputs.pop("images").movedim(-1, 2)  # (P, cameras, 3, S, S)
        device = images.device
        factor, summand, padding = model.scale
        pixels = images.to(torch.float32, memory_format=torch.contiguous_format)
        pixels = pixels.mul_(factor).add_(summand)

        sizes = inputs.pop("sizes", None)
        if sizes is not None:
            height, width = images.shape[-2:]
            rows_inside = torch.arange(height, device=device) < sizes[..., :1]  # (P, cameras, S)
            columns_inside = torch.arange(width, device=device) < sizes[..., 1:]
            inside = rows_inside[..., :, None] & columns_inside[..., None, :]
            pixels = torch.where(inside[:, :, None], pixels, padding)

        inputs["pixel_values"] = pixels.to(model.dtype)
        inputs["pixel_attention_mask"] = torch.ones(
            images.shape[:2], dtype=torch.bool, device=device
        )
        inputs["state"] = inputs["state"].to(model.dtype)
        return inputs


def _cameras(chosen: Mapping[str, str] | None) -> dict[str, str]:
    """Return the cameras in the order of the model's image tokens: openpi's name -> our camera.

    A checkpoint may have been trained without some cameras.
    """
    cameras = DEFAULT_CAMERAS if chosen is None else chosen
    expected: Sequence[str] = CAMERAS
    if cameras and set(cameras) <= set(CAMERAS):
        expected = [name for name in CAMERAS if name in cameras]
    return choose_cameras(chosen, DEFAULT_CAMERAS, expected)


def _openpi_text(instruction: str) -> str:
    """Return an instruction as openpi's `PaligemmaTokenizer` cleans it."""
    return instruction.strip().replace("_", " ").replace("\n", " ")


def _processor(path: Path, adapter: LoraAdapter | None) -> Any:
    """Load the processor of a checkpoint, with the statistics in its adapter's folder, if any.

    Raise `ConfigError` if the processor has no statistics.
    """
    processor = require("transformers").PI0Processor.from_pretrained(path, local_files_only=True)
    if adapter is not None and (adapter.folder / _PROCESSOR).is_file():
        file = adapter.folder / _PROCESSOR
        try:
            saved = dict(json.loads(file.read_text(encoding="utf-8")))
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{file}: is no processor's config ({error}); copy it again"
            ) from error
        for name in _STATISTICS:
            if saved.get(name) is not None:
                setattr(processor, name, saved[name])

    absent = [name for name in _STATISTICS if getattr(processor, name) is None]
    if absent:
        raise ConfigError(
            f"checkpoint {path}: {_PROCESSOR}: expected {absent}, got none; save those of the "
            f"dataset it was trained on: PI0Processor(…, {absent[0]}=[…]).save_pretrained(folder)"
        )
    return processor


def _scale(processor: Any, staging: Staging) -> tuple[Any, Any, Any]:
    """Return how a processor converts pixels.

    Args:
        processor: The `PI0Processor`.
        staging: Copies the result to the device.

    Returns:
        The factor and the summand of pixels, and the converted padding colour of images, each (3,
        1, 1) float32 on the device.

    Raises:
        ConfigError: The processor changes an image of the network's size in any other way.
    """
    image_processor = processor.image_processor
    side = image_processor.pad_size
    levels = np.resize(np.arange(256, dtype=np.uint8), (side["height"], side["width"]))
    image = np.repeat(levels[..., None], 3, axis=2)
    [converted] = image_processor([image], return_tensors="np")["pixel_values"]
    converted = np.asarray(converted, np.float32)

    summand = converted[:, :1, :1]  # the first pixel is black, so its result is the summand
    white = converted[:, levels == 255][:, :1, None]
    factor = (white - summand) / np.float32(255)
    if converted.shape != (3, *levels.shape) or not np.allclose(
        levels * factor + summand, converted, atol=_ROUNDING
    ):
        raise ConfigError(
            f"{_PROCESSOR}: expected an image processor with do_rescale and do_normalize alone, "
            f"got one that changes an image of {levels.shape} by more than a factor and a summand "
            "for each channel; images are resized before"
        )

    # An image that is twice as wide is padded at the bottom, if the processor pads.
    wide_image = image[: len(image) // 2]
    [wide] = image_processor([wide_image], return_tensors="np")["pixel_values"]
    padding = np.zeros_like(summand)
    if wide.shape == converted.shape:
        padding = np.asarray(wide[:, -1:, -1:], np.float32)
    return staging.upload(factor), staging.upload(summand), staging.upload(padding)


class Pi0HfPasses(FlowPasses):
    """The forward passes of a `PI0ForConditionalGeneration`.

    Once for each call of the policy, `encode` computes the keys and values of the prefix (images
    and instruction), `constants` computes the mask and the positions with which the steps attend to
    the prefix, and `at_times` computes the embeddings of the flow times. In each step, `velocity`
    embeds the noisy actions and runs the layers of the action expert. As in openpi, actions stay in
    float32 between the steps even if the model computes in another type.
    """

    by_regions = True

    def __init__(
        self, network: Any, compilation: Compilation, attention: Attention = "sdpa"
    ) -> None:
        """Create the forward passes of a network, which `compilation` may compile.

        Args:
            network: The `PI0ForConditionalGeneration`.
            compilation: Compiles the passes.
            attention: The attention kernel of compiled steps.
        """
        super().__init__(network, compilation)
        model = network.model
        self._language_model = GemmaLayers(model.vlm.language_model, compilation)
        self._expert = GemmaLayers(model.dit, compilation, attention)
        self._embed = compilation.region(action_tokens)
        compile_vision_layers(model.vlm, compilation)

    def merge_products(self) -> None:
        self._language_model.merge_products()
        self._expert.merge_products()

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        """Return the keys and values, (P, layers, 2, heads, L, E), and the mask.

        `images` is one tensor, (P, cameras, 3, S, S).
        """
        embedded = self.model.model.embed_prefix(tokens, images[0], cameras)
        return self._language_model.encode(embedded, mask), mask

    def constants(self, encoded: Any, present: Any, state: Any, horizon: int) -> tuple[Any, ...]:
        """Return `encoded`, the mask, the rotation, the embedding of the state, and the scales
        of norms.
        """
        constants = self._expert.constants(encoded, present, 1 + horizon, has_state=True)
        embedded_state = self.model.embed_action_time.state_proj(state)
        return *constants, embedded_state, self._expert.scales(len(state))

    def at_times(self, times: Any) -> Any:
        """Return the embeddings of the times, (B, K, D)."""
        # The times are the same for all rows.
        embedded = self.model.embed_action_time.sinusoid_embeds(times[0])
        return embedded.to(self.model.dtype).expand(len(times), -1, -1)

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        encoded, mask, rotation, state, scales = constants
        layers = self.model.embed_action_time
        embedded = self._embed(layers, state, actions.to(state.dtype), times)
        hidden = self._expert.step(encoded, mask, rotation, scales, embedded)
        return self.model.action_out_proj(hidden[:, 1:]).float()


def flow_velocity(
    network: Any, inputs: Mapping[str, Any], dtype: Any, owners: Sequence[int] | None = None
) -> Callable[[Any, float], Any]:
    """Return the velocity for a learner, as a function of noisy actions, (B, H, D), and flow time.

    The inputs are encoded once. This uses the forward passes of transformers, as in training: they
    call the hooks of each layer, which sharded training needs.

    Args:
        network: The `PI0ForConditionalGeneration`.
        inputs: Tokens, images and states of P observations, as `PI0Processor` returns them, on the
            network's device.
        dtype: The type in which the network computes.
        owners: The index of the observation of each of the B rows; None means that row i belongs to
            observation i.

    Returns:
        The function, whose result is (B, H, D) float32.
    """
    torch, model = require("torch"), network.model
    mask = inputs["attention_mask"]
    result = model.vlm(
        inputs_embeds=model.embed_prefix(
            inputs["input_ids"], inputs["pixel_values"], inputs["pixel_attention_mask"]
        ),
        attention_mask=mask,
        position_ids=mask.cumsum(-1) - 1,
        token_type_ids=mask.new_zeros(mask.shape),
        use_cache=True,
    )
    encoded = stack_of(layers_of(result.past_key_values))
    state = inputs["state"].to(dtype)
    if owners is not None:
        index = torch.tensor(owners, device=mask.device)
        encoded, mask, state = encoded[index], mask[index], state[index]

    def velocity(actions: Any, time: float) -> Any:
        times = torch.full((len(actions),), time, dtype=torch.float32, device=actions.device)
        # Each step needs a new cache, since it appends its tokens, to which later steps must not
        # attend.
        cache = cache_of(encoded.unbind(1))
        output = network(
            state=state,
            noise=actions.to(dtype),
            timestep=times,
            attention_mask=mask,
            past_key_values=cache,
        )
        return output.logits.float()

    return velocity
