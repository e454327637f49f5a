"""A small random GR00T, saved by NVIDIA's own code: `python tiny.py OUT_FOLDER [KIND]`.

N1.6's network has the size that a file of the checkout says, so that a copy of the checkout with
smaller numbers comes first: `checkout`. KIND is `relative` (joints relative to the state), `libero`
(two robots, one of them LIBERO's), or `history` (frames of two moments, and a transformer that
attends to padding, as all of N1.7 do).
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

# Rows of a chunk, rows that the model computes, most numbers of a state or an action.
HORIZON, ROWS, WIDTH = 6, 8, 8
# The checkout's version.
N17 = (Path(os.environ.get("GR00T_SRC", ".")) / "gr00t/model/gr00t_n1d7").is_dir()
LIBERO = "libero_sim" if N17 else "libero_panda"  # its name of that robot
_SMALL = {
    "hidden_size": 32,
    "intermediate_size": 64,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
}
_HEAD = {
    "num_attention_heads": 2,
    "attention_head_dim": 16,
    "positional_embeddings": None,
    "dropout": 0.2,
}
_EAGLE = "gr00t/model/modules/nvidia/Eagle-Block2A-2B-v2"


def checkout(folder: Path) -> Path:
    """Copy the code of the checkout that GR00T_SRC names, with a small backbone, and import from
    the copy.
    """
    from vlagents_ray_models.gr00t import _use_checkout

    shutil.copytree(Path(os.environ["GR00T_SRC"]) / "gr00t", folder / "gr00t")
    file = folder / _EAGLE / "config.json"
    if not N17:
        config = json.loads(file.read_text())
        config["text_config"] |= {**_SMALL, "num_key_value_heads": 1, "head_dim": 16}
        config["vision_config"] |= {**_SMALL, "full_attention_indexes": [1], "num_patches": 16}
        file.write_text(json.dumps(config))
    _use_checkout(str(folder))
    return folder


def save(folder: Path, kind: str = "relative") -> Path:
    """Write a checkpoint of a kind, with the code that `checkout` imported."""
    import torch
    from gr00t.model import MODEL_REGISTRY
    from transformers.modeling_utils import no_init_weights

    from vlagents_ray_models.gr00t import built_without_flash_attention

    [(config_class, pipeline)] = MODEL_REGISTRY.items()
    model_class, processor_class = pipeline.model_class, pipeline.processor_class
    backbone = {"model_name": _qwen(folder / "nvidia/Cosmos-Reason2-2B")} if N17 else {}
    # The published N1.7 also has layers above the language model.
    upper_layers = {"vl_self_attention_cfg": {**_HEAD, "num_layers": 1}} if N17 else {}
    transformer = {
        **_HEAD,
        "norm_type": "ada_norm",
        "final_dropout": True,
        "interleave_self_attention": True,
        "output_dim": 32,
        "num_layers": 4,
    }
    with built_without_flash_attention(), no_init_weights():
        config = config_class(
            **backbone,
            **upper_layers,
            select_layer=1,
            backbone_embedding_dim=32,
            hidden_size=32,
            input_embedding_dim=32,
            max_state_dim=WIDTH,
            max_action_dim=WIDTH,
            action_horizon=ROWS,
            max_num_embodiments=32,
            max_seq_len=64,
            use_alternate_vl_dit=kind != "history",
            diffusion_model_cfg=transformer,
        )
        model = model_class(config).float()

    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, values in model.named_parameters():
            drawn = torch.randn(values.shape, generator=generator)
            if values.ndim > 1:
                values.copy_(drawn * _scale(name, values))
            else:
                mean = 1.0 if name.endswith("weight") else 0.0  # weights of norms, or biases
                values.copy_(mean + 0.1 * drawn)
    model.save_pretrained(folder)

    configs, statistics = _robots(kind)
    processor_class(
        configs,
        statistics,
        use_albumentations=True,
        shortest_image_edge=56,
        crop_fraction=0.95,
        max_state_dim=WIDTH,
        max_action_dim=WIDTH,
        max_action_horizon=ROWS,
        use_relative_action=True,
        **backbone,
    ).save_pretrained(folder)
    return folder


def _scale(name: str, values: Any) -> float:
    """Return the standard deviation of random weights with which a signal keeps its size, and
    actions stay within their bounds.
    """
    if name.endswith(("embed_tokens.weight", "position_embedding.weight")):
        return 1.0
    inputs = values.shape[1] if values.ndim == 3 else values[0].numel()
    return float(inputs**-0.5) * (0.6 if "action_decoder" in name else 1.0)


def _qwen(folder: Path) -> str:
    """Write the backbone of N1.7, whose name must be in the path of its folder."""
    import torch
    import transformers

    from plugins.vlagents_ray_models.tests.families.lerobot.tiny06 import write_qwen3_vl

    folder.mkdir(parents=True)
    write_qwen3_vl(folder)
    torch.manual_seed(0)
    config = transformers.AutoConfig.from_pretrained(folder)
    transformers.Qwen3VLForConditionalGeneration(config).save_pretrained(folder)
    return str(folder)


def _robots(kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the metadata and the statistics of the robots of a checkpoint."""
    rng = np.random.default_rng(1)

    def bounds(*shape: int) -> dict[str, Any]:
        low, width = rng.uniform(-1, 0, shape), rng.uniform(1, 2, shape)
        high = low + width
        statistics = {
            "min": low,
            "max": high,
            "mean": low,
            "std": width,
            "q01": low,
            "q99": high,
        }
        return {name: values.tolist() for name, values in statistics.items()}

    def config(cameras: list[str], groups: list[str], **action: Any) -> dict[str, Any]:
        return {
            "video": {
                "delta_indices": [-2, 0] if kind == "history" else [0],
                "modality_keys": cameras,
            },
            "state": {"delta_indices": [0], "modality_keys": groups},
            "action": {"delta_indices": list(range(HORIZON)), "modality_keys": groups, **action},
            "language": {
                "delta_indices": [0],
                "modality_keys": ["annotation.human.task_description"],
            },
        }

    represented = [
        {"rep": rep, "type": "NON_EEF", "format": "DEFAULT"} for rep in ("RELATIVE", "ABSOLUTE")
    ]
    groups = {"arm": bounds(5), "gripper": bounds(1)}
    relative = {"arm": bounds(HORIZON, 5)}
    configs = {
        "new_embodiment": config(["ego_view"], ["arm", "gripper"], action_configs=represented)
    }
    statistics = {
        "new_embodiment": {"state": groups, "action": groups, "relative_action": relative}
    }
    if kind == "libero":
        axes = ["x", "y", "z", "roll", "pitch", "yaw"]
        configs[LIBERO] = config(["image", "wrist_image"], [*axes, "gripper"])
        pose = {axis: bounds(1) for axis in axes}
        statistics[LIBERO] = {
            "state": {**pose, "gripper": bounds(2)},
            "action": {**pose, "gripper": bounds(1)},
        }
    return configs, statistics


if __name__ == "__main__":
    out = Path(sys.argv[1])
    checkout(out / "src")
    save(out / "checkpoint", *sys.argv[2:])
