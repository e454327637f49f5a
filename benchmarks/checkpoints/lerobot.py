"""Random checkpoints of LeRobot's policies: SmolVLA, π0.5, ACT and Diffusion."""

from __future__ import annotations

import contextlib
import importlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.checkpoints.recipe import Recipe, WrittenCheckpoint
from benchmarks.checkpoints.tokenizer import SPECIAL, byte_level, fast_tokenizer
from benchmarks.checkpoints.weights import parameters_on_meta, write_weights
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.registry import require
from vlagents_ray_models.lerobot.checkpoint import require_served

JOINTS = 6  # number of joints of an SO-100
_IMAGE_TOKENS = ("<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>")
# SmolVLM2-500M, whose first 16 layers SmolVLA uses
# (huggingface.co/HuggingFaceTB/SmolVLM2-500M-Video-Instruct)
SMOLVLM: Mapping[str, Any] = {
    "scale_factor": 4,
    "vision": {
        "hidden_size": 768,
        "intermediate_size": 3072,
        "num_hidden_layers": 12,
        "num_attention_heads": 12,
        "image_size": 512,
        "patch_size": 16,
        "max_image_size": {"longest_edge": 512},
    },
    "text": {
        "hidden_size": 960,
        "intermediate_size": 2560,
        "num_hidden_layers": 32,
        "num_attention_heads": 15,
        "num_key_value_heads": 5,
        "head_dim": 64,
        "vocab_size": 49280,
        "max_position_embeddings": 8192,
        "rope_theta": 100000,
        "rms_norm_eps": 1e-5,
    },
}
_SMALL_SMOLVLM: Mapping[str, Any] = {
    "scale_factor": 4,
    "vision": SMOLVLM["vision"]
    | {
        "hidden_size": 192,
        "intermediate_size": 768,
        "num_hidden_layers": 4,
        "num_attention_heads": 3,
    },
    "text": SMOLVLM["text"]
    | {
        "hidden_size": 384,
        "intermediate_size": 1024,
        "num_hidden_layers": 8,
        "num_attention_heads": 6,
        "num_key_value_heads": 2,
        "vocab_size": 400,
    },
}


def write(recipe: Recipe) -> WrittenCheckpoint:
    """Write a checkpoint with LeRobot's own default settings, or of a smaller network."""
    policy, config = make_policy(recipe)
    # LeRobot reads only one file of weights.
    parameters = write_weights(policy, recipe.folder, shard_bytes=None)
    config.save_pretrained(recipe.folder)
    tokenizer = recipe.folder / "tokenizer"
    if recipe.family == "pi05":
        fast_tokenizer().save_pretrained(tokenizer)
    with local_tokenizer(config.type, tokenizer):
        write_processors(recipe.folder, config)
    return WrittenCheckpoint("lerobot", parameters, {"checkpoint": str(recipe.folder)})


