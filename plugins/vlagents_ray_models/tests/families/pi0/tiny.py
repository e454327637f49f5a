"""A small random checkpoint of transformers' pi0, whole: weights, processor, statistics.

python tiny.py OUT_FOLDER [tiny|small]
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from benchmarks.checkpoints import pi0 as recipe

STATE_DIM, ACTION_DIM = recipe.STATE_DIM, recipe.ACTION_DIM
CHUNK = 10
_PATCH = 56  # px: 16 tokens an image
_SIZES = {
    "tiny": recipe.Pi0Size(64, 32, 2, 1, _PATCH),
    "small": recipe.Pi0Size(512, 256, 4, 4, _PATCH),
}


def save(folder: str | Path, kind: str = "tiny", seed: int = 0, statistics: bool = True) -> Path:
    """Write the checkpoint into `folder`."""
    folder, size = Path(folder), _SIZES[kind]
    processor = recipe.make_processor(size, CHUNK, recipe.make_statistics() if statistics else None)
    torch.manual_seed(seed)
    config = recipe.make_config(processor, size, chunk_size=CHUNK, num_inference_steps=5)
    model = recipe.transformers_class("PI0ForConditionalGeneration")(config)
    with torch.no_grad():  # biases are made zeros: were one lost on the way, nobody would notice
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


if __name__ == "__main__":
    print(save(*sys.argv[1:3]))
