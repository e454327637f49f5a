"""A small random Octo, made and saved by Octo's own code: `python tiny.py OUT_FOLDER [KIND]`.

KIND is `pretrained` (two cameras, statistics of two datasets, as octo-base) or `finetuned` (one
camera and the proprioception, statistics of its own).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray_models.octo import octo_model_class

WORDS = ["pick", "up", "the", "cube", "push", "open", "drawer", "red", "blue", "warm"]
TOKENS, EMBEDDING, WINDOW, HORIZON, STATE = 8, 32, 2, 4, 3
ACTION = {
    "mean": [0.01, -0.02, 0.03, 0.0, 0.05, -0.05, 0.0],
    "std": [0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 1.0],
    "mask": [True] * 6 + [False],
}


def save(folder: Path, kind: str = "pretrained", head: str = "DiffusionActionHead") -> Path:
    """Write the checkpoint of step 7, with the language encoder's configuration and tokenizer
    next to it.
    """
    model_class = octo_model_class(None)
    from octo.data.utils.text_processing import HFTokenizer
    from octo.utils.spec import ModuleSpec

    encoder = str(_language(folder.parent / f"{folder.name}-t5"))
    tokenizer = {
        "max_length": TOKENS,
        "padding": "max_length",
        "truncation": True,
        "return_tensors": "np",
    }
    text = ModuleSpec.create(HFTokenizer, tokenizer_name=encoder, tokenizer_kwargs=tokenizer)
    finetuned = kind == "finetuned"
    config = {"model": _model(encoder, head, finetuned), "text_processor": text}
    model = model_class.from_config(
        config,
        _example(finetuned),
        text_processor=ModuleSpec.instantiate(text)(),
        dataset_statistics=_statistics(finetuned),
    )
    model.save_pretrained(7, checkpoint_path=str(folder))
    return folder


def _language(folder: Path) -> Path:
    """Write configuration and tokenizer of a T5 of 32 dimensions, whose weights are the policy's
    own.
    """
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, T5Config

    special = {"pad_token": "<pad>", "eos_token": "</s>", "unk_token": "<unk>"}
    vocabulary = {word: i for i, word in enumerate([*special.values(), *WORDS])}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token=special["unk_token"]))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=words,
        **special,
        model_input_names=["input_ids", "attention_mask"],
    )
    tokenizer.save_pretrained(folder)
    sizes = {"vocab_size": len(vocabulary), "d_model": EMBEDDING, "d_kv": 8, "d_ff": 64}
    T5Config(**sizes, num_layers=1, num_heads=2).save_pretrained(folder)
    return folder


def _model(encoder: str, head: str, finetuned: bool) -> dict[str, Any]:
    from octo.model.components import action_heads
    from octo.model.components.tokenizers import (
        ImageTokenizer,
        LanguageTokenizer,
        LowdimObsTokenizer,
    )
    from octo.model.components.vit_encoders import SmallStem32
    from octo.utils.spec import ModuleSpec

    stem = ModuleSpec.create(SmallStem32, features=(32, 32, 32, 32), num_features=EMBEDDING)
    observations = {}
    for camera in ["primary"] if finetuned else ["primary", "wrist"]:
        observations[camera] = ModuleSpec.create(
            ImageTokenizer,
            obs_stack_keys=[f"image_{camera}"],
            task_stack_keys=[f"image_{camera}"],
            encoder=stem,
        )
    if finetuned:
        observations["proprio"] = ModuleSpec.create(LowdimObsTokenizer, obs_keys=["proprio"])
    discrete = (
        {"token_per": "action_horizon", "use_map": True} if head == "DiscreteActionHead" else {}
    )
    return {
        "observation_tokenizers": observations,
        "task_tokenizers": {"language": ModuleSpec.create(LanguageTokenizer, encoder=encoder)},
        "heads": {
            "action": ModuleSpec.create(
                getattr(action_heads, head),
                readout_key="readout_action",
                action_horizon=HORIZON,
                action_dim=len(ACTION["mean"]),
                **discrete,
            )
        },
        "readouts": {"action": 1},
        "token_embedding_size": EMBEDDING,
        "transformer_kwargs": {
            "num_layers": 1,
            "mlp_dim": 64,
            "num_attention_heads": 2,
            "dropout_rate": 0.0,
            "attention_dropout_rate": 0.0,
            "add_position_embedding": False,
        },
        "max_horizon": 4,
        "repeat_task_tokens": True,
        "use_correct_attention": True,
    }


def _example(finetuned: bool) -> dict[str, Any]:
    """Return a batch as the data loader of training does, with the shapes of the model's inputs."""
    images = {"image_primary": 64} if finetuned else {"image_primary": 64, "image_wrist": 32}
    observation: dict[str, Any] = {
        name: np.zeros((1, WINDOW, side, side, 3), np.uint8) for name, side in images.items()
    }
    if finetuned:
        observation["proprio"] = np.zeros((1, WINDOW, STATE), np.float32)
    observation["timestep"] = np.zeros((1, WINDOW), np.int32)
    observation["timestep_pad_mask"] = np.ones((1, WINDOW), bool)
    observation["pad_mask_dict"] = {name: np.ones((1, WINDOW), bool) for name in images}
    task: dict[str, Any] = {
        name: np.zeros((1, side, side, 3), np.uint8) for name, side in images.items()
    }
    task["language_instruction"] = {
        name: np.ones((1, TOKENS), np.int64) for name in ("input_ids", "attention_mask")
    }
    task["pad_mask_dict"] = {name: np.ones(1, bool) for name in (*images, "language_instruction")}
    return {
        "observation": observation,
        "task": task,
        "action": np.zeros((1, WINDOW, HORIZON, 7), np.float32),
    }


def _statistics(finetuned: bool) -> dict[str, Any]:
    action = {name: np.array(values) for name, values in ACTION.items()}
    if finetuned:
        return {
            "action": action,
            "proprio": {"mean": np.arange(STATE) * 1.0, "std": np.full(STATE, 2.0)},
        }
    return {
        "bridge_dataset": {"action": action},
        "fractal20220817_data": {"action": action | {"mean": np.ones(7)}},
    }


if __name__ == "__main__":
    print(json.dumps({"checkpoint": str(save(Path(sys.argv[1]).resolve(), *sys.argv[2:3]))}))
