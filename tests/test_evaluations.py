"""The run files in the package are valid, and the page about them lists all keys."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from vlagents_ray.cli.evaluate import read_run
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.plan.cases import expand
from vlagents_ray.registry import env_suite, names
from vlagents_ray.serve.launch.deployment_file import read_deployment

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "examples" / "evaluations").glob("*.yaml"))
CAMERAS = {"libero": {"front", "wrist"}, "simpler": {"3rd_view_camera"}, "tabletop": {"front"}}
# Models that do not need to know which camera is which.
WITHOUT_WORDS = {
    "openpi": {"image": "front", "wrist_image": "wrist"},
    "openvla": {"image": "front"},
    "lerobot": {},
    "reference": {"front": "front", "wrist": "wrist"},
}


@pytest.mark.parametrize(
    "file", [*FILES, ROOT / "examples" / "raptor" / "flights.yaml"], ids=lambda file: file.stem
)
def test_an_example_is_accepted(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    config = EvalConfig.model_validate(read_run(file))
    for suite in config.suites:
        for env in suite.envs:
            if env_suite(env) in names("envs"):
                assert expand(env)
    for policy in config.policies:
        assert policy.source is not None
        if policy.source.endswith(".yaml"):
            assert Path(policy.source).is_file()
        else:
            read_deployment(policy.source, {"config": policy.config} if policy.config else None)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_model_of_an_example_looks_through_cameras_that_its_envs_have(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    config = EvalConfig.model_validate(read_run(file))
    have = [
        set(suite.env_options.get("cameras") or CAMERAS[env.partition("/")[0]])
        for suite in config.suites
        for env in suite.envs
    ]
    for policy in config.policies:
        if policy.source is None or not policy.source.endswith(".yaml"):
            continue
        [application] = yaml.safe_load((ROOT / policy.source).read_text())["applications"]
        served = application["args"]["policy"]
        assert served != "noop"
        needs = (
            {**application["args"]["config"], **policy.config}.get("cameras")
            or WITHOUT_WORDS[served]
        ).values()
        assert all(set(needs) <= cameras for cameras in have)


def test_there_are_examples() -> None:
    assert {file.stem for file in FILES} >= {"tabletop", "libero", "simpler", "sweep", "realtime"}
