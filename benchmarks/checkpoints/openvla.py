"""Random checkpoints of OpenVLA, written with the model's own code in a clone of its repository."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.checkpoints.recipe import Recipe, WrittenCheckpoint
from benchmarks.checkpoints.tokenizer import byte_level, fast_tokenizer
from benchmarks.checkpoints.weights import parameters_on_meta, write_weights
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.registry import require
from vlagents_ray_models.openvla.prismatic import STATISTICS_FILE, find_source, model_classes

ACTION_DIM, PROPRIO_DIM = 7, 8
# Llama's 32000 tokens and one for padding, in multiples of 64: action tokens count from the end.
VOCABULARY = 32064
BINS, _MULTIPLE = 256, 64
_PADDING = 32000
_SIDE = 224  # size of the images, px
_DATASET = "bridge_orig"
_SENTENCES = (
    "In: What action should the robot take to pick up the black bowl?\nOut:",
    "open the top drawer of a cabinet",
)


@dataclass(frozen=True, slots=True)
class PrismaticSize:
    """An OpenVLA smaller than the published one."""

    text: dict[str, Any]  # config of the language model, text part
    backbones: tuple[str, str]  # names of vision models of timm
    side: int = _SIDE  # size of the models' images, px


SMALL = PrismaticSize(
    {
        "hidden_size": 256,
        "intermediate_size": 688,
        "num_hidden_layers": 8,
        "num_attention_heads": 8,
    },
    ("vit_tiny_patch16_224", "vit_tiny_patch16_224"),
)


def write(recipe: Recipe) -> WrittenCheckpoint:
    """Write the checkpoint of OpenVLA-7B's config, or of `SMALL`."""
    source, folder = find_source(None), recipe.folder
    model, processor = make_model(recipe, source)
    parameters = write_weights(
        model, folder, changes={"language_model.lm_head.weight": answer_with_actions}
    )
    model.config.save_pretrained(folder)
    processor.save_pretrained(folder)
    make_tokenizer().save_pretrained(folder)
    (folder / STATISTICS_FILE).write_text(json.dumps(make_statistics([_DATASET])))
    settings = {
        "checkpoint": str(folder),
        "source_dir": str(source),
        "dtype": recipe.dtype,
        "unnorm_key": _DATASET,
    }
    return WrittenCheckpoint("openvla", parameters, settings)


def make_model(recipe: Recipe, source: Path) -> tuple[Any, Any]:
    """Return the model, on the device meta, and its image processor, with the code in `source`."""
    ensure_torchvision()
    size = SMALL if recipe.size == "small" else None
    model_class, processor_class = model_classes(
        recipe.folder, str(source), trust_remote_code=False
    )
    with parameters_on_meta():
        model = model_class(make_config(model_class.config_class, size))
    model.to(getattr(require("torch"), recipe.dtype))
    model.config.torch_dtype, model.config.architectures = recipe.dtype, [type(model).__name__]
    return model, make_image_processor(processor_class, _SIDE if size is None else size.side)


def make_config(config_class: Any, size: PrismaticSize | None = None, **settings: Any) -> Any:
    """Return OpenVLA's config with the published sizes, or with `size`, and with any other
    `settings`.
    """
    text: dict[str, Any] = {"vocab_size": VOCABULARY, "pad_token_id": _PADDING}
    if size is not None:
        text |= size.text
        # In the JSON, these values override the defaults that follow from the backbones' id.
        settings |= {"timm_model_ids": list(size.backbones), "image_sizes": [size.side, size.side]}
    return config_class(
        vision_backbone_id="dinosiglip-vit-so-224px",
        llm_backbone_id="llama2-7b-pure",
        arch_specifier="no-align+fused-gelu-mlp",
        image_resize_strategy="resize-naive",
        use_fused_vision_backbone=True,
        text_config=text,
        n_action_bins=BINS,
        **settings,
    )


def answer_with_actions(head: Any) -> None:
    """Make a language model's head, (V, D), answer with action tokens, like that of a trained
    model.
    """
    last = VOCABULARY - _MULTIPLE
    head[: last - BINS] = 0
    head[last:] = 0


def make_image_processor(processor_class: Any, side: int) -> Any:
    """Return the image processor for DINOv2 and SigLIP."""
    return processor_class(
        use_fused_vision_backbone=True,
        image_resize_strategy="resize-naive",
        input_sizes=[(3, side, side), (3, side, side)],
        interpolations=["bicubic", "bicubic"],
        means=[(0.485, 0.456, 0.406), (0.5, 0.5, 0.5)],
        stds=[(0.229, 0.224, 0.225), (0.5, 0.5, 0.5)],
    )


def make_tokenizer() -> Any:
    """Return a byte-level tokenizer whose special tokens have Llama's numbers, 0, 1, 2."""
    special = {"unk_token": "<unk>", "bos_token": "<s>", "eos_token": "</s>"}
    tokens = byte_level(list(special.values()), _SENTENCES, vocabulary=400)
    template = require("tokenizers").processors.TemplateProcessing
    tokens.post_processor = template(single="<s> $A", special_tokens=[("<s>", 1)])
    return fast_tokenizer(tokens, **special, model_input_names=["input_ids", "attention_mask"])


def make_statistics(datasets: Sequence[str]) -> dict[str, Any]:
    """Return ranges of actions and proprioception of invented datasets."""
    found = {}
    for name in datasets:
        rng = np.random.default_rng(len(name))
        actions = _ranges(rng, ACTION_DIM) | {"mask": [True] * (ACTION_DIM - 1) + [False]}
        found[name] = {"action": actions, "proprio": _ranges(rng, PROPRIO_DIM)}
    return found


def _ranges(rng: np.random.Generator, dim: int) -> dict[str, Any]:
    middle, reach = rng.normal(size=dim), rng.uniform(0.5, 2, dim)
    ends = {
        "q01": middle - reach,
        "q99": middle + reach,
        "min": middle - 2 * reach,
        "max": middle + 2 * reach,
    }
    return {name: values.tolist() for name, values in ends.items()}
