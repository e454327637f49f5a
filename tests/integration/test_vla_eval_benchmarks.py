"""vla-eval's benchmarks RoboTwin and RoboDojo, with stand-ins for their simulators, against a server
with their presets.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from peer_environment import drive, peers_python
from shared_ray import shared_server

from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, read_deployment
from vlagents_ray.serve.launch.server import Server

BENCHMARKS = ("robotwin", "robodojo")
EPISODES, STEPS = 2, 7


@pytest.fixture(scope="module")
def server(shared_ray: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve an application for each benchmark, whose policy returns chunks of three rows."""
    apps = []
    for name in BENCHMARKS:
        args = {
            "policy": "served_agents:TwoArms",
            "config": {"chunk": 3},
            "dialects": {"vla_eval": {"mapping": name}},
        }
        apps.append(
            {"name": name, "route_prefix": f"/{name}", "import_path": IMPORT_PATH, "args": args}
        )
    file = tmp_path_factory.mktemp("deployment") / "benchmarks.yaml"
    file.write_text(yaml.safe_dump({"applications": apps}))
    with shared_server(read_deployment(str(file))) as server:
        yield server


@pytest.mark.program("vla-eval")
@pytest.mark.parametrize("benchmark", BENCHMARKS)
def test_a_benchmark_of_vla_eval_gets_the_actions_for_its_observations(
    server: Server, benchmark: str
) -> None:
    """Two shards run at the same time. Each action is the row for its step, even if an observation
    between two chunks has no image.
    """
    url = server.url.replace("http://", "ws://") + f"/{benchmark}/vla-eval"
    shards = drive(Path(peers_python()), f"{benchmark}_run", url, 2, EPISODES)
    assert len(shards) == 2
    for (result,) in shards:
        assert (result["mean_success"], result["num_errors"]) == (1.0, 0)
        [task] = result["tasks"]
        assert [episode["steps"] for episode in task["episodes"]] == [STEPS] * EPISODES
