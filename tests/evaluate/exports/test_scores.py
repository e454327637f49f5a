"""Scores for a model's repository and for a leaderboard: what they say is what the table says, or why they do not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from eval_fakes import LINE
from pydantic import ValidationError
from recorded_results import record, runs

from vlagents_ray.envs.libero import SUITES, LiberoProtocol
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.exports import to_hub, to_vla_eval
from vlagents_ray.evaluate.exports.scores import benchmark_of, scores
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.statistics import wilson
from vlagents_ray.evaluate.results.store import Store

VERSIONS = {"vlagents-ray": "0.1.0", "code": {"folder": None, "vlagents_ray": {"commit": "c" * 40}}}
ASKED = {"curated_by": "@somebody", "weight_type": "finetuned"}
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


def test_a_model_card_has_the_rates_with_their_facts(libero: Callable[..., Results], tmp_path: Path) -> None:
    to_hub(libero(["libero/libero_goal/3"], max_steps=7), tmp_path / "hub", dataset="somebody/libero", task_id="goal")
    [_, head, body] = (tmp_path / "hub/README.md").read_text().split("---\n")
    [model] = yaml.safe_load(head)["model-index"]
    [result] = model["results"]
    assert (model["name"], result["dataset"]["type"], result["dataset"]["config"]) == (
        "pi0-libero",
        "somebody/libero",
        "goal",
    )
    once, at_end = result["metrics"]
    assert (once["type"], once["value"], at_end["type"]) == ("success_once", 50.0, "success_at_end")
    facts = once["args"]
    assert (facts["episodes"], facts["successes"], facts["weights"]) == (2, 1, ["sha256:77"])
    assert facts["deviations"] == ["max_steps: 7, the protocol says 300"]
    assert facts["code"] == [{"vlagents-ray": "0.1.0", "commit": "c" * 40}]
    assert "| `libero/libero_goal` | 50 % | 2 |" in body


def test_a_whole_libero_has_the_overall_score_of_the_leaderboard(
    libero: Callable[..., Results], tmp_path: Path
) -> None:
    assert to_vla_eval(libero(), tmp_path / "entries.json", **ASKED) == 80
    document = json.loads((tmp_path / "entries.json").read_text())
    [entry] = document["results"]
    assert (entry["model"], entry["benchmark"], entry["overall_score"]) == ("pi0_libero", "libero", 50.0)
    assert entry["suite_scores"] == dict.fromkeys(FOUR, 50.0)
    assert document["last_updated"] == entry["date_added"] == "2027-01-15"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"max_steps": 7}, "max_steps: 7, the protocol says"),
        ({"lost": "libero/libero_goal/3"}, "libero/libero_goal/3: 2 of 2 planned episodes have no result"),
        ({"envs": [f"libero/{name}/*" for name in FOUR[:3]]}, None),
        ({"envs": ["libero/libero_goal/3"]}, None),
    ],
)
def test_what_is_not_the_standard_protocol_has_no_overall_score(
    libero: Callable[..., Results], tmp_path: Path, changes: dict[str, Any], why: str | None
) -> None:
    to_vla_eval(libero(**changes), tmp_path / "entries.json", **ASKED)
    [entry] = json.loads((tmp_path / "entries.json").read_text())["results"]
    assert entry["overall_score"] is None
    assert why is None or why in entry["notes"]
    assert entry["suite_scores"] or entry["task_scores"] == {"libero_goal/3": 50.0}


def test_a_suite_lacking_a_task_is_given_by_its_tasks(libero: Callable[..., Results], tmp_path: Path) -> None:
    to_vla_eval(libero(lost="libero/libero_goal/3"), tmp_path / "entries.json", **ASKED)
    [entry] = json.loads((tmp_path / "entries.json").read_text())["results"]
    assert set(entry["suite_scores"]) == set(FOUR) - {"libero_goal"}
    assert len(entry["task_scores"]) == SUITES["libero_goal"].tasks - 1


PRO = [
    f"libero_{suite}_{kind}"
    for suite in ("spatial", "object", "goal", "10")
    for kind in ("swap", "lan", "task", "object")
]


def of_suites(*suites: str) -> list[str]:
    return [f"libero/{suite}/{number}" for suite in suites for number in range(10)]


@pytest.mark.slow
def test_libero_pro_has_its_scores_by_suite_and_kind_with_libero_as_the_original(
    libero: Callable[..., Results], tmp_path: Path
) -> None:
    assert to_vla_eval(libero(of_suites(*FOUR, *PRO)), tmp_path / "entries.json", **ASKED) == 400
    plain, pro = json.loads((tmp_path / "entries.json").read_text())["results"]
    assert (plain["benchmark"], plain["overall_score"], pro["benchmark"]) == ("libero", 50.0, "libero_pro")
    kinds = ("ori", "pos", "sem", "task", "obj")
    assert set(pro["suite_scores"]) == {f"{a}_{b}" for a in ("spatial", "object", "goal", "long") for b in kinds}
    assert (pro["overall_score"], pro["task_scores"]) == (50.0, {})


def test_libero_pro_without_libero_or_a_kind_has_no_overall_score(
    libero: Callable[..., Results], tmp_path: Path
) -> None:
    to_vla_eval(libero(of_suites("libero_goal_swap", "libero_10_env")), tmp_path / "entries.json", **ASKED)
    [pro] = json.loads((tmp_path / "entries.json").read_text())["results"]
    assert (pro["overall_score"], pro["suite_scores"]) == (None, {"goal_pos": 50.0, "long_env": 50.0})


@pytest.mark.parametrize(
    ("envs", "said"),
    [
        (of_suites("libero_goal_swap")[1:], "libero/libero_goal_swap: got results of 9 tasks, want all ten"),
        (["libero/libero_goal/open_the_drawer_language_7"], "varies a task of libero_goal"),
        (of_suites("libero_goal_temp"), "has no such benchmark, want LIBERO, LIBERO-PRO or SIMPLER"),
    ],
    ids=["part of a suite", "LIBERO-Plus", "another suite"],
)
def test_variants_of_libero_that_the_leaderboard_has_no_score_for_are_refused(
    libero: Callable[..., Results], tmp_path: Path, envs: list[str], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        to_vla_eval(libero(envs), tmp_path / "entries.json", **ASKED)


def test_a_benchmark_that_the_leaderboard_lacks_and_several_policies_are_refused(tmp_path: Path) -> None:
    results = record(runs(tmp_path / "run", episodes=2, steps=[]))
    with pytest.raises(ConfigError, match=r"got the policies \['learner', 'base'\], want one: name it with --policy"):
        to_hub(results, tmp_path / "hub", dataset="a/b")
    with pytest.raises(ConfigError, match="vla-eval's leaderboard has no such benchmark, want"):
        to_vla_eval(results.only("base"), tmp_path / "entries.json", **ASKED)
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
