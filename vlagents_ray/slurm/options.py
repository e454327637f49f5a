"""One command line for two programs: which of its words are sbatch's.

The rule: an option that the command itself knows is its own, every other one is sbatch's, by sbatch's names. What is no
option belongs to the option before it or else to the command.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from vlagents_ray.errors import ConfigError

# Those of sbatch (22.05 to 24.11) that stand alone, or take a value only with "=".
_ALONE = {
    "contiguous", "exclusive", "get-user-env", "hold", "ignore-pbs", "nice", "no-kill", "no-requeue", "overcommit",
    "oversubscribe", "propagate", "quiet", "reboot", "requeue", "spread-job", "stepmgr", "test-only", "use-min-nodes",
    "verbose",
}  # fmt: skip
_SHORT = {
    "A": "account", "B": "extra-node-info", "C": "constraint", "D": "chdir", "F": "nodefile", "G": "gpus",
    "H": "hold", "J": "job-name", "L": "licenses", "M": "clusters", "N": "nodes", "O": "overcommit", "S": "core-spec",
    "a": "array", "b": "begin", "c": "cpus-per-task", "d": "dependency", "e": "error", "k": "no-kill",
    "m": "distribution", "o": "output", "p": "partition", "q": "qos", "s": "oversubscribe", "t": "time",
    "w": "nodelist", "x": "exclude",
}  # fmt: skip
# A Ray cluster is one process a node, started by the script.
_OURS = {
    "ntasks": "--nodes and --cpus-per-task", "ntasks-per-node": "--nodes and --cpus-per-task", "n": "--nodes",
    "ntasks-per-gpu": "--gpus-per-node", "ntasks-per-core": "--cpus-per-task", "ntasks-per-socket": "--cpus-per-task",
    "gpus-per-task": "--gpus-per-node", "wrap": "nothing of it: the script is written for you",
    "wait": "`squeue`, and --dependency in the jobs that wait", "W": "`squeue`, and --dependency in the jobs that wait",
    "input": "a deployment or a file of runs", "i": "a file of runs",
}  # fmt: skip


def split(words: Sequence[str], known: Mapping[str, bool]) -> tuple[list[str], dict[str, str | None]]:
    """The command's own words, and sbatch's options by their long names (None: it stands alone).

    `known`: the command's options ("--policy"), and whether each takes a value. `ConfigError` for words of
    sbatch's that would not work.
    """
    own: list[str] = []
    sbatch: dict[str, str | None] = {}
    waiting = iter(words)
    for word in waiting:
        name, equals, value = word.partition("=")
        if not word.startswith("-") or word == "-":
            own.append(word)
        elif name in known:
            own.append(word)
            if known[name] and not equals:
                own.append(_next(waiting, name))
        else:
            option, attached = _sbatch(word, name, value if equals else None)
            if option not in _ALONE and attached is None:
                attached = _next(waiting, f"--{option}")
            sbatch[option] = attached
    return own, sbatch


def _sbatch(word: str, name: str, value: str | None) -> tuple[str, str | None]:
    """The long name of an option of sbatch, and the value that is in the same word."""
    option = name[2:]
    if not word.startswith("--"):
        letter = word[1]
        option, value = _SHORT.get(letter, letter), word[2:] or None
    if option in _OURS:
        raise ConfigError(f"{word}: sbatch's, but one Ray runs on each node; want {_OURS[option]}")
    if not word.startswith("--") and len(option) == 1:
        raise ConfigError(f"{word}: no option of this command, nor a short one of sbatch's that can be given here")
    if not re.fullmatch(r"[a-z][a-z0-9-]*", option):
        raise ConfigError(f"{word}: got no option's name, want --NAME=VALUE")
    return option, value


def _next(words: Iterable[str], option: str) -> str:
    value = next(iter(words), None)
    if value is None:
        raise ConfigError(f"{option}: got no value; want {option}=VALUE")
    return value


def first_index(array: str) -> str:
    """The first task of an `--array`: "4-9%2" has 4."""
    found = re.match(r"\d+", array)
    if found is None:
        raise ConfigError(f"--array: got {array!r}, want numbers, as in 0-15, 1,3,7 or 0-99%4")
    return found[0]
