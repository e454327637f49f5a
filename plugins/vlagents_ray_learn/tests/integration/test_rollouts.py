"""Rollouts of a served policy: the transitions of the policy itself, by each way to the server."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, wait_for
from served_agents import Stochastic

from tests.integration.conftest import serving
from vlagents_ray.errors import NotOffered
from vlagents_ray.serve.launch.server import Server
from vlagents_ray_learn import RolloutPlan, Rollouts, arrays

GROUPS: dict[str, Any] = {"groups": 4, "want": ["logprob", "value"], "seed": 10}


@pytest.fixture(scope="module")
def version(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file that names the version of the policy's weights."""
    return tmp_path_factory.mktemp("weights") / "version"


@pytest.fixture(scope="module")
def served(shared_ray: None, version: Path) -> Iterator[Server]:
    with serving("served_agents:Stochastic", config={"version": str(version)}) as server:
        yield server


@pytest.fixture
def expected(version: Path) -> Any:
    """The transitions of 8 episodes of the policy in this process, one after the other."""
    write(version, 3)
    with Rollouts(
        RolloutPlan(LINE, partial(Stochastic, str(version)), **GROUPS | {"workers": 0})
    ) as found:
        return without_key(found.collect(8))


def write(version: Path, number: int) -> None:
    """Name the version, at once: a policy that acts meanwhile reads the old number or the new
    one.
    """
    part = version.with_suffix(".part")
    part.write_text(str(number))
    part.rename(version)


def without_key(table: Any) -> Any:
    """The transitions without their keys, which depend on settings such as the number of
    environments.
    """
    return table.drop_columns(["key"]).combine_chunks()


@pytest.mark.parametrize("url", ["serve://Stochastic", "http"])
def test_transitions_are_those_of_the_policy_itself(
    served: Server, expected: Any, url: str
) -> None:
    with Rollouts(
        RolloutPlan(LINE, served.url if url == "http" else url, workers=2, num_envs=3, **GROUPS)
    ) as found:
        got = without_key(found.collect(8))
    assert got.equals(expected)
    columns = arrays(got)
    starts = columns["state.position"][columns["t"] == 0].reshape(2, 4)
    assert (starts == starts[:, :1]).all(), "a group begins in one state"
    assert len(set(starts[:, 0])) == 2
    assert len({columns["action"][columns["t"] == 0][i, 0] for i in range(8)}) == 8
    assert (columns["logprob"] < 2).all()
    assert set(columns["version"]) == {3}


def test_a_worker_killed_with_several_episodes_costs_no_transition_and_doubles_none(
    served: Server, expected: Any, tmp_path: Path
) -> None:
    mark = tmp_path / "gate-11"  # mark of the second group

    def kill() -> None:
        wait_for(mark.exists)
        os.kill(int(mark.read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    gate = {"folder": str(tmp_path), "trouble": {"gate": [11]}}
    with Rollouts(
        RolloutPlan(LINE, "serve://Stochastic", workers=2, num_envs=3, env_options=gate, **GROUPS)
    ) as found:
        killer.start()
        got = without_key(found.collect(8))
        killer.join()
    assert got.equals(expected)
    assert 1 <= found.stats.retries <= 3
    assert found.stats.lost == 0


def test_what_the_policy_does_not_offer_ends_the_rollouts_at_once(
    served: Server, version: Path
) -> None:
    write(version, 1)
    with (
        Rollouts(RolloutPlan(LINE, served.url, want=["logprob", "entropy"])) as found,
        pytest.raises(NotOffered, match=r"only \['logprob', 'value'\], .* got \['entropy'\]"),
    ):
        next(found)
    assert found.stats.retries == 0
