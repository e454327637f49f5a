"""Ray writes runtime environments to files that every user of the machine can read, so they must
not contain secrets.
"""

from __future__ import annotations

from typing import Any

import pytest
from in_process_evaluation import flat_config
from pydantic import ValidationError

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.runtime_env import require_no_secrets
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import deployment, together


@pytest.mark.parametrize(
    "name",
    [
        "VLAGENTS_RAY_API_KEY",
        "HF_TOKEN",
        "WANDB_API_KEY",
        "AWS_SECRET_ACCESS_KEY",
        "DB_PASSWORD",
        "my_secret",
        "APIKEY",
    ],
)
def test_variables_that_are_named_like_secrets_are_refused_with_the_cure(name: str) -> None:
    with pytest.raises(
        ConfigError, match=f"'{name}'.*in the environment in which Ray is started"
    ) as refused:
        require_no_secrets({"env_vars": {name: "hush"}})
    assert "hush" not in str(refused.value)


@pytest.mark.parametrize(
    "name",
    [
        "TOKENIZERS_PARALLELISM",
        "HF_TOKEN_PATH",
        "MAX_TOKENS",
        "MONKEY",
        "PYTHONPATH",
        "CUDA_VISIBLE_DEVICES",
    ],
)
def test_others_are_not(name: str) -> None:
    require_no_secrets(
        {
            "env_vars": {name: "x"},
            "pip": ["a @ https://x/a.whl", "--index-url https://u:${TOKEN}@x"],
        }
    )


@pytest.mark.parametrize(
    "runtime_env",
    [
        {"working_dir": "https://u:hush@x/a.zip"},
        {"pip": {"packages": ["--index-url=https://u:hush@x"]}},
    ],
)
def test_a_password_in_a_url_is_refused_wherever_it_stands(runtime_env: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="netrc") as refused:
        require_no_secrets(runtime_env)
    assert "hush" not in str(refused.value)


def test_evaluations_and_deployments_are_looked_through() -> None:
    secret = {"env_vars": {"HF_TOKEN": "hush"}}
    with pytest.raises(ValidationError, match="HF_TOKEN") as refused:
        flat_config(envs=["tabletop/reach"], out="out", runtime_env=secret)
    assert "hush" not in str(refused.value)
    with pytest.raises(ValidationError, match="HF_TOKEN") as refused:
        ServerArgs(policy="noop", environment={"python": "/p", "process": "child", **secret})
    assert "hush" not in str(refused.value)
    with pytest.raises(ConfigError, match="HF_TOKEN"):
        deployment("noop", environment=secret)
    for where in (
        {"runtime_env": secret},
        {"deployments": [{"name": "P", "ray_actor_options": {"runtime_env": secret}}]},
    ):
        part = deployment("noop").model_copy(deep=True)
        app = part.applications[0].model_copy(update={})
        document = {"applications": [app.model_dump(exclude_unset=True) | where]}
        with pytest.raises(ConfigError, match="HF_TOKEN"):
            together({"noop": type(part).model_validate(document)})
