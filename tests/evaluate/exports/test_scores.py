"""Scores for a model's repository: what they say is what the table says, or why they do not."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest
import yaml
from eval_fakes import LINE
from pydantic import ValidationError
from recorded_results import record, runs

from vlagents_ray.envs import gymnasium, maniskill
from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.exports import to_hub
from vlagents_ray.evaluate.exports.scores import benchmark_of, scores
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.statistics import wilson
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray_sims import aloha, calvin, metaworld, simpler
from vlagents_ray_sims.libero import LiberoProtocol

VERSIONS = {"vlagents-ray": "0.1.0", "code": {"folder": None, "vlagents_ray": {"commit": "c" * 40}}}
FOUR = ("libero_spatial", "libero_object", "libero_goal", "libero_10")


@pytest.fixture
def libero(tmp_path: Path) -> Callable[..., Results]:
    """Two episodes of each task of LIBERO's four suites, one of them solved, with what its env says of itself."""

    def make(envs: list[str] | None = None, lost: str = "", **protocol: Any) -> Results:
        suites = [{"envs": envs or [f"libero/{name}/*" for name in FOUR], "episodes": 2}]
        policies = [{"name": "pi0-libero", "url": "http://localhost:1"}]
        config = EvalConfig.model_validate({"policies": policies, "suites": suites, "out": tmp_path / "run"})
        with Store(config) as store:
            store.begin_run(config, VERSIONS)
            for job in plan(store.cells):
                status = "infra_failed" if job.cell.env == lost else "done"
                solved = job.key.episode == 0
                result = EpisodeResult(job.key, status, solved, solved, steps=9, checkpoint="x", weights="sha256:77")
                store.record(result, 1, finished=1.8e9)
            for cell in store.cells:
                task = cell.env.removeprefix("libero/")
                suite = task.partition("/")[0]
                stated = LiberoProtocol.of(suite, **protocol).to_json(suite)
                store.note_env(cell.place, EnvInfo({"task": task, "protocol": stated}, {}))
            store.end_run("complete")
        return Results.load(config.out)

    return make


def test_the_hub_gets_an_entry_for_each_benchmark_with_all_that_pools_it(
    libero: Callable[..., Results], tmp_path: Path
) -> None:
    assert to_hub(libero(), tmp_path / "hub", dataset="somebody/libero", source_url="https://example.org/x") == 80
    entries = yaml.safe_load((tmp_path / "hub/.eval_results/somebody_libero.yaml").read_text())
    assert [one["dataset"]["task_id"] for one in entries] == list(FOUR)
    assert {one["value"] for one in entries} == {50.0}
    assert entries[0]["date"] == "2027-01-15T08:00:00Z"
    low, high = (f"{100 * bound:.1f}" for bound in wilson(10, 20))
    for fact in (
        f"10 of 20 episodes, 95 % interval (Wilson) {low} to {high}",
        "deviations: none",
        "sha256:77",
        "c" * 40,
    ):
        assert fact in entries[0]["notes"]


# The protocol of each benchmark, as its environments describe it.
PROTOCOLS = {
    "aloha": aloha.PROTOCOL.describe(),
    "calvin": calvin.PROTOCOL.describe(),
    "gymnasium/FetchPush-v4": gymnasium.known("FetchPush-v4").protocol.describe(),
    "libero": LiberoProtocol.of("libero_10").to_json("libero_10"),
    "maniskill": maniskill.PROTOCOL,
    "metaworld": metaworld.PROTOCOL.describe(),
    "pusht": gymnasium.known("gym_pusht/PushT-v0").protocol.describe(),
    "simpler": simpler.PROTOCOL,
}


