"""The split of a command line into the command's own arguments and options of sbatch.

An option that the command defines is its own; every other option is sbatch's. An argument that is not an option belongs
to the option before it, or else to the command.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from vlagents_ray.errors import ConfigError

# Options of sbatch (22.05 to 24.11) without a value, or with a value after "=" only.
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
# The script starts one process of Ray on each node, so these options are refused.
_OURS = {
    "ntasks": "--nodes and --cpus-per-task", "ntasks-per-node": "--nodes and --cpus-per-task", "n": "--nodes",
    "ntasks-per-gpu": "--gpus-per-node", "ntasks-per-core": "--cpus-per-task", "ntasks-per-socket": "--cpus-per-task",
    "gpus-per-task": "--gpus-per-node", "wrap": "no `--wrap`, as the script is written for you",
    "wait": "`squeue`, and --dependency in the jobs that wait", "W": "`squeue`, and --dependency in the jobs that wait",
    "input": "a deployment or a file of runs", "i": "a file of runs",
}  # fmt: skip


def split(words: Sequence[str], known: Mapping[str, bool]) -> tuple[list[str], dict[str, str | None]]:
    """Split a command line.

    Args:
        words: The arguments.
        known: The command's options ("--policy"), and whether each has a value.

    Returns:
        The command's own arguments, and sbatch's options by their long names; the value of an option without one is
        None.

    Raises:
        ConfigError: An option of sbatch cannot be used here, or lacks its value.
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
    """Return the long name of an option of sbatch, and its value in the same argument."""
    option = name[2:]
    if not word.startswith("--"):
        letter = word[1]
        option, value = _SHORT.get(letter, letter), word[2:] or None
    if option in _OURS:
        raise ConfigError(f"{word}: got an option that does not fit one Ray process on each node; want {_OURS[option]}")
    if not word.startswith("--") and len(option) == 1:
        raise ConfigError(f"{word}: got an option that is neither this command's nor a short one of sbatch")
    if not re.fullmatch(r"[a-z][a-z0-9-]*", option):
        raise ConfigError(f"{word}: got an invalid option name, want --NAME=VALUE")
    return option, value


def _next(words: Iterable[str], option: str) -> str:
    value = next(iter(words), None)
    if value is None:
        raise ConfigError(f"{option}: got no value; want {option}=VALUE")
    return value


def first_index(array: str) -> str:
    """Return the first task of an `--array`: 4 of "4-9%2"."""
    found = re.match(r"\d+", array)
    if found is None:
        raise ConfigError(f"--array: got {array!r}, want numbers, as in 0-15, 1,3,7 or 0-99%4")
    return found[0]