def make_policy(recipe: Recipe) -> tuple[Any, Any]:
    """Return LeRobot's policy, on the device meta unless it is small, and its config.

    The files that SmolVLA's config names are written to the folder of the recipe.
    """
    ensure_torchvision()
    config = _CONFIGS[recipe.family](recipe)
    policy_class = require("lerobot.policies.factory").get_policy_class(config.type)
    filled = recipe.family in ("act", "diffusion")  # Diffusion runs its backbone on construction
    device = config.device
    with (
        contextlib.nullcontext() if filled else parameters_on_meta(),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        config.device = device if filled else "meta"
        policy = policy_class(config)
    config.device = device
    if recipe.family == "smolvla" and recipe.dtype == "bfloat16":
        # as in the published checkpoint: the language model's weights, with which LeRobot began,
        # are bfloat16, and all others are float32
        policy.model.vlm_with_expert.vlm.to(require("torch").bfloat16)
        config.load_vlm_weights = True
    return policy, config


def make_config(
    name: str, inputs: Mapping[str, Any], actions: int = JOINTS, **settings: Any
) -> Any:
    """Return LeRobot's config of a policy with these `features`, on the CPU."""
    types = require("lerobot.configs.types")
    features = {
        "input_features": dict(inputs),
        "output_features": {"action": types.PolicyFeature(types.FeatureType.ACTION, (actions,))},
    }
    factory = require("lerobot.policies.factory")
    return factory.make_policy_config(
        name, device="cpu", push_to_hub=False, **{**features, **settings}
    )


def features(cameras: Sequence[str], side: int, state: int = JOINTS) -> dict[str, Any]:
    """Return LeRobot's features of square images and a state."""
    types = require("lerobot.configs.types")
    image = types.PolicyFeature(types.FeatureType.VISUAL, (3, side, side))
    images = {f"observation.images.{name}": image for name in cameras}
    return {**images, "observation.state": types.PolicyFeature(types.FeatureType.STATE, (state,))}


def make_statistics(
    state: int = JOINTS, actions: int = JOINTS, cameras: Sequence[str] = ()
) -> dict[str, dict[str, np.ndarray]]:
    """Return statistics of an invented dataset; no statistic is the identity, and all cameras have
    the same statistics.
    """
    rng = np.random.default_rng(0)

    def of(*shape: int) -> dict[str, np.ndarray]:
        mean, spread = rng.uniform(-0.2, 0.2, shape), rng.uniform(0.5, 1.5, shape)
        bounds = {
            "min": mean - spread,
            "max": mean + spread,
            "q01": mean - spread,
            "q99": mean + spread,
        }
        return {
            name: value.astype(np.float32)
            for name, value in {"mean": mean, "std": spread, **bounds}.items()
        }

    found = {"observation.state": of(state), "action": of(actions)}
    return found | dict.fromkeys(cameras, of(3, 1, 1))


def write_processors(folder: Path, config: Any) -> None:
    """Write the pipelines before and after a policy, with the statistics of the policy's
    features.
    """
    [state], [actions] = config.robot_state_feature.shape, config.action_feature.shape
    statistics = make_statistics(state, actions, list(config.image_features))
    for pipeline in require("lerobot.policies.factory").make_pre_post_processors(
        config, dataset_stats=statistics
    ):
        pipeline.save_pretrained(folder)


@contextlib.contextmanager
def local_tokenizer(kind: str, folder: Path) -> Iterator[None]:
    """Make π0's and π0.5's pipelines name a tokenizer in `folder` instead of LeRobot's tokenizer,
    which would be downloaded.
    """
    if not folder.is_dir():
        yield
        return
    module: Any = importlib.import_module(f"lerobot.policies.{kind}.processor_{kind}")
    step = module.TokenizerProcessorStep
    module.TokenizerProcessorStep = lambda **given: step(**given | {"tokenizer_name": str(folder)})
    try:
        yield
    finally:
        module.TokenizerProcessorStep = step


def write_smolvlm(folder: Path, size: Mapping[str, Any]) -> Any:
    """Write config and processor of SmolVLM to `folder`, which SmolVLA's config names, and return
    the config.
    """
    transformers = require("transformers")
    pad, begin, end = SPECIAL.values()
    tokens = byte_level([pad, begin, end, *_IMAGE_TOKENS])
    kinds = ("image_token", "fake_image_token", "global_image_token", "end_of_utterance_token")
    tokenizer = fast_tokenizer(
        tokens, **SPECIAL, extra_special_tokens=dict(zip(kinds, _IMAGE_TOKENS, strict=True))
    )  # fmt: skip
    ids = {name: tokens.token_to_id(word) for name, word in SPECIAL.items()}
    config = transformers.SmolVLMConfig(
        image_token_id=tokens.token_to_id(_IMAGE_TOKENS[0]),
        scale_factor=size["scale_factor"],
        pad_token_id=ids["pad_token"],
        vision_config=dict(size["vision"]),
        text_config={
            "model_type": "llama",
            **{f"{name}_id": number for name, number in ids.items()},
            **size["text"],
        },
    )
    config.save_pretrained(folder)
    video = require("transformers.models.smolvlm.video_processing_smolvlm").SmolVLMVideoProcessor()
    images = transformers.SmolVLMImageProcessor()
    transformers.SmolVLMProcessor(images, tokenizer, video, chat_template=None).save_pretrained(
        folder
    )
    return config


def _smolvla(recipe: Recipe) -> Any:
    small = recipe.size == "small"
    write_smolvlm(recipe.folder / "vlm", _SMALL_SMOLVLM if small else SMOLVLM)
    return make_config(
        "smolvla",
        features(("camera1", "camera2", "camera3"), 256),
        vlm_model_name=str(recipe.folder / "vlm"),
        load_vlm_weights=False,
        **({"num_vlm_layers": 8} if small else {}),
    )


def _pi05(recipe: Recipe) -> Any:
    if recipe.size == "small":
        raise ConfigError(
            "--size small: LeRobot's pi05 has no smaller size; make pi0, whose network is alike, "
            "or full"
        )
    require_served("pi05", recipe.folder)
    cameras = ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb")
    return make_config("pi05", features(cameras, 224, 32), 32, dtype=recipe.dtype)


def _act(recipe: Recipe) -> Any:
    small: dict[str, Any] = (
        {"dim_model": 256, "dim_feedforward": 1024, "n_heads": 4} if recipe.size == "small" else {}
    )
    return make_config(
        "act", features(("top", "wrist"), 224), pretrained_backbone_weights=None, **small
    )


def _diffusion(recipe: Recipe) -> Any:
    small: dict[str, Any] = {"down_dims": (128, 256, 512)} if recipe.size == "small" else {}
    return make_config(
        "diffusion", features(("top", "wrist"), 96), pretrained_backbone_weights=None, **small
    )


_CONFIGS: Mapping[str, Callable[[Recipe], Any]] = {
    "smolvla": _smolvla,
    "pi05": _pi05,
    "act": _act,
    "diffusion": _diffusion,
}
