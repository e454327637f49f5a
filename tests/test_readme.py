"""What the README shows works: every Python and shell block in it is run, or says why not."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from readme_blocks import DOCUMENTED_HOST, PYTHON, ROOT, SHELL, Block, blocks, check_commands, run
from serve_command import serving

README = ROOT / "README.md"


@pytest.fixture(scope="module")
def host_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str | None], str]]:
    """A policy's "host:port"; its server is started when first asked for. One runs at a time."""
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


def readme_blocks() -> list[Block]:
    return blocks(README.read_text()) if README.exists() else []


def test_the_readme_has_python_and_shell_blocks() -> None:
    languages = {block.language for block in readme_blocks()}
    assert languages & PYTHON
    assert languages & SHELL


@pytest.mark.parametrize(
    "block",
    [pytest.param(b, id=str(b), marks=[] if b.not_run else [pytest.mark.slow]) for b in readme_blocks()],
)
def test_a_readme_block_works(block: Block, host_of: Callable[[str | None], str], tmp_path: Path) -> None:
    if block.not_run is None:
        run(block, tmp_path, host_of(block.server))
    elif block.language in PYTHON:
        compile(block.source, README.name, "exec")
    else:
        check_commands(block)
