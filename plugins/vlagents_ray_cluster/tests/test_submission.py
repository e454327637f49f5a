"""Tests of which arguments of a command line are passed to sbatch, and of the script."""

from __future__ import annotations

import os
import stat
import subprocess
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vlagents_ray.errors import ConfigError
from vlagents_ray_cluster.slurm.submission import (
    BODY,
    Script,
    SubmissionFailed,
    first_index,
    outside_of_jobs,
    split,
    submit,
)

COMMAND_OPTIONS = {"--policy": True, "--resume": False, "--out": True}


def test_what_the_command_knows_is_its_own_and_the_rest_is_sbatchs() -> None:
    words = (
        "env/a --policy p --nodes 4 --resume --time=1:00:00 env/b --out=runs/x --gpus-per-node "
        "a100:2 --requeue"
    )
    arguments, sbatch = split(words.split(), COMMAND_OPTIONS)
    assert arguments == ["env/a", "--policy", "p", "--resume", "env/b", "--out=runs/x"]
    assert sbatch == {"nodes": "4", "time": "1:00:00", "gpus-per-node": "a100:2", "requeue": None}


def test_a_value_may_look_like_an_option_of_the_other() -> None:
    assert split(["--policy", "--nodes", "--comment", "--policy"], COMMAND_OPTIONS) == (
        ["--policy", "--nodes"],
        {"comment": "--policy"},
    )


def test_an_option_that_stands_alone_leaves_the_next_word_alone() -> None:
    assert split(["--exclusive", "env/a"], COMMAND_OPTIONS) == (["env/a"], {"exclusive": None})
    assert split(["--exclusive=user", "env/a"], COMMAND_OPTIONS) == (
        ["env/a"],
        {"exclusive": "user"},
    )


def test_sbatchs_short_options_have_their_long_names() -> None:
    _, sbatch = split(["-N4", "-p", "gpu", "-t", "30", "-H", "-d", "afterok:7"], COMMAND_OPTIONS)
    assert sbatch == {
        "nodes": "4",
        "partition": "gpu",
        "time": "30",
        "hold": None,
        "dependency": "afterok:7",
    }


