"""A small random Diffusion Policy, saved by its authors' own code: `python …/tiny.py OUT_FOLDER
[KIND]`.

KIND is `unet` or `transformer` (a state of 4 numbers), `image` or `hybrid` (one camera and a state
of 2), or `random_crops`, a hybrid that crops at random while it acts.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray_models.model_code import use_source

HORIZON, OBS_STEPS, ACTION_STEPS, OBS, ACTION, SIDE = 8, 2, 4, 4, 2, 48
SCHEDULER = {
    "_target_": "diffusers.schedulers.scheduling_ddpm.DDPMScheduler",
    "num_train_timesteps": 5,
    # squaredcos_cap_v2 first divides by nearly zero: rounding is amplified.
    "beta_schedule": "linear",
    "variance_type": "fixed_small",
    "clip_sample": True,
    "prediction_type": "epsilon",
}
SHAPES = {
    "obs": {
        "image": {"shape": [3, SIDE, SIDE], "type": "rgb"},
        "agent_pos": {"shape": [2], "type": "low_dim"},
    },
    "action": {"shape": [ACTION]},
}
UNET = {"diffusion_step_embed_dim": 16, "down_dims": [16, 32], "kernel_size": 3, "n_groups": 8}


def save(
    folder: Path, kind: str = "unet", *, normalizer: bool = True, use_ema: bool = True
) -> Path:
    """Write `folder`/checkpoints/latest.ckpt as the workspaces of the training do, and return the
    file.
    """
    ensure_torchvision()
    use_source("diffusion_policy", "DIFFUSION_POLICY_SRC")
    import hydra
    import torch
    from diffusion_policy.workspace.base_workspace import BaseWorkspace
    from omegaconf import OmegaConf

    # The models are too small for several threads, which would wait for one another.
    torch.set_num_threads(1)
    torch.manual_seed(0)
    settings = OmegaConf.create(
        {"policy": _policy(kind), "training": {"use_ema": use_ema}, "task": {}}
    )
    workspace: Any = BaseWorkspace(settings, output_dir=str(folder))
    workspace.ema_model = hydra.utils.instantiate(settings.policy)
    if normalizer:
        workspace.ema_model.set_normalizer(_normalizer(kind))
    folder.mkdir(parents=True, exist_ok=True)
    return Path(workspace.save_checkpoint(use_thread=False))


def _policy(kind: str) -> dict[str, Any]:
    common = {
        "horizon": HORIZON,
        "n_obs_steps": OBS_STEPS,
        "n_action_steps": ACTION_STEPS,
        "num_inference_steps": SCHEDULER["num_train_timesteps"],
        "noise_scheduler": SCHEDULER,
    }
    module = "diffusion_policy.policy.diffusion_{}_policy.Diffusion{}Policy"
    if kind == "unet":
        model = {
            "_target_": "diffusion_policy.model.diffusion.conditional_unet1d.ConditionalUnet1D",
            "input_dim": ACTION,
            "global_cond_dim": OBS * OBS_STEPS,
            "cond_predict_scale": True,
            **UNET,
        }
        target = module.format("unet_lowdim", "UnetLowdim")
        settings = {"obs_dim": OBS, "action_dim": ACTION, "obs_as_global_cond": True}
        specific = {"model": model, **settings}
    elif kind == "transformer":
        model = {
            "_target_": "diffusion_policy.model.diffusion.transformer_for_diffusion.TransformerForDiffusion",
            "input_dim": ACTION,
            "output_dim": ACTION,
            "horizon": HORIZON,
            "n_obs_steps": OBS_STEPS,
            "cond_dim": OBS,
            "n_layer": 1,
            "n_head": 2,
            "n_emb": 16,
            "causal_attn": True,
            "obs_as_cond": True,
        }
        target = module.format("transformer_lowdim", "TransformerLowdim")
        settings = {"obs_dim": OBS, "action_dim": ACTION, "obs_as_cond": True}
        specific = {"model": model, **settings}
    elif kind == "image":
        encoder = {
            "_target_": "diffusion_policy.model.vision.multi_image_obs_encoder.MultiImageObsEncoder",
            "shape_meta": SHAPES,
            "rgb_model": {
                "_target_": "diffusion_policy.model.vision.model_getter.get_resnet",
                "name": "resnet18",
                "weights": None,
            },
            "crop_shape": [40, 40],
            "random_crop": True,
            "use_group_norm": True,
            "imagenet_norm": True,
        }
        target = module.format("unet_image", "UnetImage")
        specific = {"obs_encoder": encoder, "shape_meta": SHAPES, **UNET}
    else:
        target = module.format("unet_hybrid_image", "UnetHybridImage")
        crop = {"crop_shape": [40, 40], "eval_fixed_crop": kind == "hybrid"}
        specific = {"shape_meta": SHAPES, "obs_encoder_group_norm": True, **crop, **UNET}
    return {"_target_": target, **common, **specific}


def _normalizer(kind: str) -> Any:
    from diffusion_policy.common.normalize_util import get_image_range_normalizer
    from diffusion_policy.model.common.normalizer import LinearNormalizer

    rng = np.random.default_rng(0)
    action = rng.uniform(-3, 5, (50, ACTION)).astype(np.float32)
    normalizer = LinearNormalizer()
    if kind in ("unet", "transformer"):
        normalizer.fit({"action": action, "obs": rng.uniform(-2, 1, (50, OBS)).astype(np.float32)})
        return normalizer
    normalizer.fit({"action": action, "agent_pos": rng.uniform(-2, 1, (50, 2)).astype(np.float32)})
    normalizer["image"] = get_image_range_normalizer()
    return normalizer


if __name__ == "__main__":
    print(json.dumps({"checkpoint": str(save(Path(sys.argv[1]).resolve(), *sys.argv[2:3]))}))
