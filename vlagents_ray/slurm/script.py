"""The script of a job: options of sbatch, settings of the job, and `job.sh`, which is the same for all jobs."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vlagents_ray.errors import ConfigError

BODY = Path(__file__).with_name("job.sh")
_LINE_ENDS = "\x7f\x85\u2028\u2029"
UNFINISHED = 75  # exit status of `vlagents-ray eval` when its time is over (EX_TEMPFAIL of sysexits.h)


@dataclass(frozen=True, slots=True)
class Script:
    """A job; its strings may contain %a, the number of a task of `--array`."""

    name: str
    folder: Path  # for the script and the job's logs, on a file system that all nodes share
    arguments: Sequence[str]  # of `vlagents_ray.slurm.job_main`
    options: Mapping[str, str | None]  # of sbatch; they override the defaults
    resubmit: int = 0  # how often the job is submitted again when its time is over
    setup: Path | None = None  # a file of shell lines that run first

    @property
    def file(self) -> Path:
        """The file of the script."""
        return self.folder / f"{self.name}.sh"

    @property
    def log(self) -> str:
        """The file of the job's output, as a pattern of sbatch."""
        return self.options.get("output") or str(self.folder.absolute() / "%j.log")

    def text(self) -> str:
        """Return the content of the script.

        Raises:
            ConfigError: A name, path or option has a control character, such as a line feed, after which the rest of a
                comment would be a command; or quotes in a value with spaces, which sbatch cannot read.
        """
        defaults = {
            "job-name": f"vlagents-ray-{self.name}",
            "nodes": "1",
            "ntasks-per-node": "1",
            "chdir": os.getcwd(),
            "output": self.log,
            "open-mode": "append",
            **({} if "no-requeue" in self.options else {"requeue": None}),
        }
        words = [
            f"--{option}" if value is None else f"--{option}={_quoted(value)}"
            for option, value in (defaults | dict(self.options)).items()
        ]
        for word in (self.name, str(self.folder), *words):
            if any(ord(sign) < ord(" ") or sign in _LINE_ENDS for sign in word):
                raise ConfigError(f"slurm: got {word[:200]!r}, want no control characters, such as line feeds, in it")
        settings = {
            "python": sys.executable,
            "folder": str(self.folder.absolute()),
            "setup": "" if self.setup is None else str(self.setup.absolute()),
            "resubmit": str(self.resubmit),
            "unfinished": str(UNFINISHED),
        }
        lines = [
            "#!/bin/bash",
            f"# Written by `vlagents-ray slurm {self.name}`; again: sbatch {shlex.quote(str(self.file))}",
            *(f"#SBATCH {word}" for word in words),
            "",
            *(f"{name}={shlex.quote(value)}" for name, value in settings.items()),
            f"arguments=({shlex.join(self.arguments)})",
            "",
        ]
        return "\n".join(lines) + "\n" + BODY.read_text()


def _quoted(value: str) -> str:
    """Quote a value with spaces for a line of #SBATCH."""
    if not any(sign.isspace() for sign in value):
        return value
    if '"' in value:
        raise ConfigError(f"slurm: got the option {value[:200]!r}, want no quotes in a value with spaces")
    return f'"{value}"'
