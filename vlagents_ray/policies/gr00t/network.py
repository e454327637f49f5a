"""The model and the processor of a GR00T checkpoint, with NVIDIA's code."""

from __future__ import annotations

import contextlib
import copy
import importlib.util
import json
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.base.model_code import remote_code, use_source
from vlagents_ray.policies.gr00t.embodiment import CONFIG, Embodiment
from vlagents_ray.registry import require


class Gr00tConfig(ModelConfig):
    """Settings of GR00T, beside those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of GR00T's training, such as outputs/checkpoint-{step}, or hub id: org/name, "
        "org/name@COMMIT",
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of Isaac-GR00T; unset: the variable GR00T_SRC, or what is installed"
    )
    embodiment: str | None = Field(
        default=None, description="the checkpoint's name of the robot, such as new_embodiment; unset: its only one"
    )
    backbone: str | None = Field(
        default=None,
        description="N1.7: folder of the vision-language model that the checkpoint names, nvidia/Cosmos-Reason2-2B, "
        "whose path must contain that name; unset: from the hub or its cache",
    )
    steps: int | None = Field(default=None, ge=1, description="steps of the flow; unset: the checkpoint's, usually 4")
    compile: Literal[False] = Field(default=False, description="not offered for GR00T")
    trust_remote_code: bool = Field(
        default=False,
        description="run Python code that lies in the checkpoint or its backbone: whoever can write there can do on "
        "this machine whatever this process can",
    )


SOURCE = "GR00T_SRC"
_MODEL = "config.json"


@dataclass(frozen=True)
class Gr00tNetwork:
    """A loaded checkpoint, for one embodiment."""

    model: Any
    processor: Any
    embodiment: Embodiment
    # Held while the processor reads an observation, as several threads do: its transforms keep their parameters, and
    # it changes the filters of warnings of the whole process.
    reading: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    @classmethod
    def load(cls, config: Gr00tConfig) -> Gr00tNetwork:
        """Read a checkpoint; raises `ConfigError` if a part of it is missing, unknown or random."""
        code = _use_checkout(config.source_dir)
        folder = find_checkpoint(config.checkpoint, config.checkpoint_step, needs=[_MODEL, "*.safetensors"])
        _require_version(folder)
        beside = folder / "processor"  # where training of N1.7 puts it
        about = folder if (folder / CONFIG).is_file() or not beside.is_dir() else beside
        embodiment = Embodiment.of(about, config.embodiment)
        device = torch_device(config.device)
        dtype = torch_dtype(config.dtype, device)
        other = {} if config.backbone is None else {"model_name": config.backbone}
        transformers = require("transformers")
        flash = flash_attention_is_here(device, dtype)
        with (
            remote_code(allowed=config.trust_remote_code, source=code),
            contextlib.nullcontext() if flash else built_without_flash_attention(),
        ):
            try:
                model = transformers.AutoModel.from_pretrained(folder, torch_dtype=dtype, **other)
                processor = transformers.AutoProcessor.from_pretrained(about, **other)
            except ConfigError:
                raise
            except (OSError, ValueError, KeyError, RuntimeError, AssertionError, TypeError) as error:
                raise ConfigError(
                    f"checkpoint {folder}: GR00T's code could not load it ({type(error).__name__}: "
                    f"{str(error).strip()[:500]}); is it complete, of this checkout's version, and its backbone on the "
                    f"hub, in the cache, or in a folder that `backbone` names?"
                ) from error
        if not flash:
            use_torch_attention(model)
        saved = SavedTensors.of(folder)
        model = _converted(model.eval().requires_grad_(False), saved, device, dtype)
        require_loaded(model, saved)
        embodiment.require_fits(model.config)
        if embodiment.value not in processor.embodiment_id_mapping:
            raise ConfigError(
                f"embodiment {embodiment.value!r}: has no number in embodiment_id.json, which has "
                f"{sorted(processor.embodiment_id_mapping)}; save the checkpoint's processor with it"
            )
        if config.steps is not None:
            model.action_head.num_inference_timesteps = config.steps
        processor.eval()
        return cls(model, processor, embodiment)

    @cached_property
    def masks_padding(self) -> bool:
        """Whether all layers over the language model leave out padding, as those of N1.6's usual transformer do."""
        over = getattr(self.model.action_head, "vl_self_attention", None)
        plain = over is None or not list(over.parameters())
        return plain and bool(self.model.config.use_alternate_vl_dit)

    def inputs(
        self, images: Sequence[dict[str, np.ndarray]], states: Sequence[dict[str, np.ndarray]], instruction: str
    ) -> dict[str, Any]:
        """Return the model's inputs of one row, for `chunks`.

        Args:
            images: Of each moment of the embodiment's video, oldest first, (H, W, 3) uint8 by camera.
            states: Of each moment of its state, (D,) float32 by group.
            instruction: What the robot is to do.
        """
        types, robot = require("gr00t.data.types"), self.embodiment
        raw = {group: np.stack([one[group] for one in states]) for group in robot.state}
        step = types.VLAStepData(
            images={camera: [one[camera] for one in images] for camera in robot.cameras},
            states=raw,
            actions={},
            text=instruction,
            embodiment=robot,
        )
        with self.reading:
            processed = self.processor([{"type": types.MessageType.EPISODE_STEP.value, "content": step}])
        return {"processed": processed, "raw": raw}

    def chunks(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[dict[str, Any]], *, alike: bool
    ) -> list[np.ndarray]:
        """Compute the chunks of rows, (horizon, D) float32 each, in one pass, or in one for each length of prompts.

        Args:
            rngs: The generator of each row's noise.
            inputs: What `inputs` returned for each of them.
            alike: Whether each pass is to have as many rows, with prompts of one length.
        """
        whole = self._collated(inputs)
        lengths = whole["inputs"]["attention_mask"].sum(1).tolist()
        if (self.masks_padding and not alike) or len(set(lengths)) == 1:
            return self._chunks(rngs, inputs, whole)
        found: dict[int, np.ndarray] = {}
        for length in sorted(set(lengths)):
            places = [place for place, one in enumerate(lengths) if one == length]
            spare = places[-1:] * (len(inputs) - len(places) if alike else 0)
            some = [inputs[place] for place in places + spare]
            noise = [*(rngs[place] for place in places), *(copy.deepcopy(rngs[place]) for place in spare)]
            chunks = self._chunks(noise, some, self._collated(some))
            found |= zip(places, chunks[: len(places)], strict=True)
        return [found[place] for place in range(len(inputs))]

    def _collated(self, inputs: Sequence[dict[str, Any]]) -> Any:
        return self.processor.collator([one["processed"] for one in inputs])

    def _chunks(
        self, rngs: Sequence[np.random.Generator], inputs: Sequence[dict[str, Any]], collated: Any
    ) -> list[np.ndarray]:
        from vlagents_ray.policies.sampling_rng import RowDraws

        with require("torch").inference_mode(), RowDraws(rngs):
            drawn = self.model.get_action(**collated)["action_pred"].float().cpu().numpy()
        raw = {group: np.stack([one["raw"][group] for one in inputs]) for group in self.embodiment.state}
        decoded = self.processor.decode_action(drawn, self.embodiment, raw)
        return list(np.concatenate([decoded[group] for group in self.embodiment.action], axis=-1).astype(np.float32))


