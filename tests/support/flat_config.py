"""An evaluation of one policy in one suite, from settings side by side."""

from __future__ import annotations

from typing import Any

from vlagents_ray.evaluate import EvalConfig

_POLICY = {
    "policy": "name", "policy_url": "url", "policy_config": "config", "policy_options": "options",
    "checkpoint": "checkpoint", "steps": "steps", "execute": "execute", "codec": "codec", "transport": "transport",
}  # fmt: skip
_SUITE = {name: name for name in ("envs", "env_options", "reset_options", "episodes", "seeds", "num_envs")}
_WORKER = {"cpus_per_worker": "cpus", "gpus_per_worker": "gpus", "threads": "threads", "runtime_env": "runtime_env"}


def flat_config(**settings: Any) -> EvalConfig:
    """`seed` is the only seed."""
    if "seed" in settings:
        settings = settings | {"seeds": [settings["seed"]]}
        del settings["seed"]
    policy, suite, worker = ({one[k]: v for k, v in settings.items() if k in one} for one in (_POLICY, _SUITE, _WORKER))
    rest = {k: v for k, v in settings.items() if k not in _POLICY | _SUITE | _WORKER}
    return EvalConfig.model_validate({"policies": [policy], "suites": [suite], "worker": worker, **rest})
