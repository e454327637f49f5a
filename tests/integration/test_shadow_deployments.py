"""Candidates that do not fit, and candidates that change while the live policy runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import psutil
import pytest
from eval_fakes import wait_for
from ray.serve.schema import ServeDeploySchema
from shared_ray import shared_server

from tests.integration.conftest import serving
from tests.integration.test_shadow import AGENT, frames, played, recorded
from vlagents_ray import ConfigError, Obs, RemoteAgent
from vlagents_ray.serve.launch.deployment_file import deployment


def candidates() -> set[int]:
    """The processes of candidates on this machine."""
    found = psutil.process_iter(["pid", "cmdline"])
    return {one.info["pid"] for one in found if "ServeReplica:Seeded:Shadow" in " ".join(one.info["cmdline"] or ())}


def redeploy(config: ServeDeploySchema) -> None:
    """What `serve deploy` does with a changed file."""
    from ray.serve.context import _get_global_client

    client = _get_global_client()
    assert client is not None
    client.deploy_apps(config)


def test_a_candidate_that_turns_out_not_to_fit_fails_the_start_with_the_reason(shared_ray: None) -> None:
    with (
        pytest.raises(ConfigError, match="the policy gives 8, the env takes 7"),
        serving(AGENT, shadow={"policy": "shadowed_agents:Unstated"}),
    ):
        pass


def test_the_candidate_changes_its_settings_and_the_live_policy_does_not_restart(
    shared_ray: None, tmp_path: Path
) -> None:
    """As a deployment file states them, beside `args`."""

    def config(offset: float) -> ServeDeploySchema:
        shadow = {"policy": AGENT, "share": 1.0, "record": str(tmp_path)}
        found = deployment(AGENT, shadow=shadow).model_dump(exclude_unset=True)
        found["applications"][0]["deployments"] = [{"name": "Shadow", "user_config": {"offset": offset}}]
        return ServeDeploySchema.model_validate(found)

    def difference() -> float:
        played(server, "http", app="Seeded")
        acts = [line for line in recorded(tmp_path) if line["op"] == "act" and not line["dropped"]]
        return acts[-1]["difference"]["mean"] if acts else 0.0

    before = candidates()
    with shared_server(config(0.5)) as server, RemoteAgent(server.url) as agent:
        agent.reset(Obs({"front": np.zeros((2, 2, 3), np.uint8)}, 1.0, {"joints": np.ones(7, np.float32)}), "", seed=1)
        wait_for(lambda: difference() == pytest.approx(0.5, abs=1e-4))
        redeploy(config(2.0))
        wait_for(lambda: difference() == pytest.approx(2.0, abs=1e-4))
        assert agent.act(frames(0)[0]).action.shape == (4, 7)
        running = candidates() - before
        assert running
    wait_for(lambda: not running & candidates())