def _use_checkout(source_dir: str | None) -> Path:
    """Make GR00T's code importable; return the folder of its models, which hold code that transformers imports."""
    use_source("gr00t", SOURCE, source_dir)
    if importlib.util.find_spec("gr00t.policy") is None:
        raise ConfigError(
            f"{source_dir or os.environ.get(SOURCE) or 'gr00t'}: is GR00T's code of N1.5 or before, want that of N1.6 "
            f"or N1.7; serve N1.5 by its own server, and the policy `upstream` in front of it"
        )
    os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")  # it asks PyPI for a newer version when it is imported
    ensure_torchvision()
    return Path(str(require("gr00t.model").__file__)).parent


def _converted(model: Any, saved: SavedTensors, device: Any, dtype: Any) -> Any:
    """Move a model to a device and a dtype; N1.6's backbone was read in bfloat16, which rounds, whatever is wanted."""
    rounded, held = require("torch").bfloat16, set(saved)
    names = {name for name, one in model.state_dict().items() if one.dtype == rounded != dtype and name in held}
    model = model.to(device=device, dtype=dtype)
    for name, tensor in model.state_dict().items():
        if name in names:
            tensor.copy_(saved[name])
    return model


def _require_version(folder: Path) -> None:
    """Raise `ConfigError` unless the checkout has the class of a checkpoint's model."""
    try:
        kind = json.loads((folder / _MODEL).read_text(encoding="utf-8")).get("model_type")
    except (ValueError, AttributeError) as error:
        raise ConfigError(f"checkpoint {folder}: {_MODEL} cannot be read ({error}); copy it again") from error
    known = sorted(one.model_type for one in require("gr00t.model").MODEL_REGISTRY)
    if kind not in known:
        cure = (
            "N1.5's code is another: serve it by its own server, and the policy `upstream` in front of it"
            if "n1_5" in str(kind).lower()
            else "one that LeRobot saved is served by the policy `lerobot`"
            if kind is None
            else "name the checkout of its version"
        )
        raise ConfigError(f"checkpoint {folder}: got model_type {kind!r}, this checkout has {known}; {cure}")


