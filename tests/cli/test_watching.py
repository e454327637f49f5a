"""Errors in a file for `--watch` are reported before any checkpoint is searched for."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from eval_fakes import LINE

from vlagents_ray.cli import evaluation as run
from vlagents_ray.cli.evaluation import _trained_policy, watch_training
from vlagents_ray.cli.policies import Served, resolve_policies
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Progress, Results, Summary
from vlagents_ray.evaluate.episode.records import EpisodeResult, Status
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.registry import names, policy_class
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, own_settings, read_deployment

SOURCE = "served_agents:Stored"
SWEPT = {"name": "swept", "source": SOURCE, "config": {"checkpoint": "/runs/{step}"}}
FIXED = {"name": "fixed", "source": SOURCE, "config": {"checkpoint": "/runs/9"}}
AT_URL = {"name": "remote", "url": "http://127.0.0.1:9", "checkpoint": "/runs/{step}"}


@pytest.mark.parametrize(
    ("policies", "file", "text"),
    [
        (
            [FIXED, AT_URL],
            None,
            r"in the checkpoint of one policy that this command serves, .*, got 0 such policies",
        ),
        (
            [SWEPT, SWEPT | {"name": "other"}],
            None,
            r"in the checkpoint of one policy that this command serves, .*, got 2 such policies",
        ),
        ([SWEPT | {"steps": [10]}], None, "expected no `steps` with --watch"),
        ([SWEPT], "runs/training_finished", "ended without a checkpoint"),
        ([SWEPT], "results.db", "resume them"),
    ],
)
def test_what_cannot_be_watched_is_refused_at_once(
    policies: list[dict[str, Any]], file: str | None, text: str, tmp_path: Path
) -> None:
    (tmp_path / "runs").mkdir()
    if file is not None:
        (tmp_path / file).touch()
    config = EvalConfig.model_validate(
        {"policies": policies, "suites": [{"envs": ["tabletop"]}], "out": tmp_path}
    )
    with pytest.raises(ConfigError, match=text):
        watch_training(config, tmp_path / "runs")


def test_an_episode_lost_in_any_round_ends_watching_with_status_1_and_no_round_early(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = EvalConfig.model_validate(
        {"policies": [SWEPT], "suites": [{"envs": [LINE]}], "out": tmp_path / "o"}
    )
    played: list[list[int]] = []

    def play(running: Served, _progress: Progress) -> Summary:
        resolved = running.plan
        played.append(resolved.policies[0].steps)
        with Store(resolved) as store:
            store.begin_run({})
            for job in plan_jobs(store.cases):
                status: Status = (
                    "infra_failed" if job.case.step == 10 and job.key.episode == 3 else "done"
                )
                store.record(EpisodeResult(job.key, status, status == "done"), 1)
            store.end_run("complete")
        return summarize(Results.load(resolved.out))

    monkeypatch.setattr(run, "evaluate_and_print", play)
    monkeypatch.setattr(run, "rounds", lambda *_: iter([[10], [20, 30]]))
    monkeypatch.setattr(
        run, "served", lambda config, *_: contextlib.nullcontext(Served(resolve(config)))
    )
    with pytest.raises(typer.Exit) as ended:
        watch_training(config.model_copy(update={"workers": 0}), tmp_path)
    assert played == [[10], [20, 30]]
    assert ended.value.exit_code == 1


FAMILIES = sorted(
    name
    for name in names("policies")
    if issubclass(getattr(policy_class(name), "Config", None) or object, ModelConfig)
)


def needed(family: str) -> dict[str, Any]:
    """Return a value for each setting without a default, except the checkpoint. All of these
    settings are texts.
    """
    fields = policy_class(family).Config.model_fields.items()
    return {name: "any" for name, field in fields if field.is_required() and name != "checkpoint"}


def swept(family: str, tmp_path: Path, place: str, **settings: Any) -> EvalConfig:
    """Return a sweep over one policy, whose settings are in the evaluation's file or in the
    deployment file.
    """
    own = {"checkpoint": "/runs/{step}/pretrained_model", **needed(family), **settings}
    policy: dict[str, Any] = {"name": "swept", "source": family, "config": own}
    if place == "deployment":
        file = tmp_path / "policy.yaml"
        args = {"policy": family, "config": own}
        file.write_text(
            yaml.safe_dump(
                {"applications": [{"name": "a", "import_path": IMPORT_PATH, "args": args}]}
            )
        )
        policy = {"name": "swept", "source": str(file)}
    return EvalConfig.model_validate(
        {"policies": [policy], "suites": [{"envs": ["tabletop"]}], "out": tmp_path / "out"}
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_a_step_is_not_missed_before_the_first_checkpoint_is_there_and_its_first_is_the_deployments_own(
    family: str, tmp_path: Path
) -> None:
    config = swept(family, tmp_path, "evaluation")
    assert _trained_policy(config) == (0, "/runs/{step}/pretrained_model")
    policies = [config.policies[0].model_copy(update={"steps": [30, 60]})]
    _, parts = resolve_policies(config.model_copy(update={"policies": policies}))
    assert own_settings(parts["swept"].applications[0])["checkpoint_step"] == 30


@pytest.mark.parametrize("address", ["url", "source"])
def test_steps_of_a_running_server_are_refused_with_the_cure(address: str, tmp_path: Path) -> None:
    policy = {"name": "remote", address: "http://127.0.0.1:9", "steps": [10, 20]}
    config = EvalConfig.model_validate(
        {"policies": [policy], "suites": [{"envs": ["tabletop"]}], "out": tmp_path}
    )
    with pytest.raises(ConfigError, match=r"which has one checkpoint, .* give its `source`"):
        resolve_policies(config)


@pytest.mark.parametrize("place", ["evaluation", "deployment"])
def test_of_the_settings_only_a_step_that_is_swept_may_be_missing(
    place: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="chekpoint_dir"):
        _trained_policy(swept("pi0", tmp_path, place, chekpoint_dir="/runs"))
    with pytest.raises(ConfigError, match="max_rows"):
        _trained_policy(swept("pi0", tmp_path, place, max_rows=0))
    config = swept("pi0", tmp_path, place)
    assert _trained_policy(config) == (0, "/runs/{step}/pretrained_model")
    with pytest.raises(ConfigError, match="checkpoint_step None: expected either both"):
        resolve_policies(config)
    if place == "deployment":
        with pytest.raises(ConfigError, match="checkpoint_step None: expected either both"):
            read_deployment(str(config.policies[0].source))


def test_the_families_with_checkpoints_are_found() -> None:
    assert {"lerobot", "openpi", "openvla", "pi0", "octo", "diffusion_policy"} <= set(FAMILIES)
