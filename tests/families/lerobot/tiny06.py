"""Files and sizes of tiny policies that only LeRobot 0.6 has, as settings of their configs."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
import transformers

from vlagents_ray.bench.checkpoints.tokenizer import byte_level, fast_tokenizer

_VISION = ("<|vision_start|>", "<|image_pad|>", "<|vision_end|>", "<|video_pad|>")
_CHAT = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part['text'] }}{% endif %}"
    "{% endfor %}<|im_end|>\n{% endfor %}"
)
SIDE = 64  # of the images that GR00T's vision model gets


def write_qwen3_vl(folder: Path) -> None:
    """The config and the processor of a Qwen3-VL, which is GR00T's backbone, in `folder`."""
    names = {"pad_token": "<pad>", "bos_token": "<|im_start|>", "eos_token": "<|im_end|>"}
    tokens = byte_level([*names.values(), *_VISION])
    tokenizer = fast_tokenizer(tokens, **names)
    tokenizer.chat_template = _CHAT
    tokenizer.save_pretrained(folder)
    start, image, end, video = (tokens.token_to_id(word) for word in _VISION)
    vision = {
        "depth": 2,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_heads": 2,
        "num_position_embeddings": 16,
        "out_hidden_size": 32,
        "deepstack_visual_indexes": [0],
    }
    text = {
        "vocab_size": 400,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "head_dim": 16,
        "rope_scaling": {"mrope_interleaved": True, "mrope_section": [4, 2, 2], "rope_type": "default"},
    }
    ids = {"image_token_id": image, "video_token_id": video}
    marks = {"vision_start_token_id": start, "vision_end_token_id": end}
    transformers.Qwen3VLConfig(
        text_config=text, vision_config=vision, tie_word_embeddings=True, **ids, **marks
    ).save_pretrained(folder)
    size = {"shortest_edge": 32 * 32, "longest_edge": SIDE * SIDE}
    sizes = {"size": size, "patch_size": 16, "merge_size": 2, "temporal_patch_size": 2}
    transformers.Qwen2VLImageProcessor(**sizes).save_pretrained(folder)
    from transformers.models.qwen3_vl.video_processing_qwen3_vl import Qwen3VLVideoProcessor

    Qwen3VLVideoProcessor(**sizes).save_pretrained(folder)


def groot(folder: Path) -> dict[str, Any]:
    """A base of GR00T N1.7 in `folder`, and the settings of a policy over it."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config

    write_qwen3_vl(folder / "vlm")
    attention = {"num_attention_heads": 2, "attention_head_dim": 16, "positional_embeddings": None, "dropout": 0.0}
    own = {"norm_type": "ada_norm", "interleave_self_attention": True, "output_dim": 32, "num_layers": 4}
    torch.manual_seed(0)
    config = GR00TN17Config(
        model_name=str(folder / "vlm"),
        model_dtype="float32",
        dtype="float32",
        select_layer=1,
        backbone_embedding_dim=32,
        hidden_size=32,
        input_embedding_dim=32,
        max_seq_len=64,
        max_num_embodiments=12,
        action_horizon=8,
        diffusion_model_cfg={**attention, **own},
        vl_self_attention_cfg={**attention, "num_layers": 1},
    )
    GR00TN17(config, load_backbone_weights=False).save_pretrained(folder / "base")
    return {"base_model_path": str(folder / "base"), "chunk_size": 8, "use_bf16": False}


def multi_task_dit(folder: Path) -> dict[str, Any]:
    """A CLIP in `folder`, and the settings of a policy with its encoders."""
    clip = folder / "clip"
    names = {"bos_token": "<s>", "eos_token": "</s>", "pad_token": "<pad>"}
    tokens = byte_level(list(names.values()))
    fast_tokenizer(tokens, **names).save_pretrained(clip)
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = {"vocab_size": 400, "max_position_embeddings": 77, "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 2}
    vision = {"image_size": 32, "patch_size": 16}
    torch.manual_seed(0)
    config = transformers.CLIPConfig(text_config={**sizes, **text}, vision_config={**sizes, **vision})
    transformers.CLIPModel(config).save_pretrained(clip)
    return {
        "vision_encoder_name": str(clip),
        "text_encoder_name": str(clip),
        "image_crop_shape": (32, 32),
        "hidden_dim": 32,
        "num_layers": 1,
        "num_heads": 2,
        "timestep_embed_dim": 16,
        "horizon": 8,
        "num_train_timesteps": 10,
        "num_inference_steps": 3,
        "num_integration_steps": 3,
    }


@contextlib.contextmanager
def local_backbone(folder: Path) -> Iterator[None]:
    """Let GR00T's pipelines name the processor in `folder`; LeRobot names one that would be downloaded."""
    module: Any = importlib.import_module("lerobot.policies.groot.processor_groot")
    name = module.GROOT_N1_7_BACKBONE_MODEL
    module.GROOT_N1_7_BACKBONE_MODEL = str(folder)
    try:
        yield
    finally:
        module.GROOT_N1_7_BACKBONE_MODEL = name
