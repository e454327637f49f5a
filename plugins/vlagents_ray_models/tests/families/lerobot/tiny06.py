"""Files and sizes of tiny policies that only LeRobot 0.6 has, as settings of their configs."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import transformers

from benchmarks.checkpoints.tokenizer import byte_level, fast_tokenizer

_VISION = ("<|vision_start|>", "<|image_pad|>", "<|vision_end|>", "<|video_pad|>")
_ACTIONS = ("<|propri|>", "<|action|>", "<|action_fast|>")  # actions of WALL-X
_CHAT = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n"
    "{% for part in message['content'] %}{% if part['type'] == 'image' "
    "%}<|vision_start|><|image_pad|><|vision_end|>{% else %}{{ part['text'] }}{% endif %}{% endfor "
    "%}<|im_end|>\n"
    "{% endfor %}"
)
SIDE = 64  # side of the images that GR00T's vision model gets


def _write_chat_tokenizer(folder: Path) -> dict[str, int]:
    """A tokenizer with a template for chats with images; the ids that a Qwen's config wants of
    it.
    """
    names = {"pad_token": "<pad>", "bos_token": "<|im_start|>", "eos_token": "<|im_end|>"}
    tokens = byte_level([*names.values(), *_VISION, *_ACTIONS])
    tokenizer = fast_tokenizer(tokens, **names)
    tokenizer.chat_template = _CHAT
    tokenizer.save_pretrained(folder)
    kinds = ("vision_start", "image", "vision_end", "video")
    return {
        f"{kind}_token_id": tokens.token_to_id(word)
        for kind, word in zip(kinds, _VISION, strict=True)
    }


def write_qwen3_vl(folder: Path) -> None:
    """The config and the processor of a Qwen3-VL, which is GR00T's backbone, in `folder`."""
    tokens = _write_chat_tokenizer(folder)
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
        "rope_scaling": {
            "mrope_interleaved": True,
            "mrope_section": [4, 2, 2],
            "rope_type": "default",
        },
    }
    transformers.Qwen3VLConfig(
        text_config=text, vision_config=vision, tie_word_embeddings=True, **tokens
    ).save_pretrained(folder)
    size = {"shortest_edge": 32 * 32, "longest_edge": SIDE * SIDE}
    sizes = {"size": size, "patch_size": 16, "merge_size": 2, "temporal_patch_size": 2}
    transformers.Qwen2VLImageProcessor(**sizes).save_pretrained(folder)
    from transformers.models.qwen3_vl.video_processing_qwen3_vl import Qwen3VLVideoProcessor

    Qwen3VLVideoProcessor(**sizes).save_pretrained(folder)


def vla_jepa(folder: Path) -> dict[str, Any]:
    """A Qwen3-VL in `folder`, and the settings of a policy over it, without the world model of
    its training.
    """
    write_qwen3_vl(folder / "vlm")
    torch.manual_seed(0)
    config = transformers.AutoConfig.from_pretrained(folder / "vlm")
    config.text_config.initializer_range = 0.2  # so that few words change much
    transformers.Qwen3VLForConditionalGeneration(config).save_pretrained(folder / "vlm")
    return {
        "qwen_model_name": str(folder / "vlm"),
        "enable_world_model": False,
        "chunk_size": 8,
        "action_model_type": "DiT-test",
        "action_hidden_size": 32,
        "action_num_layers": 2,
        "num_inference_timesteps": 2,
        "num_embodied_action_tokens_per_instruction": 4,
        "torch_dtype": "float32",
    }


def eo1(folder: Path) -> dict[str, Any]:
    """A Qwen2.5-VL in `folder`, and the settings of a policy over it."""
    config = write_qwen2_5_vl(folder / "vlm")
    torch.manual_seed(0)
    transformers.Qwen2_5_VLForConditionalGeneration(config).save_pretrained(folder / "vlm")
    pixels = {"image_min_pixels": 28 * 28, "image_max_pixels": 56 * 56}
    own = {
        "num_denoise_steps": 2,
        "max_state_dim": 8,
        "max_action_dim": 8,
        "dtype": "float32",
        "chunk_size": 8,
    }
    return {"vlm_base": str(folder / "vlm"), **pixels, **own}


def write_qwen2_5_vl(
    folder: Path, config_class: type = transformers.Qwen2_5_VLConfig, **text: Any
) -> Any:
    """The processor and the config, which is returned, of a Qwen2.5-VL, which EO-1 and WALL-X
    have, in `folder`.
    """
    tokens = _write_chat_tokenizer(folder)
    text |= {
        "vocab_size": 400,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "num_key_value_heads": 1,
        "rope_scaling": {"mrope_section": [2, 3, 3], "rope_type": "default"},
    }
    vision = {
        "depth": 2,
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_heads": 2,
        "out_hidden_size": 32,
    }
    vision |= {"fullatt_block_indexes": [1], "window_size": 56}
    config = config_class(
        text_config=text, vision_config=vision, tie_word_embeddings=True, **tokens
    )
    config.save_pretrained(folder)
    sizes = {"size": {"shortest_edge": 28 * 28, "longest_edge": 56 * 56}}
    transformers.Qwen2VLImageProcessor(**sizes).save_pretrained(folder)
    transformers.Qwen2VLVideoProcessor(**sizes).save_pretrained(folder)
    return config


