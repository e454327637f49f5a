"""RLinf's rollout worker as a client of this server: `SGLangEmbodiedWorker` sends the observations
of its environments to `/v1/actions/generations`, as this adapter writes them.

RLinf's own adapter, for DreamZero, sends observations that are normalised for that model; this
adapter sends the observations of the environments unchanged. RLinf loads this module in each of its
processes if `RLINF_EXT_MODULE` is `vlagents_ray_dialects.rlinf`. The module was written for RLinf's
commit a3816b59 (`rlinf/workers/rollout/sglang/sglang_embodied_worker.py`).
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np

MODEL_TYPE = "vlagents_ray"  # `rollout.model.model_type` in RLinf's configuration

# Observations of RLinf's environments, with one row for each parallel environment; each kind of
# environment has some of these names (rlinf/envs/*).
_OBSERVED = ("main_images", "wrist_images", "extra_view_images", "states")


class PolicyServerAdapter:
    """Converts the observations of RLinf's environments to a request, and the answer to actions.

    Each of the parallel environments is a session. The names of the sessions differ from run to
    run, so that a run does not continue the sessions of an earlier run.

    Args:
        cfg: RLinf's configuration; `rollout.model.num_action_chunks` is the number of rows that are
            executed of each chunk.
        rank: The rank of the rollout worker.
    """

    action_path = "/v1/actions/generations"

    def __init__(self, cfg: Any, rank: int) -> None:
        self._rows = int(cfg.rollout.model.num_action_chunks)
        self._sessions = f"rlinf-{uuid.uuid4().hex[:12]}-rank{rank}"

    def build_request(
        self, env_obs: Mapping[str, Any], mode: str = "eval"
    ) -> tuple[dict[str, Any], None]:
        """Return the request for the observations of B environments, and None as the state.

        Args:
            env_obs: `main_images`, (B, H, W, 3) uint8, `states`, (B, D), and other observations of
                the same length; `task_descriptions`, a list of texts; and the worker's own keys.
            mode: RLinf's mode; the worker evaluates only.

        Raises:
            NotImplementedError: The mode is not "eval".
        """
        if mode != "eval":
            raise NotImplementedError(f"mode: expected 'eval', got {mode!r}")

        observation = {}
        for name in _OBSERVED:
            if env_obs.get(name) is not None:
                observation[name] = np.asarray(env_obs[name])
        prompts = [str(text) for text in env_obs["task_descriptions"]]
        stage = int(env_obs.get("_rlinf_stage_id", 0))
        slots = range(len(prompts))
        begins = bool(env_obs.get("_rlinf_reset", False))
        request = {
            "input": {"prompt": prompts, "observation": observation},
            "parameters": {
                "session_ids": [f"{self._sessions}-stage{stage}-slot{slot}" for slot in slots],
                "reset_mask": [begins for _ in slots],
                "action_horizon": self._rows,
            },
            "runtime": {"response_format": "envelope", "output_format": "numpy"},
        }
        return request, None

    def parse_response(
        self, response: Mapping[str, Any], _state: None
    ) -> tuple[Any, dict[str, Any]]:
        """Return the actions of an answer, a tensor (B, rows, D) float32, and an empty dict of
        further values.

        Args:
            response: The answer, SGLang's envelope.
        """
        import torch

        values = response["data"][0]["action"]["values"]
        return torch.as_tensor(np.array(values, np.float32)), {}


def register() -> None:
    """Register the model type `vlagents_ray` with this adapter; RLinf calls this."""
    from rlinf.config import EMBODIED_MODEL, SupportedModel
    from rlinf.models.embodiment.sglang_adapter import register_sglang_adapter

    EMBODIED_MODEL.add(SupportedModel.register(MODEL_TYPE, force=True))
    register_sglang_adapter(MODEL_TYPE, lambda: PolicyServerAdapter, force=True)