def test_an_option_that_only_a_newer_sbatch_knows_is_passed_on() -> None:
    assert split(["--segment=4", "--oom-kill-step=1"], COMMAND_OPTIONS)[1] == {
        "segment": "4",
        "oom-kill-step": "1",
    }


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--nodes"], "expected --nodes=VALUE"),
        (["--policy"], "expected --policy=VALUE"),
        (["--ntasks=4"], "--nodes and --cpus-per-task"),
        (["-n4"], "--nodes"),
        (["--gpus-per-task=1"], "--gpus-per-node"),
        (["--wrap=ls"], "written for you"),
        (["-Z"], "expected an option of this command"),
        (["--=3"], "expected --NAME=VALUE"),
    ],
)
def test_words_that_would_not_work_are_told_with_what_would(words: list[str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        split(words, COMMAND_OPTIONS)


def test_the_first_task_of_an_array() -> None:
    assert [first_index(array) for array in ("0-15", "4,9", "7-99:3%2")] == ["0", "4", "7"]
    with pytest.raises(ConfigError, match="expected numbers"):
        first_index("all")


SETTINGS = (b"python", b"folder", b"setup", b"resubmit", b"unfinished")
SBATCH = """#!/bin/bash
printf '%s\\n' "$@" >"{folder}/words"
env >"{folder}/environment"
{end}
"""


def script(folder: Path, **more: object) -> Script:
    return Script(
        "eval", folder, ["eval", "--", "env/*", "--set", "a b=$HOME"], {"nodes": "4"}, **more
    )  # type: ignore[arg-type]


def fake_sbatch(folder: Path, end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "bin" / "sbatch"
    file.parent.mkdir()
    file.write_text(SBATCH.format(folder=folder, end=end))
    file.chmod(0o755)
    monkeypatch.setenv("PATH", f"{file.parent}{os.pathsep}{os.environ['PATH']}")


def test_the_script_is_one_that_bash_reads(tmp_path: Path) -> None:
    text = script(tmp_path, setup=tmp_path / "it's here").text()
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)
    shown = subprocess.run(
        ["bash", "-c", text.removesuffix(BODY.read_text()) + ('printf "%s\\n" "${arguments[@]}" '
                                                              '"$setup"')],
        check=True, capture_output=True, text=True,
    ).stdout.splitlines()  # fmt: skip
    assert shown == ["eval", "--", "env/*", "--set", "a b=$HOME", str(tmp_path / "it's here")]


@given(
    name=st.text(),
    folder=st.text(min_size=1),
    option=st.text(),
    arguments=st.lists(
        st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"])), max_size=3
    ),
)
@example(name="eval", folder="./runs/x\necho INJECTED\n#", option="", arguments=[])
@example(name="eval", folder="runs", option="y\necho INJECTED\n#", arguments=[])
@example(
    name="eval",
    folder="runs",
    option="",
    arguments=["\necho INJECTED\n#", "$(echo INJECTED)", "'`id`"],
)
def test_no_name_path_or_option_becomes_a_command(
    name: str, folder: str, option: str, arguments: list[str]
) -> None:
    try:
        text = Script(name, Path(folder), arguments, {"comment": option}).text()
    except (ConfigError, ValueError):  # a path with a NUL character
        return
    head = text.removesuffix(BODY.read_text()).encode(errors="surrogateescape")
    commands = [
        line for line in head.split(b"arguments=(")[0].splitlines() if not line.startswith(b"#")
    ]
    assert [line.partition(b"=")[0] for line in commands] == [b"", *SETTINGS]

    expected = b"".join(argument.encode() + b"\0" for argument in arguments)
    show = b'printf "%s\\0" "${arguments[@]}"\n' if arguments else b""
    done = subprocess.run(["bash"], input=head + show, check=True, capture_output=True)
    assert (done.stdout, done.stderr) == (expected, b"")


def test_the_users_options_win_over_the_usual_ones(tmp_path: Path) -> None:
    options = {"nodes": "4", "output": "mine/%j", "no-requeue": None, "comment": "two words"}
    lines = Script("eval", tmp_path, [], options).text().splitlines()
    sbatch = [line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH")]
    assert {"--nodes=4", "--output=mine/%j", "--no-requeue", '--comment="two words"'} <= set(sbatch)
    assert "--requeue" not in sbatch
    assert len({line.partition("=")[0] for line in sbatch}) == len(sbatch)


def test_a_job_that_is_submitted_from_within_a_job_does_not_inherit_its_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_sbatch(tmp_path, "echo '812;there'", monkeypatch)
    for name, value in {"SLURM_NTASKS": "8", "SLURM_CONF": "/x", "SBATCH_ACCOUNT": "mine"}.items():
        monkeypatch.setenv(name, value)
    assert submit(script(tmp_path / "s")) == "812"

    environment = (tmp_path / "environment").read_text()
    assert "SLURM_NTASKS" not in environment
    assert "SLURM_CONF=/x\n" in environment
    assert "SBATCH_ACCOUNT=mine\n" in environment
    assert (tmp_path / "words").read_text().split() == [
        "--parsable",
        str(tmp_path / "s" / "eval.sh"),
    ]
    assert stat.S_IMODE((tmp_path / "s" / "eval.sh").stat().st_mode) == 0o700


def test_what_sbatch_says_is_handed_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_sbatch(tmp_path, "echo 'invalid partition' >&2; exit 1", monkeypatch)
    with pytest.raises(SubmissionFailed, match="invalid partition"):
        submit(script(tmp_path / "s"))


def test_without_slurm_the_script_is_there_to_be_taken_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"sbatch is not installed here.*eval\.sh"):
        submit(script(tmp_path / "s"))
    assert (tmp_path / "s" / "eval.sh").is_file()


def test_only_slurms_own_variables_are_left_out() -> None:
    assert outside_of_jobs({"SLURM_JOB_ID": "1", "SLURM_CONF": "c", "HOME": "h"}) == {
        "SLURM_CONF": "c",
        "HOME": "h",
    }
