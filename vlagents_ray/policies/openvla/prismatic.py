"""The model behind both policies: a checkpoint in OpenVLA's format for transformers, with all it needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import SavedTensors, find_checkpoint, require_loaded
from vlagents_ray.policies.openvla.bins import ActionBins
from vlagents_ray.policies.openvla.sources import model_classes
from vlagents_ray.policies.openvla.statistics import Bounds, Statistics
from vlagents_ray.registry import require

if TYPE_CHECKING:
    from vlagents_ray.policies.openvla.family import PrismaticConfig

_NEEDS = ("config.json", "preprocessor_config.json", "tokenizer_config.json", "*.safetensors")
_SPACE = 29871  # Llama's token of an empty word, which stood between "Out:" and the action in training
_PROMPT = "In: What action should the robot take to {}?\nOut:"
_PROMPT_V01 = (  # OpenVLA v0.1 was tuned from Vicuna; upstream, too, tells it by the checkpoint's name
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, detailed, "
    "and polite answers to the user's questions. USER: What action should the robot take to {}? ASSISTANT:"
)


@dataclass(frozen=True)
class Prismatic:
    """A loaded checkpoint."""

    path: Path
    network: Any  # OpenVLAForActionPrediction; used are its vision_backbone, projector and language_model
    tokenizer: Any
    processor: Any  # PrismaticImageProcessor
    bins: ActionBins
    statistics: Statistics
    prompt: str
    device: Any
    dtype: Any

    def pixels(self, image: np.ndarray) -> Any:
        """An (H, W, 3) uint8 picture as the checkpoint's backbones want it, (C, S, S) float32 on the CPU."""
        return self.processor.apply_transform(require("PIL.Image").fromarray(image))

    def tokens(self, instruction: str) -> list[int]:
        """The prompt for an instruction. Raises `InvalidObservation` if it is longer than the model was trained for."""
        ids: list[int] = self.tokenizer(self.prompt.format(instruction.lower())).input_ids
        if ids[-1] != _SPACE:
            ids.append(_SPACE)
        most = self.network.config.llm_max_length
        if len(ids) > most:
            raise InvalidObservation(f"instruction: got {len(ids)} tokens with the prompt, want {most} at most")
        return ids

    def to_device(self, arrays: Sequence[Any]) -> Any:
        """Tensors of one shape as a batch in the model's dtype; a GPU copies it while the CPU goes on."""
        torch = require("torch")
        batch = torch.stack(list(arrays))
        if self.device.type == "cuda":
            batch = batch.pin_memory()
        return batch.to(self.device, self.dtype, non_blocking=True)

    def embed(self, tokens: Sequence[int]) -> Any:
        """(L, D)."""
        torch = require("torch")
        return self.network.get_input_embeddings()(torch.tensor(tokens, device=self.device))


def load_prismatic(config: PrismaticConfig, bounds: Bounds = "q99") -> Prismatic:
    """Read a checkpoint and verify it. Raises `ConfigError`."""
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, _NEEDS)
    statistics = Statistics.of(path, bounds)
    statistics.require(config.unnorm_key)
    device = torch_device(config.device)
    dtype = torch_dtype(config.dtype, device)
    ensure_torchvision()
    transformers = require("transformers")
    model_class, processor_class = model_classes(path, config.source_dir, config.trust_remote_code)
    network = model_class.from_pretrained(
        path, torch_dtype=dtype, attn_implementation=config.attention, low_cpu_mem_usage=True
    )
    require_loaded(network, SavedTensors.of(path))
    return Prismatic(
        path=path,
        network=network.to(device).eval().requires_grad_(False),
        tokenizer=transformers.AutoTokenizer.from_pretrained(path),
        processor=processor_class.from_pretrained(path),
        bins=ActionBins(network.config, device),
        statistics=statistics,
        prompt=_PROMPT_V01 if "openvla-v01" in config.checkpoint else _PROMPT,
        device=device,
        dtype=dtype,
    )
