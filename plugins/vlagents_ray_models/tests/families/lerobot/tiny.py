"""Tiny random LeRobot checkpoints, written by LeRobot itself: `python tiny.py FOLDER [KIND]`."""

# ruff: noqa: E402 - a torchvision without a build for this torch is prepared before anything imports it

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("HF_HUB_OFFLINE", "1")
if __name__ == "__main__":  # as a script, only this folder is on the path
    sys.path.insert(0, str(Path(__file__).parents[5]))

from vlagents_ray.policies.base.accelerator import ensure_torchvision

ensure_torchvision()

import torch
from lerobot.policies.factory import get_policy_class
from transformers import SmolVLMForConditionalGeneration

from benchmarks.checkpoints import lerobot as recipes
from benchmarks.checkpoints.tokenizer import byte_level, fast_tokenizer
from plugins.vlagents_ray_models.tests.families.lerobot import tiny06

STATE, ACTION, SIDE = 6, 6, 64
CHUNK, EXECUTED = 8, 4
CAMERA = "top"


def inputs(side: int = SIDE, state: int = STATE) -> dict[str, Any]:
    return recipes.features([CAMERA], side, state)


def statistics(state: int = STATE, action: int = ACTION) -> dict[str, dict[str, Any]]:
    return recipes.make_statistics(state, action, [f"observation.images.{CAMERA}"])


def act(**settings: Any) -> Any:
    small = {
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 64,
        "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1,
    }
    chunk = {"chunk_size": CHUNK, "n_action_steps": EXECUTED}
    return config_of(
        "act",
        **{"pretrained_backbone_weights": None, "latent_dim": 8, **small, **chunk, **settings},
    )


def ensemble(**settings: Any) -> Any:
    return act(temporal_ensemble_coeff=0.1, n_action_steps=1, **settings)


def full_act(**settings: Any) -> Any:
    """Not tiny: ACT of LeRobot's own sizes (52 million parameters), with two cameras of 224
    pixels, to be measured.
    """
    features = recipes.features(("top", "wrist"), 224, STATE)
    return config_of("act", pretrained_backbone_weights=None, input_features=features, **settings)


def diffusion(**settings: Any) -> Any:
    small = {
        "down_dims": (16, 32),
        "diffusion_step_embed_dim": 16,
        "spatial_softmax_num_keypoints": 8,
    }
    steps = {
        "horizon": CHUNK,
        "n_obs_steps": 2,
        "n_action_steps": EXECUTED,
        "num_train_timesteps": 10,
    }
    steps |= {"num_inference_steps": 3, "pretrained_backbone_weights": None}
    return config_of("diffusion", crop_shape=(56, 56), **small, **steps, **settings)


def vqbet(**settings: Any) -> Any:
    small = {
        "gpt_input_dim": 32,
        "gpt_output_dim": 32,
        "gpt_hidden_dim": 32,
        "gpt_n_layer": 1,
        "gpt_n_head": 2,
    }
    codes = {
        "vqvae_n_embed": 8,
        "vqvae_embedding_dim": 16,
        "vqvae_enc_hidden_dim": 16,
        "bet_softmax_temperature": 5.0,
    }
    codes |= {"pretrained_backbone_weights": None}
    return config_of("vqbet", crop_shape=(56, 56), n_obs_steps=3, **small, **codes, **settings)


def tdmpc(**settings: Any) -> Any:
    small = {
        "latent_dim": 8,
        "mlp_dim": 16,
        "image_encoder_hidden_dim": 4,
        "state_encoder_hidden_dim": 8,
    }
    plan = {
        "horizon": 3,
        "n_gaussian_samples": 16,
        "n_pi_samples": 4,
        "n_elites": 4,
        "cem_iterations": 2,
    }
    return config_of("tdmpc", **small, **plan, **settings)


def sac(**settings: Any) -> Any:
    return config_of("sac", latent_dim=8, shared_encoder=False, use_torch_compile=False, **settings)


