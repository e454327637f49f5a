"""Random checkpoints of transformers' π0."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.checkpoints.recipe import Recipe, WrittenCheckpoint
from benchmarks.checkpoints.tokenizer import fast_tokenizer
from benchmarks.checkpoints.weights import parameters_on_meta, write_weights
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.registry import require

STATE_DIM, ACTION_DIM = 8, 7  # as in LIBERO
_IMAGE, _PATCH = 224, 14  # size of images and of patches, px
_SPARE_TOKENS = 8


@dataclass(frozen=True, slots=True)
class Pi0Size:
    """A π0 smaller than the published one."""

    width: int  # width of the language model and of the vision encoder
    expert_width: int
    layers: int  # number of layers of the language model and of the action expert
    vision_layers: int
    patch: int = _PATCH  # size of patches, px


SMALL = Pi0Size(width=512, expert_width=256, layers=4, vision_layers=4)


def write(recipe: Recipe) -> WrittenCheckpoint:
    """Write the checkpoint of `PI0Config()`, or of `SMALL`."""
    model, processor = make_model(recipe)
    parameters = write_weights(model, recipe.folder)
    model.config.save_pretrained(recipe.folder)
    processor.save_pretrained(recipe.folder)
    # The state has a single part, so its length is known.
    return WrittenCheckpoint(
        "pi0",
        parameters,
        {"checkpoint": str(recipe.folder), "state": ["joints"], "dtype": recipe.dtype},
    )


def make_model(recipe: Recipe) -> tuple[Any, Any]:
    """Return the model, on the device meta, and its processor."""
    size = SMALL if recipe.size == "small" else None
    processor = make_processor(size, statistics=make_statistics())
    with parameters_on_meta():
        model = transformers_class("PI0ForConditionalGeneration")(make_config(processor, size))
    model.to(getattr(require("torch"), recipe.dtype))
    model.config.dtype, model.config.architectures = recipe.dtype, [type(model).__name__]
    return model, processor


def transformers_class(name: str) -> Any:
    """Return a class of transformers. Before the import, torchvision is made compatible with
    torch.
    """
    ensure_torchvision()
    return getattr(require("transformers"), name)


def make_config(processor: Any, size: Pi0Size | None = None, **settings: Any) -> Any:
    """Return transformers' `PI0Config` with the published sizes, or with `size`, and with any
    other `settings`.
    """
    config_class = transformers_class("PI0Config")
    published = config_class()
    vision_language, expert = published.vlm_config.to_dict(), published.dit_config.to_dict()
    vision_language["image_token_id"] = processor.image_token_id
    if size is not None:
        heads = {"num_attention_heads": 4, "num_key_value_heads": 1, "head_dim": size.width // 4}
        shared = {"num_hidden_layers": size.layers, **heads}
        words = len(processor.tokenizer) + _SPARE_TOKENS
        vision_language["projection_dim"] = size.width
        vision_language["text_config"] |= {
            "hidden_size": size.width,
            "intermediate_size": 4 * size.width,
            "vocab_size": words,
            **shared,
        }
        vision_language["vision_config"] |= {
            "hidden_size": size.width,
            "intermediate_size": 2 * size.width,
            "patch_size": size.patch,
            "num_hidden_layers": size.vision_layers,
            "num_attention_heads": 4,
        }
        expert |= {
            "hidden_size": size.expert_width,
            "intermediate_size": 4 * size.expert_width,
            **shared,
        }
    return config_class(vlm_config=vision_language, dit_config=expert, **settings)


def make_processor(
    size: Pi0Size | None = None, chunk: int = 50, statistics: dict[str, list[float]] | None = None
) -> Any:
    """Return a `PI0Processor` with a byte-level tokenizer."""
    ensure_torchvision()
    images = require("transformers.models.pi0.image_processing_pi0").PI0ImageProcessor()
    images.image_seq_length = (_IMAGE // (_PATCH if size is None else size.patch)) ** 2
    processor_class = require("transformers.models.pi0.processing_pi0").PI0Processor
    return processor_class(images, fast_tokenizer(), **(statistics or {}), chunk_size=chunk)


def make_statistics() -> dict[str, list[float]]:
    """Return means and standard deviations of an invented dataset."""
    rng = np.random.default_rng(1)
    return {
        "state_mean": rng.normal(0, 0.3, STATE_DIM).tolist(),
        "state_std": rng.uniform(0.5, 1.5, STATE_DIM).tolist(),
        "actions_mean": rng.normal(0, 0.3, ACTION_DIM).tolist(),
        "actions_std": rng.uniform(0.5, 1.5, ACTION_DIM).tolist(),
    }
