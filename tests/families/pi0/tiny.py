"""A small random checkpoint of transformers' pi0, whole: weights, processor, statistics.

python tests/families/pi0/tiny.py OUT_FOLDER [tiny|small]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tokenizers import Tokenizer, models, pre_tokenizers, trainers

from vlagents_ray.policies.base.accelerator import ensure_torchvision

ensure_torchvision()  # before transformers, which imports it
from transformers import PI0Config, PI0ForConditionalGeneration, PreTrainedTokenizerFast  # noqa: E402
from transformers.models.pi0.image_processing_pi0 import PI0ImageProcessor  # noqa: E402
from transformers.models.pi0.processing_pi0 import PI0Processor  # noqa: E402

STATE_DIM, ACTION_DIM, CHUNK = 8, 7, 10
_PATCH = 56  # px: 16 tokens an image
# width of the language model and of the action expert, layers of both, layers of the vision tower
_SIZES = {"tiny": (64, 32, 2, 1), "small": (512, 256, 4, 4)}


def save(folder: str | Path, kind: str = "tiny", seed: int = 0, statistics: bool = True) -> Path:
    """Write the checkpoint into `folder`."""
    folder = Path(folder)
    tokenizer = _tokenizer()
    images = PI0ImageProcessor()
    images.image_seq_length = (224 // _PATCH) ** 2
    processor = PI0Processor(images, tokenizer, **(_statistics() if statistics else {}), chunk_size=CHUNK)
    torch.manual_seed(seed)
    model = PI0ForConditionalGeneration(_config(kind, len(tokenizer), processor.image_token_id))
    with torch.no_grad():  # biases are made zeros: were one lost on the way, nobody would notice
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


def _tokenizer() -> PreTrainedTokenizerFast:
    bytes_only = Tokenizer(models.BPE())
    bytes_only.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    special = ["<pad>", "<eos>", "<bos>"]
    trainer = trainers.BpeTrainer(vocab_size=300, special_tokens=special, initial_alphabet=alphabet)
    bytes_only.train_from_iterator(["pick up the cube\n", "open the drawer\n"], trainer)
    names = dict(zip(("pad_token", "eos_token", "bos_token"), special, strict=True))
    return PreTrainedTokenizerFast(tokenizer_object=bytes_only, **names)


def _statistics() -> dict[str, list[float]]:
    rng = np.random.default_rng(1)
    return {
        "state_mean": rng.normal(0, 0.3, STATE_DIM).tolist(),
        "state_std": rng.uniform(0.5, 1.5, STATE_DIM).tolist(),
        "actions_mean": rng.normal(0, 0.3, ACTION_DIM).tolist(),
        "actions_std": rng.uniform(0.5, 1.5, ACTION_DIM).tolist(),
    }


def _config(kind: str, words: int, image_token: int) -> PI0Config:
    width, expert_width, layers, vision_layers = _SIZES[kind]
    heads: dict[str, Any] = {"num_attention_heads": 4, "num_key_value_heads": 1, "head_dim": width // 4}
    return PI0Config(
        vlm_config={
            "model_type": "paligemma",
            "text_config": {
                "model_type": "gemma",
                "hidden_size": width,
                "num_hidden_layers": layers,
                "intermediate_size": 4 * width,
                "vocab_size": words + 8,
                **heads,
            },
            "vision_config": {
                "model_type": "siglip_vision_model",
                "hidden_size": width,
                "intermediate_size": 2 * width,
                "patch_size": _PATCH,
                "image_size": 224,
                "num_hidden_layers": vision_layers,
                "num_attention_heads": 4,
                "vision_use_head": False,
            },
            "projection_dim": width,
            "image_token_id": image_token,
        },
        dit_config={
            "model_type": "gemma",
            "hidden_size": expert_width,
            "num_hidden_layers": layers,
            "intermediate_size": 4 * expert_width,
            **heads,
        },
        chunk_size=CHUNK,
        num_inference_steps=5,
    )


if __name__ == "__main__":
    print(save(*sys.argv[1:3]))