def gaussian_actor(**settings: Any) -> Any:
    """SAC's actor in LeRobot 0.6."""
    return config_of("gaussian_actor", latent_dim=8, shared_encoder=False, **settings)


def smolvla(folder: Path, **settings: Any) -> Any:
    size = {
        "scale_factor": 2,
        "vision": {
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "image_size": 64,
            "patch_size": 16,
            "max_image_size": {"longest_edge": 64},
        },
        "text": {
            "hidden_size": 64,
            "intermediate_size": 96,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "head_dim": 16,
            "vocab_size": 400,
        },
    }
    model = recipes.write_smolvlm(folder / "vlm", size)
    if settings.get("load_vlm_weights"):  # the language model is then in bfloat16
        SmolVLMForConditionalGeneration(model).save_pretrained(folder / "vlm")
    chunk = {"chunk_size": CHUNK, "n_action_steps": EXECUTED, "num_steps": 4}
    sizes = {"num_vlm_layers": 2, "resize_imgs_with_padding": (64, 64), "load_vlm_weights": False}
    return config_of(
        "smolvla", vlm_model_name=str(folder / "vlm"), **{**sizes, **chunk, **settings}
    )


def xvla(folder: Path, **settings: Any) -> Any:
    names = {"bos_token": "<s>", "pad_token": "<pad>", "eos_token": "</s>"}
    tokenizer = fast_tokenizer(byte_level(list(names.values())), **names)
    tokenizer.save_pretrained(folder / "tokenizer")
    vision = {
        "model_type": "davit",
        "dim_embed": [8, 16, 32, 64],
        "num_heads": [2, 2, 4, 8],
        "num_groups": [2, 2, 4, 8],
        "depths": [1, 1, 1, 1],
        "projection_dim": 32,
        "patch_size": [7, 3, 3, 3],
        "patch_stride": [4, 2, 2, 2],
        "patch_padding": [3, 1, 1, 1],
        "patch_prenorm": [False, True, True, True],
        "window_size": 2,
        "enable_checkpoint": False,
        "image_feature_source": ["spatial_avg_pool", "temporal_avg_pool"],
        "image_pos_embed": {"type": "learned_abs_2d", "max_pos_embeddings": 50},
        "visual_temporal_embedding": {"type": "COSINE", "max_temporal_embeddings": 100},
    }
    layers = {
        f"{part}_{name}": n
        for part in ("encoder", "decoder")
        for name, n in (("layers", 1), ("ffn_dim", 64))
    }
    heads = {"encoder_attention_heads": 2, "decoder_attention_heads": 2}
    tokens = {"vocab_size": 400, "pad_token_id": 1, "bos_token_id": 0, "eos_token_id": 2}
    text = {"d_model": 32, "max_position_embeddings": 256, **layers, **heads, **tokens}
    florence = {
        "vision_config": vision,
        "text_config": text,
        "projection_dim": 32,
        "vocab_size": 400,
    }
    sizes = {
        "hidden_size": 32,
        "depth": 1,
        "num_heads": 2,
        "num_domains": 2,
        "len_soft_prompts": 4,
        "max_len_seq": 128,
    }
    chunk = {"chunk_size": CHUNK, "n_action_steps": EXECUTED, "num_denoising_steps": 3}
    images = {"num_image_views": 1, "resize_imgs_with_padding": (64, 64)}
    own = {
        "florence_config": florence,
        "tokenizer_name": str(folder / "tokenizer"),
        "action_mode": "auto",
    }
    return config_of("xvla", **own, **sizes, **chunk, **images, **settings)


def groot(folder: Path, **settings: Any) -> Any:
    return config_of("groot", **{**tiny06.groot(folder), "n_action_steps": EXECUTED, **settings})


def vla_jepa(folder: Path, **settings: Any) -> Any:
    return config_of(
        "vla_jepa", **{**tiny06.vla_jepa(folder), "n_action_steps": EXECUTED, **settings}
    )


def eo1(folder: Path, **settings: Any) -> Any:
    return config_of("eo1", **{**tiny06.eo1(folder), "n_action_steps": EXECUTED, **settings})


