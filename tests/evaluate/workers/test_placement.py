from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from in_process_evaluation import flat_config

from vlagents_ray.client.credentials import KEY_VARIABLE, Credentials
from vlagents_ray.envs.graphics import GPUS
from vlagents_ray.evaluate.plan.cases import EvalCase, cells
from vlagents_ray.evaluate.workers.cluster import Placement, fewest, runtime_env, strategy
from vlagents_ray.evaluate.workers.rollout import Rollout


def filled(replicas: dict[str, int], workers: int) -> Counter[str | None]:
    """Where so many workers go, one after the other."""
    there: Counter[str | None] = Counter()
    for _ in range(workers):
        there[fewest(replicas, there)] += 1
    return there


def test_a_node_gets_as_many_workers_as_it_has_replicas_to_serve_them() -> None:
    assert filled({"a": 1, "b": 1}, 6) == {"a": 3, "b": 3}
    assert filled({"a": 3, "b": 1}, 8) == {"a": 6, "b": 2}


def test_workers_that_are_there_already_count_wherever_they_were_wanted() -> None:
    assert fewest({"a": 1, "b": 1}, {"a": 2, "c": 5}) == "b"


@pytest.mark.parametrize("url", [None, "http://gpu-box:8000/pi0", "ws://gpu-box:8000"])
def test_a_policy_outside_the_cluster_draws_workers_nowhere(url: str | None) -> None:
    assert Placement().node(url, {}) is None
    assert strategy(None) == "SPREAD"


def test_a_worker_is_never_bound_to_a_node_that_is_full_or_gone() -> None:
    wanted = strategy("ab" * 28)
    assert (wanted.soft, wanted._spill_on_unavailable) == (True, True)


def cell(url: str | None = "http://box", **worker: Any) -> EvalCase:
    [found] = cells(flat_config(envs=["tabletop/reach"], out="out", policy_url=url, **worker))
    return found


def test_gpus_are_hidden_from_workers_that_are_given_none() -> None:
    assert runtime_env(cell())["env_vars"][GPUS] == ""


def test_gpus_are_not_hidden_from_their_owner_nor_where_the_user_says_otherwise_nor_from_a_policy_in_the_worker() -> (
    None
):
    assert GPUS not in runtime_env(cell(gpus_per_worker=0.25))["env_vars"]
    assert runtime_env(cell(runtime_env={"env_vars": {GPUS: "1"}}))["env_vars"][GPUS] == "1"
    assert GPUS not in runtime_env(cell(url=None))["env_vars"]


def test_the_key_of_a_server_is_in_no_runtime_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray logs those, where every user can read them. It comes with a worker's first call."""
    monkeypatch.setenv(KEY_VARIABLE, "vlr_x")
    assert "vlr_x" not in str(runtime_env(cell()))
    credentials = Credentials()
    assert "vlr_x" not in repr(credentials)
    monkeypatch.delenv(KEY_VARIABLE)
    Rollout(flat_config(envs=["tabletop/reach"], out="out"), lambda _: pytest.fail("made")).ready(credentials)
    assert Credentials().api_key == "vlr_x"
