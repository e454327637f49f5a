"""The code in README and in the pages under docs/ works: each Python and shell block is run as
written, or is marked with the reason why not.

Each block runs in a fresh folder with the files of a checkout and the results of earlier
evaluations. Blocks that need a served policy, and tutorials, are run by test_served_pages.py.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from in_process_evaluation import flat_config, play
from readme_blocks import (
    PAGES,
    PYTHON,
    SHELL,
    TUTORIALS,
    Block,
    blocks,
    check_commands,
    checkout,
    commands,
    read_as_typed,
    run,
)
from recorded_results import record, runs

from vlagents_ray.policies.scripted import Scripted

README = next(page for page in PAGES if page.name == "README.md")
BLOCKS = [(page, block) for page in PAGES for block in blocks(page.read_text())]
RUN_HERE = [
    (page, block)
    for page, block in BLOCKS
    if page not in TUTORIALS and not (block.not_run or block.server)
]
SEEDS = {"first": 0, "a": 0, "b": 10, "machine-a": 20, "machine-b": 30} | {
    f"array/{n}": 100 * n for n in range(4)
}

# Most commands in sentences cannot be run as they stand ("vlagents-ray serve POLICY"). Of the
# remaining ones, these are run,
RUN = {"vlagents-ray policies", "vlagents-ray robot --help"}
# And these are not.
NOT_RUN = {
    "vlagents-ray doctor": (
        "tests/cli/test_doctor.py runs each check, which starts a Ray and each simulator"
    ),
    "vlagents-ray envs": "a block of docs/evaluation/index.md runs it",
    "vlagents-ray serve noop --set delta=false": (
        "it serves until Ctrl-C; test_teleoperation.py reads such a contract"
    ),
    "vlagents-ray serve deployments/noop.yaml --set chunk=8 --serve-set batch.max_size=4": (
        "it serves until Ctrl-C; tests/test_overrides.py reads such settings"
    ),
    "vlagents-ray slurm eval": "the name of a command",
    "vlagents-ray robot --env tabletop --teleop keyboard": "tests/cli/test_robot.py types its keys",
    "vlagents-ray serve my_policies:Reach --set gain=0.3": (
        "test_served_pages.py serves examples/own_policy.py so"
    ),
    "vlagents-ray serve reach:Reach": (
        "it serves until Ctrl-C; test_weights_endpoint.py serves the page's policy"
    ),
    "vlagents-ray venv create hf --out .venv-hf": "it downloads packages",
    "vlagents-ray venv create openpi --out .venv-openpi": "it downloads packages",
    "vlagents-ray venv create rcs": "it downloads packages",
}


@pytest.fixture(scope="module")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return folders of results by the names that pages use: an expert's results at the tabletop,
    and a sweep of a learner.
    """
    folder = tmp_path_factory.mktemp("earlier") / "runs"
    for name, seed in SEEDS.items():
        first = name == "first"
        settings = {
            "policy": "other" if name == "b" else "scripted",
            "envs": ["tabletop"],
            "seed": seed,
        }
        settings |= {"episodes": 4 if first else 1}
        kept = "all" if first else "none"
        play(flat_config(**settings, out=folder / name, video=kept, record=kept), Scripted)
    record(runs(folder / "sweep"))
    return folder


@pytest.fixture
def reader(earlier: Path, tmp_path: Path) -> Path:
    """Return the working folder of a reader."""
    checkout(tmp_path)
    shutil.copytree(earlier, tmp_path / "runs")
    return tmp_path


def named(page: Path, block: Block) -> object:
    """Each command of a shell block exists; test_docs.py checks its options without starting it."""
    marks = [pytest.mark.integration] * (block.ray and page != README)
    marks += [pytest.mark.server] * block.ray + [pytest.mark.slow] * (
        block.ray or block.language in SHELL
    )
    return pytest.param(page, block, id=f"{page.stem}-{block}", marks=marks)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "block"), [named(page, block) for page, block in RUN_HERE])
def test_a_block_works(page: Path, block: Block, reader: Path) -> None:
    run(block, reader, page=page.stem)


@pytest.mark.slow
@pytest.mark.parametrize("line", sorted(RUN))
def test_a_command_in_a_sentence_works(line: str, tmp_path: Path) -> None:
    run(Block("bash", 1, line), tmp_path)


def test_python_that_is_not_run_is_python() -> None:
    for page, block in BLOCKS:
        if block.not_run and block.language in PYTHON:
            compile(block.source, page.name, "exec")


def test_commands_of_the_readme_that_are_not_run_exist() -> None:
    for page, block in BLOCKS:
        if page == README and block.not_run and block.language in SHELL:
            check_commands(block)


def test_the_readme_is_one_that_is_read() -> None:
    assert len(README.read_text().split()) <= 1200  # five minutes of reading
    assert {block.language for page, block in BLOCKS if page == README} == {"python", "bash"}


def as_it_stands(line: str) -> bool:
    """Return whether a command in a sentence can be run as it stands, without placeholders."""
    try:
        read_as_typed(line, whole=True)
    except ValueError:
        return False
    return not re.search(r"[\[\]…]|\.\.\.|\b[A-Z]{3,}\b", line)


def test_a_command_in_a_sentence_is_run_or_said_not_to_be() -> None:
    in_sentences = set()
    for page in PAGES:
        for line, in_block in commands(page.read_text()):
            if not in_block and as_it_stands(line):
                in_sentences.add(line)
    assert in_sentences == RUN | set(NOT_RUN)


def test_no_command_stands_in_a_block_that_nobody_runs() -> None:
    for page in PAGES:
        fences = re.findall(r"^ *```(\w*)\n(.*?)```", page.read_text(), re.DOTALL | re.MULTILINE)
        others = "".join(code for language, code in fences if language not in SHELL)
        assert not re.search(
            r"^ *(\$ )?(\w+=\S+ )*(vlagents-ray|python -m vlagents_ray\S*) ", others, re.MULTILINE
        ), page


def test_there_are_such_blocks() -> None:
    assert len(RUN_HERE) > 10
