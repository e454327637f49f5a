"""The episodes of a small evaluation are identical to those of earlier versions, byte for byte,
except times.

`python tests/evaluate/test_golden_episodes.py` writes golden_episodes.json again. This is needed
after an intended change of an environment, a policy, or the keys of episodes.
"""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy

GOLDEN = Path(__file__).with_name("golden_episodes.json")
SIZE = {"width": 32, "height": 32}
ENVS = ["tabletop", "tabletop/lift", "tabletop/slide"]
CHUNKS = {"chunk": 8, "action_dim": 4}

# Plans by name: the policy, its configuration, and the plan's settings of the policy and of the
# suite.
PLANS: dict[str, tuple[str, dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "expert": ("scripted", {}, {}, {"seeds": [0, 40]}),
    "expert, three envs side by side": ("scripted", {}, {}, {"num_envs": 3}),
    "chunks": ("random", CHUNKS, {"execute": 5}, {"env_options": SIZE | {"max_steps": 17}}),
    "real time": (
        "random",
        CHUNKS,
        {},
        {"env_options": SIZE | {"max_steps": 30}, "clock": {"latency": 0.25}},
    ),
    "real time, async": (
        "random",
        CHUNKS,
        {"execute": 4},
        {"env_options": SIZE | {"max_steps": 30}, "clock": {"latency": 0.25, "mode": "async"}},
    ),
}


def episodes(name: str, out: Path) -> list[dict[str, Any]]:
    """Run a plan in this process, and return the outcomes of its episodes."""
    policy, settings, in_plan, in_suite = PLANS[name]
    suite = {"envs": ENVS, "env_options": SIZE, "episodes": 4} | in_suite
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": policy, **in_plan}],
            "suites": [suite],
            "out": out,
            "workers": 0,
            "video": "none",
        }
    )
    make = partial(LocalPolicy, ServerArgs(policy=policy), settings)
    results = evaluate(config, agent_factory=make).results
    outcomes = [episode.result.outcome for episode in results.episodes]
    return [outcome | {"key": str(outcome["key"])} for outcome in outcomes]


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANS)
def test_its_episodes_are_those_of_earlier_versions(name: str, tmp_path: Path) -> None:
    assert episodes(name, tmp_path) == json.loads(GOLDEN.read_text())[name]


def test_environments_side_by_side_change_nothing_but_the_keys() -> None:
    golden = json.loads(GOLDEN.read_text())
    alone = {
        (outcome["key"].partition("@")[0], outcome["actions_sha256"])
        for outcome in golden["expert"]
    }
    for outcome in golden["expert, three envs side by side"]:
        assert (outcome["key"].partition("@")[0], outcome["actions_sha256"]) in alone


def main() -> None:
    """Write the golden file."""
    golden = {}
    for name in PLANS:
        with tempfile.TemporaryDirectory() as folder:
            golden[name] = episodes(name, Path(folder))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n")


if __name__ == "__main__":
    main()
