"""Which words of a command line are sbatch's."""

from __future__ import annotations

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.slurm.submission import first_index, split

KNOWN = {"--policy": True, "--resume": False, "--out": True}


def test_what_the_command_knows_is_its_own_and_the_rest_is_sbatchs() -> None:
    words = "env/a --policy p --nodes 4 --resume --time=1:00:00 env/b --out=runs/x --gpus-per-node a100:2 --requeue"
    own, sbatch = split(words.split(), KNOWN)
    assert own == ["env/a", "--policy", "p", "--resume", "env/b", "--out=runs/x"]
    assert sbatch == {"nodes": "4", "time": "1:00:00", "gpus-per-node": "a100:2", "requeue": None}


def test_a_value_may_look_like_an_option_of_the_other() -> None:
    assert split(["--policy", "--nodes", "--comment", "--policy"], KNOWN) == (
        ["--policy", "--nodes"],
        {"comment": "--policy"},
    )


def test_an_option_that_stands_alone_leaves_the_next_word_alone() -> None:
    assert split(["--exclusive", "env/a"], KNOWN) == (["env/a"], {"exclusive": None})
    assert split(["--exclusive=user", "env/a"], KNOWN) == (["env/a"], {"exclusive": "user"})


def test_sbatchs_short_options_have_their_long_names() -> None:
    _, sbatch = split(["-N4", "-p", "gpu", "-t", "30", "-H", "-d", "afterok:7"], KNOWN)
    assert sbatch == {"nodes": "4", "partition": "gpu", "time": "30", "hold": None, "dependency": "afterok:7"}


def test_an_option_that_only_a_newer_sbatch_knows_is_passed_on() -> None:
    assert split(["--segment=4", "--oom-kill-step=1"], KNOWN)[1] == {"segment": "4", "oom-kill-step": "1"}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--nodes"], "want --nodes=VALUE"),
        (["--policy"], "want --policy=VALUE"),
        (["--ntasks=4"], "--nodes and --cpus-per-task"),
        (["-n4"], "--nodes"),
        (["--gpus-per-task=1"], "--gpus-per-node"),
        (["--wrap=ls"], "written for you"),
        (["-Z"], "neither this command.s"),
        (["--=3"], "want --NAME=VALUE"),
    ],
)
def test_words_that_would_not_work_are_told_with_what_would(words: list[str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        split(words, KNOWN)


def test_the_first_task_of_an_array() -> None:
    assert [first_index(array) for array in ("0-15", "4,9", "7-99:3%2")] == ["0", "4", "7"]
    with pytest.raises(ConfigError, match="want numbers"):
        first_index("all")
