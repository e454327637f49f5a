"""A small random checkpoint of V-JEPA 2-AC, made by upstream's own code.

VJEPA2_SRC=… python tiny.py FILE.pt
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray_models.model_code import use_source

SIDE, PATCH, WIDTH, HEADS = 32, 16, 48, 2
SETTINGS: dict[str, Any] = {
    "image_size": SIDE,
    "encoder_heads": HEADS,
    "predictor_heads": HEADS,
    "samples": 12,
    "topk": 4,
    "iterations": 3,
}


def randomize(model: Any, seed: int) -> Any:
    """Weights that are nowhere zero, so that each of them matters."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    return model.eval()


def make_hf_encoder(folder: Path) -> Path:
    """A `VJEPA2Model` as transformers saves it; needs no source."""
    ensure_torchvision()
    from transformers import VJEPA2Config, VJEPA2Model

    config = VJEPA2Config(
        patch_size=PATCH,
        crop_size=SIDE,
        hidden_size=WIDTH,
        num_attention_heads=HEADS,
        num_hidden_layers=2,
        pred_hidden_size=24,
        pred_num_attention_heads=2,
        pred_num_hidden_layers=1,
    )
    randomize(VJEPA2Model(config), 2).save_pretrained(folder)
    return folder


def make_models() -> tuple[Any, Any]:
    """Upstream's encoder and predictor."""
    ensure_torchvision()
    use_source("src", "VJEPA2_SRC")
    import torch
    from src.models.ac_predictor import vit_ac_predictor
    from src.models.vision_transformer import VisionTransformer

    torch.manual_seed(0)
    encoder = VisionTransformer(
        img_size=(SIDE, SIDE),
        patch_size=PATCH,
        num_frames=4,
        tubelet_size=2,
        embed_dim=WIDTH,
        depth=2,
        num_heads=HEADS,
        mlp_ratio=48 / 11,
        norm_layer=partial(torch.nn.LayerNorm, eps=1e-6),
        use_rope=True,
    )
    predictor = vit_ac_predictor(
        img_size=(SIDE, SIDE),
        patch_size=PATCH,
        num_frames=8,
        tubelet_size=2,
        embed_dim=WIDTH,
        predictor_embed_dim=32,
        depth=2,
        num_heads=HEADS,
    )
    return randomize(encoder, 0), randomize(predictor, 1)


def make_checkpoint(file: Path) -> Path:
    """As upstream's training writes it: a file with several state dicts and the prefixes of its
    wrappers.
    """
    import torch

    encoder, predictor = make_models()
    torch.save(
        {
            "encoder": {
                f"module.backbone.{name}": tensor for name, tensor in encoder.state_dict().items()
            },
            "predictor": {
                f"module.{name}": tensor for name, tensor in predictor.state_dict().items()
            },
            "epoch": 1,
        },
        file,
    )
    return file


if __name__ == "__main__":
    make_checkpoint(Path(sys.argv[1]))