def wall_x(folder: Path, **settings: Any) -> Any:
    return config_of("wall_x", **{**tiny06.wall_x(folder), "n_action_steps": EXECUTED, **settings})


def evo1(folder: Path, **settings: Any) -> Any:
    return config_of("evo1", **{**tiny06.evo1(folder), "n_action_steps": EXECUTED, **settings})


def multi_task_dit(folder: Path, **settings: Any) -> Any:
    return config_of(
        "multi_task_dit",
        **{**tiny06.multi_task_dit(folder), "n_action_steps": EXECUTED, **settings},
    )


def dit_flow(folder: Path, **settings: Any) -> Any:
    """The multi-task DiT by flow matching, with an encoder for each camera."""
    own = {"objective": "flow_matching", "use_separate_rgb_encoder_per_camera": True}
    return multi_task_dit(folder, **own, **settings)


NEW = int(importlib.metadata.version("lerobot").split(".")[1]) >= 6  # whether this is LeRobot 0.6
_MAKERS: dict[str, Callable[..., Any]] = {
    "act": act,
    "diffusion": diffusion,
    "smolvla": smolvla,
    "xvla": xvla,
    "ensemble": ensemble,
    "vqbet": vqbet,
    "tdmpc": tdmpc,
    "sac": sac,
    "gaussian_actor": gaussian_actor,
    "groot": groot,
    "vla_jepa": vla_jepa,
    "eo1": eo1,
    "evo1": evo1,
    "wall_x": wall_x,
    "multi_task_dit": multi_task_dit,
    "dit_flow": dit_flow,
    "full_act": full_act,
}
# What each kind is tried for, by version: those whose code differs, and all that the older one has.
KINDS = ("act", "diffusion", "smolvla", "xvla", "ensemble", "vqbet", "tdmpc", "sac")
if NEW:
    KINDS = (
        *KINDS[:4],
        "gaussian_actor",
        "groot",
        "multi_task_dit",
        "dit_flow",
        "vla_jepa",
        "eo1",
        "evo1",
        "wall_x",
    )
# Those with files of a tokenizer beside the checkpoint.
_WITH_FILES = {
    "dit_flow",
    "eo1",
    "evo1",
    "groot",
    "multi_task_dit",
    "smolvla",
    "vla_jepa",
    "wall_x",
    "xvla",
}


def make(folder: Path, kind: str = "act", **settings: Any) -> Path:
    """A checkpoint of that kind in `folder`, with `settings` of its LeRobot config; returns
    `folder`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return write(
        folder,
        _MAKERS[kind](folder, **settings) if kind in _WITH_FILES else _MAKERS[kind](**settings),
    )


def write(folder: Path, config: Any) -> Path:
    """The checkpoint of a random policy with that LeRobot config, in `folder`, which is there."""
    torch.manual_seed(0)
    with contextlib.redirect_stdout(io.StringIO()):
        policy = get_policy_class(config.type)(config)
    _unsettle(policy)
    if config.type == "vqbet":
        policy.vqbet.action_head.vqvae_model.discretized.fill_(True)
    policy.save_pretrained(folder)
    with (
        tiny06.local_backbone(folder / "vlm")
        if config.type == "groot"
        else contextlib.nullcontext()
    ):
        recipes.write_processors(folder, config)
    return folder


def config_of(name: str, **settings: Any) -> Any:
    """LeRobot's config of a policy that sees one camera."""
    return recipes.make_config(name, inputs(), ACTION, **settings)


def _unsettle(policy: Any) -> None:
    """Parameters that begin at one value would hide what they multiply: they get values of their
    own.

    X-VLA leaves one as it finds the memory, to be read from a checkpoint.
    """
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if name.endswith("image_projection"):
                parameter.normal_(std=0.1)
            elif parameter.numel() > 1 and (parameter == parameter.flatten()[0]).all():
                parameter.add_(0.1 * torch.randn_like(parameter))


if __name__ == "__main__":
    print(make(Path(sys.argv[1]).resolve(), *sys.argv[2:3]))