@pytest.mark.parametrize("benchmark", sorted(PROTOCOLS))
def test_the_rate_that_the_hub_gets_is_of_the_success_that_the_protocol_counts(benchmark: str, tmp_path: Path) -> None:
    """One of four episodes is solved at its end, two more were before."""
    protocol = PROTOCOLS[benchmark]
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": "p", "url": "http://localhost:1"}],
            "suites": [{"envs": [LINE], "episodes": 4}],
            "out": tmp_path / "run",
        }
    )
    with Store(config) as store:
        store.begin_run(config, VERSIONS)
        for number, job in enumerate(plan(store.cells)):
            result = EpisodeResult(job.key, "done", number < 3, number < 1, steps=9)
            store.record(result, 1, finished=1.8e9)
        for cell in store.cells:
            store.note_env(cell.place, EnvInfo({"protocol": protocol}, {}))
        store.end_run("complete")
    [score] = scores(Results.load(config.out))
    counts_the_last_state = re.search("at the end|last step|last state", str(protocol.get("success"))) is not None
    assert score.metric == protocol["metric"] == ("success_at_end" if counts_the_last_state else "success_once")
    assert score.rate.successes == (1 if counts_the_last_state else 3)


def test_a_protocol_without_its_metric_is_no_protocol() -> None:
    [metric] = [field for field in fields(BenchmarkProtocol) if field.name == "metric"]
    assert metric.default is MISSING


@pytest.mark.parametrize(
    ("changes", "noted"),
    [
        ({"envs": ["libero/libero_goal/3"], "max_steps": 7}, "deviations: max_steps: 7, the protocol says 300"),
        (
            {"envs": ["libero/libero_goal/3", "libero/libero_goal/4"], "lost": "libero/libero_goal/3"},
            "libero/libero_goal/3: 2 of 2 planned episodes have no result",
        ),
    ],
)
def test_what_deviates_from_the_protocol_or_the_plan_is_noted(
    libero: Callable[..., Results], tmp_path: Path, changes: dict[str, Any], noted: str
) -> None:
    assert to_hub(libero(**changes), tmp_path / "hub", dataset="somebody/libero", task_id="goal") == 2
    [entry] = yaml.safe_load((tmp_path / "hub/.eval_results/somebody_libero.yaml").read_text())
    assert (entry["dataset"]["task_id"], entry["value"]) == ("goal", 50.0)
    assert noted in entry["notes"]
    assert entry["notes"].endswith(f"vlagents-ray 0.1.0 at commit {'c' * 40}")


def test_several_policies_and_settings_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    results = record(runs(tmp_path / "run", episodes=2, steps=[]))
    with pytest.raises(ConfigError, match=r"got the policies \['learner', 'base'\], want one: name it with --policy"):
        to_hub(results, tmp_path / "hub", dataset="a/b")
    with pytest.raises(ConfigError, match="task_id: got 't' for the scores"):
        to_hub(results.only("base"), tmp_path / "hub", dataset="a/b", task_id="t")
    with pytest.raises(ValidationError, match="want the id of a dataset on the Hub, OWNER/NAME"):
        to_hub(results.only("base"), tmp_path / "hub", dataset="b")
    assert not (tmp_path / "hub").exists()


def test_suites_of_one_benchmark_with_other_options_are_scores_of_their_own(tmp_path: Path) -> None:
    found = scores(record(runs(tmp_path / "run", episodes=2, steps=[])).only("base"))
    assert [(one.name, len(one.cells)) for one in found if LINE in one.name] == [(f"one {LINE}", 1), (f"two {LINE}", 1)]
    to_hub(found[0].results, tmp_path / "hub", dataset="a/b")
    [file] = (tmp_path / "hub/.eval_results").iterdir()
    ids = [one["dataset"]["task_id"] for one in yaml.safe_load(file.read_text())]
    assert len(set(ids)) == 3


@pytest.mark.parametrize(
    ("env", "benchmark"),
    [
        ("tabletop", "tabletop"),
        ("maniskill/PushCube-v1", "maniskill"),
        ("libero/libero_10/3", "libero/libero_10"),
        (LINE, LINE),
    ],
)
def test_an_envs_benchmark_is_its_name_without_the_task(env: str, benchmark: str) -> None:
    assert benchmark_of(env) == benchmark
