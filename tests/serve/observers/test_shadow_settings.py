"""`shadow:` in a deployment file: what is taken, what is refused, and what Serve gets of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from ray.serve.exceptions import RayServeException

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.app import build
from vlagents_ray.serve.config.deployment import SHADOW, ServerArgs, candidate_of
from vlagents_ray.serve.launch.deployment_file import (
    deployment,
    gpus_of_candidate,
    read_deployment,
    with_candidate,
    with_replicas_on,
)
from vlagents_ray.serve.launch.server import _gpus


def written(folder: Path, name: str, **args: Any) -> str:
    """The path of a deployment file of one application."""
    app = {"name": "noop", "route_prefix": "/", "import_path": "vlagents_ray.serve.app:build", "args": args}
    path = folder / name
    path.write_text(yaml.safe_dump({"applications": [app]}))
    return str(path)


@pytest.fixture
def candidate(tmp_path: Path) -> str:
    return written(
        tmp_path, "candidate.yaml", policy="noop", config={"chunk": 4}, replicas=3, resources={"num_gpus": 0.5}
    )


def args_of(config: Any) -> ServerArgs:
    return ServerArgs(**config.applications[0].args)


def test_the_candidate_is_read_from_its_file(tmp_path: Path, candidate: str) -> None:
    live = written(tmp_path, "live.yaml", policy="noop", shadow={"policy": candidate, "share": 0.5})
    args = args_of(read_deployment(live))
    assert args.shadow is not None
    assert args.shadow.share == 0.5
    assert candidate_of(args.shadow).config == {"chunk": 4}


@pytest.mark.parametrize("policy", ["noop", {"policy": "noop", "config": {"chunk": 2}}])
def test_the_candidate_may_be_a_name_or_settings(policy: str | dict[str, Any]) -> None:
    shadow = args_of(deployment("noop", shadow={"policy": policy})).shadow
    assert shadow is not None
    assert shadow.share == 0.1
    assert candidate_of(shadow).policy == "noop"


def test_the_candidate_is_a_deployment_of_one_replica_behind_the_policy(candidate: str) -> None:
    built = build({"policy": "noop", "replicas": 2, "shadow": {"policy": candidate, "record": "seen", "record_mb": 5}})
    policy = built._bound_deployment
    shadow = policy.init_kwargs["candidate"]._bound_deployment
    assert shadow.name == SHADOW
    assert shadow.num_replicas == 1
    assert shadow.ray_actor_options["num_gpus"] == 0.5
    settings, record, record_mb = shadow.init_args
    assert settings["config"] == {"chunk": 4}
    assert (record, record_mb) == (str(Path("seen").absolute()), 5)
    assert policy.init_args[0]["shadow"]["policy"] == "noop", "the live policy does not restart for its settings"
    assert build({"policy": "noop"})._bound_deployment.init_kwargs == {}


def test_the_candidates_gpus_are_counted(candidate: str) -> None:
    own = {"resources": {"num_gpus": 1}}
    config = deployment("noop", shadow={"policy": candidate}, **own)
    assert gpus_of_candidate(args_of(config)) == 0.5
    assert _gpus(args_of(config)) == 1.5
    assert with_replicas_on(config, 4).applications[0].args["replicas"] == 3
    assert with_replicas_on(deployment("noop", **own), 4).applications[0].args["replicas"] == 4


@pytest.mark.parametrize(
    ("shadow", "message"),
    [
        ({}, "policy"),
        ({"policy": "noop", "share": 0}, "share"),
        ({"policy": "noop", "share": 1.5}, "share"),
        ({"policy": "noop", "queue": 0}, "queue"),
        ({"policy": "noop", "fraction": 0.1}, "fraction"),
        ({"policy": "missing.yaml"}, "'missing.yaml' does not exist"),
        ({"policy": "no_such_policy"}, "no_such_policy"),
        ({"policy": {"policy": "noop", "colour": "red"}}, r"shadow.policy: .*colour"),
        ({"policy": {"policy": "noop", "shadow": {"policy": "noop"}}}, "the candidate has a shadow itself"),
        ({"policy": {"policy": "noop", "config": {"action_dim": 9}}}, "the policy gives 9, the env takes 7"),
        ({"policy": {"policy": "noop", "config": {"rows": 9}}}, "rows"),
    ],
)
def test_a_wrong_setting_is_refused_before_anything_starts(shadow: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        deployment("noop", shadow=shadow)


def test_a_file_is_not_its_own_candidate(tmp_path: Path) -> None:
    path = str(tmp_path / "live.yaml")
    written(tmp_path, "live.yaml", policy="noop", shadow={"policy": path})
    with pytest.raises(ConfigError, match="has a shadow itself; a candidate has none"):
        read_deployment(path)


def test_a_file_of_several_policies_is_no_candidate(tmp_path: Path) -> None:
    path = Path(written(tmp_path, "two.yaml", policy="noop"))
    document = yaml.safe_load(path.read_text())
    document["applications"].append(document["applications"][0] | {"name": "other", "route_prefix": "/other"})
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(ConfigError, match="holds the policies"):
        with_candidate(ServerArgs(policy="noop", shadow={"policy": str(path)}).shadow)  # type: ignore[arg-type]


def test_serve_shows_what_is_wrong_with_a_candidate() -> None:
    with pytest.raises(RayServeException, match=r"ConfigError: deployment file 'missing\.yaml' does not exist"):
        build({"policy": "noop", "shadow": {"policy": "missing.yaml"}})