def wall_x(folder: Path) -> dict[str, Any]:
    """A base of WALL-X in `folder`, and the settings of a policy over it."""
    from lerobot.policies.wall_x.modeling_wall_x import Qwen2_5_VLMoEForAction
    from lerobot.policies.wall_x.qwen_model import Qwen2_5_VLConfig

    expert = {"hidden_size": 32, "intermediate_size": 64, "hidden_act": "silu"}
    experts = {
        "num_experts": 2,
        "experts": [expert, expert],
        "dim_inputs": (32, 32),
        "mlp_moe": True,
    }
    sizes = {"dof_config": {"arm": 8}, "agent_pos_config": {"arm": 8}}
    config = write_qwen2_5_vl(folder / "vlm", Qwen2_5_VLConfig, **experts)
    for name, value in sizes.items():
        setattr(config, name, value)
        setattr(config.text_config, name, value)
    config.save_pretrained(folder / "vlm")
    torch.manual_seed(0)
    processor = transformers.AutoProcessor.from_pretrained(folder / "vlm")
    model = Qwen2_5_VLMoEForAction(config, processor=processor)
    model.resize_token_embeddings(len(processor.tokenizer))
    weights = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    safetensors.torch.save_file(weights, folder / "vlm" / "model.safetensors")
    own = {
        "max_state_dim": 8,
        "max_action_dim": 8,
        "chunk_size": 8,
        "vision_attn_implementation": "sdpa",
    }
    return {"pretrained_name_or_path": str(folder / "vlm"), **own}


def evo1(folder: Path) -> dict[str, Any]:
    """An InternVL3 in `folder`, and the settings of a policy over it."""
    names = {"pad_token": "<pad>", "bos_token": "<s>", "eos_token": "</s>"}
    tokens = byte_level([*names.values(), "<img>", "</img>", "<IMG_CONTEXT>"])
    fast_tokenizer(tokens, **names).save_pretrained(folder / "vlm")
    sizes = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
    }
    torch.manual_seed(0)
    config = transformers.InternVLConfig(
        vision_config={**sizes, "image_size": [56, 56], "patch_size": [14, 14]},
        text_config={**sizes, "model_type": "qwen2", "vocab_size": 400, "num_key_value_heads": 1},
        image_token_id=tokens.token_to_id("<IMG_CONTEXT>"),
        image_seq_length=4,
    )
    transformers.InternVLModel(config).save_pretrained(folder / "vlm")
    views = {"max_views": 1, "image_resolution": (56, 56), "max_state_dim": 8, "max_action_dim": 8}
    head = {
        "embed_dim": 32,
        "hidden_dim": 32,
        "state_hidden_dim": 32,
        "num_heads": 2,
        "num_layers": 1,
    }
    own = {
        "vlm_num_layers": 1,
        "vlm_dtype": "float32",
        "num_inference_timesteps": 2,
        "chunk_size": 8,
    }
    return {"vlm_model_name": str(folder / "vlm"), **views, **head, **own}


def groot(folder: Path) -> dict[str, Any]:
    """A base of GR00T N1.7 in `folder`, and the settings of a policy over it."""
    from lerobot.policies.groot.groot_n1_7 import GR00TN17, GR00TN17Config

    write_qwen3_vl(folder / "vlm")
    attention = {
        "num_attention_heads": 2,
        "attention_head_dim": 16,
        "positional_embeddings": None,
        "dropout": 0.0,
    }
    own = {
        "norm_type": "ada_norm",
        "interleave_self_attention": True,
        "output_dim": 32,
        "num_layers": 4,
    }
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
    sizes = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
    }
    text = {
        "vocab_size": 400,
        "max_position_embeddings": 77,
        "bos_token_id": 0,
        "eos_token_id": 1,
        "pad_token_id": 2,
    }
    vision = {"image_size": 32, "patch_size": 16}
    torch.manual_seed(0)
    config = transformers.CLIPConfig(
        text_config={**sizes, **text}, vision_config={**sizes, **vision}
    )
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
    """Let GR00T's pipelines name the processor in `folder`; LeRobot names one that would be
    downloaded.
    """
    module: Any = importlib.import_module("lerobot.policies.groot.processor_groot")
    name = module.GROOT_N1_7_BACKBONE_MODEL
    module.GROOT_N1_7_BACKBONE_MODEL = str(folder)
    try:
        yield
    finally:
        module.GROOT_N1_7_BACKBONE_MODEL = name
