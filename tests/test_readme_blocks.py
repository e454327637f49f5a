"""The mechanism behind test_pages.py, tested with separate texts."""

from __future__ import annotations

from pathlib import Path

import pytest
from readme_blocks import Block, blocks, check_commands, run


def one(text: str) -> Block:
    (block,) = blocks(text)
    return block


def shell(code: str, mark: str = "<!-- not run: an example -->") -> Block:
    return one(f"{mark}\n```bash\n{code}\n```\n")


def test_only_python_and_shell_blocks_are_taken() -> None:
    text = "".join(
        f"```{language}\nx\n```\n"
        for language in ("python", "yaml", "bash", "", "console", "sh", "json")
    )
    assert [block.language for block in blocks(text)] == ["python", "bash", "console", "sh"]


@pytest.mark.parametrize(
    ("above", "server", "peers", "not_run"),
    [
        ("", None, False, None),
        ("<!-- test -->\n", None, False, None),
        ("<!-- test: serve scripted -->\n", "scripted", False, None),
        ("<!-- test with peers -->\n", None, True, None),
        (
            "<!-- test: serve deployments/openpi.yaml with peers -->\n",
            "deployments/openpi.yaml",
            True,
            None,
        ),
        ("<!-- not run: needs a robot -->\n", None, False, "needs a robot"),
        # The comment is not directly above the block.
        ("<!-- not run: needs a robot -->\nSome text.\n", None, False, None),
    ],
)
def test_the_comment_above_a_block_says_how_it_is_tested(
    above: str, server: str | None, peers: bool, not_run: str | None
) -> None:
    block = one(f"{above}```python\n```\n")
    assert (block.server, block.peers, block.not_run) == (server, peers, not_run)


@pytest.mark.parametrize("mark", ["not run", "not run:", "skip", "test: deploy scripted", "tset"])
def test_an_unknown_mark_is_refused(mark: str) -> None:
    with pytest.raises(ValueError, match="expected 'test'"):
        blocks(f"<!-- {mark} -->\n```python\n```\n")


@pytest.mark.parametrize("text", ["```python\nprint(1)\n", "<!-- test\n"])
def test_an_unfinished_block_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="ends inside"):
        blocks(text)


def test_further_lines_of_the_comment_run_before_the_block(tmp_path: Path) -> None:
    run(one("<!-- test\nx = 1 -->\n```python\nassert x == 1\n```\n"), tmp_path)


def test_a_block_inside_a_list_loses_the_lists_indent(tmp_path: Path) -> None:
    block = one("- how:\n  ```python\n  for i in range(2):\n      print(i)\n  ```\n")
    assert block.source.splitlines()[-2:] == ["for i in range(2):", "    print(i)"]
    run(block, tmp_path)


def test_of_a_console_block_only_what_was_typed_is_run(tmp_path: Path) -> None:
    run(one("```console\n$ echo hello >file\nnot a command\n```\n"), tmp_path)
    assert (tmp_path / "file").read_text() == "hello\n"


def test_a_failing_python_block_fails_with_the_readmes_line_number(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"README_page\.py\", line 4"):
        run(one("# Title\n\n```python\nraise SystemError\n```\n"), tmp_path)


def test_a_shell_block_fails_at_its_first_failing_command(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="exit status 1"):
        run(one("```bash\nfalse\necho fine\n```\n"), tmp_path)


def test_the_documented_server_stands_for_the_running_one(tmp_path: Path) -> None:
    block = one(
        '```python\nassert "http://gpu-box:8000/v1" == "http://" + "127.0.0.1:" + "4321/v1"\n```\n'
    )
    run(block, tmp_path, host="127.0.0.1:4321")


@pytest.mark.parametrize(
    "code", ["make setup", "git clone URL", "FOO=1 ls -l  # a comment", "ls \\\n  -l", "cd /"]
)
def test_commands_that_exist_pass_without_being_run(code: str) -> None:
    check_commands(shell(code))


@pytest.mark.parametrize(
    "code", ["make no-such-target", "no-such-command --option", "echo 'unfinished"]
)
def test_commands_that_do_not_exist_fail(code: str) -> None:
    with pytest.raises(AssertionError, match="README line-3"):
        check_commands(shell(code))


def test_an_option_that_the_command_lacks_fails() -> None:
    check_commands(shell("vlagents-ray serve scripted --port 8000"))
    with pytest.raises(AssertionError, match="--prot"):
        check_commands(shell("vlagents-ray serve scripted --prot 8000"))


PRINTS = "```bash\necho 'loading'; printf 'pick   9/10 90.0%%\\nsaved: runs/x\\n'\n```\n\n"


def output(text: str) -> str:
    return f"{PRINTS}It prints:\n\n<!-- output -->\n```text\n{text}\n```\n"


@pytest.mark.parametrize(
    "text", ["pick 2/4 50%", " pick   9/10 90.0%\n\nsaved: runs/x", "saved: …", "loading"]
)
def test_output_on_a_page_is_compared_without_its_numbers_and_spaces(
    text: str, tmp_path: Path
) -> None:
    run(one(output(text)), tmp_path)


@pytest.mark.parametrize("text", ["place 9/10 90%", "saved: runs/x\npick 9/10 90%", "saved"])
def test_output_that_a_block_does_not_print_in_this_order_fails(text: str, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="does not print"):
        run(one(output(text)), tmp_path)


def test_output_without_a_block_before_it_is_an_error() -> None:
    with pytest.raises(ValueError, match="a block before it"):
        blocks("<!-- output -->\n```text\nx\n```\n")
