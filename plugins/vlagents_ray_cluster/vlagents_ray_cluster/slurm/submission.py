"""The submission of jobs: the options of sbatch, the script, and the call of sbatch."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.cli.exit_status import OUT_OF_TIME
from vlagents_ray.errors import ConfigError, VLAgentsError

# Options of sbatch (22.05 to 24.11) without a value, or with a value only after "=".
_ALONE = {
    "contiguous",
    "exclusive",
    "get-user-env",
    "hold",
    "ignore-pbs",
    "nice",
    "no-kill",
    "no-requeue",
    "overcommit",
    "oversubscribe",
    "propagate",
    "quiet",
    "reboot",
    "requeue",
    "spread-job",
    "stepmgr",
    "test-only",
    "use-min-nodes",
    "verbose",
}
# The long names of sbatch's short options.
_SHORT = {
    "A": "account",
    "B": "extra-node-info",
    "C": "constraint",
    "D": "chdir",
    "F": "nodefile",
    "G": "gpus",
    "H": "hold",
    "J": "job-name",
    "L": "licenses",
    "M": "clusters",
    "N": "nodes",
    "O": "overcommit",
    "S": "core-spec",
    "a": "array",
    "b": "begin",
    "c": "cpus-per-task",
    "d": "dependency",
    "e": "error",
    "k": "no-kill",
    "m": "distribution",
    "o": "output",
    "p": "partition",
    "q": "qos",
    "s": "oversubscribe",
    "t": "time",
    "w": "nodelist",
    "x": "exclude",
}
# Rejected options, and what to use instead. The script starts one process of Ray on each node.
_OURS = {
    "ntasks": "--nodes and --cpus-per-task",
    "ntasks-per-node": "--nodes and --cpus-per-task",
    "n": "--nodes",
    "ntasks-per-gpu": "--gpus-per-node",
    "ntasks-per-core": "--cpus-per-task",
    "ntasks-per-socket": "--cpus-per-task",
    "gpus-per-task": "--gpus-per-node",
    "wrap": "no `--wrap`, as the script is written for you",
    "wait": "`squeue`, and --dependency in the waiting jobs",
    "W": "`squeue`, and --dependency in the waiting jobs",
    "input": "a deployment or a run file",
    "i": "a run file",
}
BODY = Path(__file__).with_name("job.sh")
_LINE_ENDS = "\x7f\x85\u2028\u2029"
# Variables with the location of Slurm. Slurm's other variables belong to this process's job.
_KEPT = {"SLURM_CONF", "SLURM_CLUSTERS"}
_SBATCH_S = 120.0


def split(
    words: Sequence[str], command_options: Mapping[str, bool]
) -> tuple[list[str], dict[str, str | None]]:
    """Separate a command's arguments from options of sbatch.

    Args:
        words: The arguments on the command line.
        command_options: The names of the command's options, and whether each has a value.

    Returns:
        The command's arguments, and the options of sbatch: long name -> value, or None for an
        option without a value.

    Raises:
        ConfigError: An option is not valid, does not fit the script, or lacks its value.
    """
    arguments: list[str] = []
    sbatch: dict[str, str | None] = {}
    remaining = iter(words)
    for word in remaining:
        name, equals, value = word.partition("=")
        if not word.startswith("-") or word == "-":
            arguments.append(word)
        elif name in command_options:
            arguments.append(word)
            if command_options[name] and not equals:
                arguments.append(_next(remaining, name))
        else:
            is_short = not word.startswith("--")
            if is_short:
                option, attached = _SHORT.get(word[1], word[1]), word[2:] or None
            else:
                option, attached = name[2:], value if equals else None

            if option in _OURS:
                raise ConfigError(
                    f"{word}: expected options that fit one Ray process on each node, got this "
                    f"option; use {_OURS[option]}"
                )
            if is_short and len(option) == 1:
                raise ConfigError(
                    f"{word}: expected an option of this command or a short option of sbatch, got "
                    f"another"
                )
            if not re.fullmatch(r"[a-z][a-z0-9-]*", option):
                raise ConfigError(f"{word}: expected --NAME=VALUE, got an invalid name")

            if option not in _ALONE and attached is None:
                attached = _next(remaining, f"--{option}")
            sbatch[option] = attached
    return arguments, sbatch


def _next(words: Iterable[str], option: str) -> str:
    """Return the next word, which is the value of an option; raises `ConfigError` at the end."""
    value = next(iter(words), None)
    if value is None:
        raise ConfigError(f"{option}: expected {option}=VALUE, got no value")
    return value


def first_index(array: str) -> str:
    """Return the number of the first task of `--array`, such as 4 for "4-9%2".

    Raises:
        ConfigError: The value does not begin with a number.
    """
    match = re.match(r"\d+", array)
    if match is None:
        raise ConfigError(f"--array: expected numbers, as in 0-15, 1,3,7 or 0-99%4, got {array!r}")
    return match[0]


@dataclass(frozen=True, slots=True)
class Script:
    """The script of a job; its strings may contain %a, the number of a task of `--array`."""

    name: str
    folder: Path  # folder for the script and the job's logs, on a file system that all nodes share
    arguments: Sequence[str]  # arguments of `vlagents_ray_cluster.slurm.job`
    options: Mapping[str, str | None]  # options of sbatch; they override the defaults
    resubmit: int = 0  # number of times that the job is submitted again when its time is over
    setup: Path | None = None  # a file of shell lines to run first

    @property
    def file(self) -> Path:
        """The path of the script."""
        return self.folder / f"{self.name}.sh"

    def text(self) -> str:
        """Return the content of the script.

        Raises:
            ConfigError: A name, path or option has a control character (after a line feed, the rest
                of a comment would be a command), or a value with spaces has quotes, which sbatch
                cannot read.
        """
        defaults: dict[str, str | None] = {
            "job-name": f"vlagents-ray-{self.name}",
            "nodes": "1",
            "ntasks-per-node": "1",
            "chdir": os.getcwd(),
            "output": str(self.folder.absolute() / "%j.log"),
            "open-mode": "append",
        }
        if "no-requeue" not in self.options:
            defaults["requeue"] = None

        words = []
        for option, value in (defaults | dict(self.options)).items():
            spaced = value is not None and any(sign.isspace() for sign in value)
            if value is not None and spaced and '"' in value:
                raise ConfigError(
                    f"slurm: expected no quotes in a value with spaces, got {value[:200]!r}"
                )

            if value is None:
                words.append(f"--{option}")
            elif spaced:
                words.append(f'--{option}="{value}"')
            else:
                words.append(f"--{option}={value}")

        for word in (self.name, str(self.folder), *words):
            if any(ord(sign) < ord(" ") or sign in _LINE_ENDS for sign in word):
                raise ConfigError(
                    f"slurm: expected no control characters, such as line feeds, got {word[:200]!r}"
                )

        settings = {
            "python": sys.executable,
            "folder": str(self.folder.absolute()),
            "setup": "" if self.setup is None else str(self.setup.absolute()),
            "resubmit": str(self.resubmit),
            "unfinished": str(OUT_OF_TIME),
        }
        path = shlex.quote(str(self.file))
        lines = [
            "#!/bin/bash",
            f"# Written by `vlagents-ray slurm {self.name}`; again: sbatch {path}",
            *(f"#SBATCH {word}" for word in words),
            "",
            *(f"{name}={shlex.quote(value)}" for name, value in settings.items()),
            f"arguments=({shlex.join(self.arguments)})",
            "",
        ]
        return "\n".join(lines) + "\n" + BODY.read_text()


class SubmissionFailed(VLAgentsError):
    """sbatch rejected the job; the message quotes it."""


def submit(script: Script) -> str:
    """Write a script and submit it.

    Returns:
        The number of the job.

    Raises:
        ConfigError: sbatch is not installed.
        SubmissionFailed: sbatch rejected the job, or did not answer.
    """
    file = script.file.absolute()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(script.text())
    file.chmod(0o700)

    try:
        done = subprocess.run(  # noqa: S603 - the user's own arguments
            ["sbatch", "--parsable", str(file)],  # noqa: S607 - found by PATH
            capture_output=True,
            text=True,
            check=False,
            timeout=_SBATCH_S,
            env=outside_of_jobs(os.environ),
        )
    except FileNotFoundError as error:
        raise ConfigError(
            f"sbatch is not installed here: run it where jobs are submitted, or copy {file} there "
            "(--dry-run shows it)"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise SubmissionFailed(
            f"sbatch {file}: no answer in {_SBATCH_S:g} s; check with `squeue --me`"
        ) from error

    if done.returncode:
        raise SubmissionFailed(f"sbatch {file}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout.strip().partition(";")[0]


def outside_of_jobs(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without the variables of this process's job, such as a training.

    sbatch passes its environment to the new job, whose steps would read these variables as options.
    """
    environment = {}
    for name, value in environ.items():
        if not name.startswith("SLURM_") or name in _KEPT:
            environment[name] = value
    return environment