_FLASH, _PACKED = "flash_attention_2", "packed_sdpa"
_CHECK = "_check_and_enable_flash_attn_2"  # of transformers' models, up to 4.5


def flash_attention_is_here(device: Any, dtype: Any) -> bool:
    """Whether flash-attention is installed, and computes on a device in a dtype: on CUDA, in 16 bits."""
    computes = device.type == "cuda" and dtype.itemsize == 2
    return computes and bool(require("transformers.utils").is_flash_attn_2_available())


@contextlib.contextmanager
def built_without_flash_attention() -> Iterator[None]:
    """Let models be built in this context that insist on flash-attention, as N1.6's backbone does."""
    base: Any = require("transformers").PreTrainedModel
    check = vars(base).get(_CHECK)
    if check is None:  # newer: N1.7's, which takes another attention by itself
        yield
        return
    setattr(base, _CHECK, classmethod(lambda _, config, *__, **___: config))
    try:
        yield
    finally:
        setattr(base, _CHECK, check)


def use_torch_attention(model: Any) -> None:
    """Have the parts of a model that ask for flash-attention use torch's own.

    N1.6's vision tower attends within each of several images that follow each other in one sequence.
    """
    transformers = require("transformers.modeling_utils")
    for module in model.modules():
        config: Any = getattr(module, "config", None)
        if config is not None and getattr(config, "_attn_implementation", None) == _FLASH:
            packed = config.model_type.startswith("siglip2")
            config._attn_implementation = _PACKED if packed else "sdpa"
    transformers.AttentionInterface.register(_PACKED, packed_attention)


def packed_attention(
    _: Any, query: Any, key: Any, value: Any, __: Any = None, *, scaling: float, seq_len_list: Sequence[int], **___: Any
) -> tuple[Any, None]:
    """Attend within each of several sequences that follow each other.

    Args:
        query: (1, heads, tokens, D).
        key: As `query`.
        value: As `query`.
        scaling: The factor of the products of queries and keys.
        seq_len_list: The number of tokens of each sequence.

    Returns:
        (1, tokens, heads, D), and None in place of the weights.
    """
    attention = require("torch.nn.functional").scaled_dot_product_attention
    if len(set(seq_len_list)) == 1:  # in one call, each sequence a row
        rows = [one[0].unflatten(1, (-1, seq_len_list[0])).transpose(0, 1) for one in (query, key, value)]
        return attention(*rows, scale=scaling).transpose(1, 2).flatten(0, 1)[None], None
    parts = zip(*(one.split(list(seq_len_list), dim=2) for one in (query, key, value)), strict=True)
    return require("torch").cat([attention(*part, scale=scaling) for part in parts], dim=2).transpose(1, 2), None
