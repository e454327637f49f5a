"""The code in README and docs that needs a served policy works, and each tutorial works from its
first block to its last.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from asgi_server import policy_server
from ray_processes import serving
from readme_blocks import (
    DOCUMENTED_HOST,
    EXAMPLES,
    PAGES,
    TUTORIALS,
    Block,
    blocks,
    checkout,
    code_of,
    run,
)

from vlagents_ray.policies.noop import Noop

pytestmark = [pytest.mark.server, pytest.mark.slow]

README = next(page for page in PAGES if page.name == "README.md")
_SERVED = [
    (page, block)
    for page in PAGES
    if page not in TUTORIALS
    for block in blocks(page.read_text())
    if block.server
]
# Examples: a loop in which the guard rejects the random policy's actions, and the notebook.
_LOOP = (
    "python examples/robot_loop.py http://gpu-box:8000 >said\ngrep 'refused, .* a step of at most "
    "max_step' said"
)
_SERVED += [
    (EXAMPLES / "robot_loop.py", Block("bash", 1, _LOOP, "random")),
    (EXAMPLES / "tour.ipynb", code_of(EXAMPLES / "tour.ipynb", "scripted")),
]
# Sorted by server, beginning with the server that the tutorials have left running.
SERVED = sorted(_SERVED, key=lambda one: (one[1].server != "noop", str(one[1].server)))
OF_README = [block for page, block in SERVED if page == README]


@pytest.fixture(scope="module")
def host_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str | None], str]]:
    """Return a function that returns a policy's "host:port" and starts its server at the first
    call. Only one server runs at a time.
    """
    with contextlib.ExitStack() as running:
        current: dict[str, str] = {}

        def host(policy: str | None) -> str:
            if policy is None:
                return DOCUMENTED_HOST
            if policy not in current:
                running.close()
                current.clear()
                log = tmp_path_factory.mktemp("serve") / "log"
                current[policy] = running.enter_context(serving(policy, log))
            return current[policy]

        yield host


def test_modules_of_ones_own_are_served_evaluated_and_trained_from_their_folder(
    tmp_path: Path,
) -> None:
    folder, log = tmp_path / "examples", tmp_path / "log"
    shutil.copytree(EXAMPLES, folder, ignore=shutil.ignore_patterns("runs"))
    with serving("own_policy:Servo", log, None, "--set", "camera_turn=120", cwd=folder) as host:
        said = log.read_text()
        url = f"http://{host}"
        evaluation = (
            f"vlagents-ray eval own_env:CraneEnv --policy {url} --episodes 2 --workers 0 "
            "--out runs/own"
        )
        # Ray's token is in this folder
        training = f"HOME={Path.home()} python rl_loop.py {url} >learned"
        run(Block("bash", 1, f"{evaluation}\n{training}"), folder, host)
        learned = re.findall(r"^servo@\d+: (\d+)%", (folder / "learned").read_text(), re.MULTILINE)
        assert (learned[0], int(learned[-1]) > 50) == ("0", True)
        deadline = time.monotonic() + 60
        while "Ctrl-C stops" not in said and time.monotonic() < deadline:
            time.sleep(0.2)
            said = log.read_text()
    varying = ("log of Ray, ", "metrics for Prometheus: ")
    assert [line for line in said.splitlines() if not line.startswith(varying)] == [
        f"serving Servo at {url}",
        "  policy: own_policy:Servo (camera_turn=120)",
        f"  API: {url}/docs",
        f"  live page: {url}/live",
        f"in a Ray program on this machine: vlagents_ray.join('{url}')",
        "Ctrl-C stops",
    ]
    [kept] = re.findall(r"^log of Ray, Serve and HAProxy: (.*)$", said, re.MULTILINE)
    assert "Adding 1 replica to Deployment(name='Policy', app='Servo')" in Path(kept).read_text()
    Path(kept).unlink()


@pytest.mark.integration
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_works_from_top_to_bottom(
    page: Path, host_of: Callable[[str | None], str], tmp_path: Path
) -> None:
    for block in blocks(page.read_text()):
        if block.not_run is None:
            run(block, tmp_path, host_of(block.server), page=f"page_{page.stem}")


@pytest.mark.parametrize("block", OF_README, ids=str)
def test_a_block_of_the_readme_works_with_a_server_in_this_process(
    block: Block, tmp_path: Path
) -> None:
    """test_pages below uses a separate server, like a reader."""
    assert block.server == "noop"
    with policy_server(Noop.from_config({})) as port:
        run(block, tmp_path, f"127.0.0.1:{port}")


@pytest.mark.integration
@pytest.mark.parametrize(
    ("page", "block"),
    [pytest.param(page, block, id=f"{page.stem}-{block}") for page, block in SERVED],
)
def test_a_block_works(
    page: Path, block: Block, host_of: Callable[[str | None], str], tmp_path: Path
) -> None:
    checkout(tmp_path)
    run(block, tmp_path, host_of(block.server), page=page.stem)


def test_there_are_such_blocks() -> None:
    assert {block.server for _, block in SERVED} >= {
        "noop",
        "random",
        "scripted",
        "deployments/openpi.yaml",
    }
    assert len(OF_README) > 0
    assert len(TUTORIALS) == 6
