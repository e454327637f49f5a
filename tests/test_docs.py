"""What the pages under docs/ tell people to write is accepted."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from vlagents_ray.cli.evaluation import read_run
from vlagents_ray.envs import metaworld
from vlagents_ray.envs.known import known
from vlagents_ray.envs.protocol import Protocol
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.serve.environments.config import EnvironmentArgs

DOCS = Path(__file__).parents[1] / "docs"
BLOCKS = re.findall(r"```yaml\n(.*?)```", (DOCS / "environments.md").read_text(), re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS)
def test_an_environment_as_it_is_documented_is_accepted(block: str) -> None:
    document = yaml.safe_load(block)
    if "applications" in document:
        [application] = document["applications"]
        document = application["args"]
    assert EnvironmentArgs(**document["environment"]) != EnvironmentArgs()


def test_there_are_such_blocks() -> None:
    assert len(BLOCKS) == 2


def test_the_file_of_runs_behind_the_reports_picture_is_accepted() -> None:
    config = EvalConfig.model_validate(read_run(DOCS / "evaluation" / "picture.yaml"))
    assert [policy.source for policy in config.policies] == ["learner:Learner", "scripted", "random"]


def test_files_of_runs_on_the_benchmarks_pages_and_on_placement_are_accepted() -> None:
    pages = [*sorted((DOCS / "benchmarks").glob("*.md")), DOCS / "cluster" / "placement.md"]
    blocks = [
        block for page in pages for block in re.findall(r"```yaml\n(policies:.*?)```", page.read_text(), re.DOTALL)
    ]
    assert blocks
    for block in blocks:
        assert EvalConfig.model_validate({"out": "runs/documented"} | yaml.safe_load(block)).suites


@pytest.mark.parametrize(
    ("page", "protocol"),
    [
        ("metaworld", metaworld.PROTOCOL),
        ("pusht", known("gym_pusht/PushT-v0").protocol),
        ("gymnasium", known("FetchReach-v4").protocol),
    ],
)
def test_a_benchmarks_page_states_the_protocol_that_is_recorded(page: str, protocol: Protocol) -> None:
    text = (DOCS / "benchmarks" / f"{page}.md").read_text()
    rows = dict(re.findall(r"^\| (\w+) \| (.*) \|$", text, re.MULTILINE))
    assert re.match(r"\d+", rows["steps"]).group() == str(protocol.max_steps)  # type: ignore[union-attr]
    assert rows["rate"] == f"{protocol.control_hz:g} Hz"
    assert ("ends the episode" in rows["success"]) is protocol.ends_on_success
