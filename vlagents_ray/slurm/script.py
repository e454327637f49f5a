"""The script of a job: sbatch's options, what this job is, and `job.sh`, which is the same for all."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

BODY = Path(__file__).with_name("job.sh")
UNFINISHED = 75  # exit status of `vlagents-ray eval` that ran out of time: try again (EX_TEMPFAIL of sysexits.h)


@dataclass(frozen=True, slots=True)
class Script:
    """A job. Its texts may hold %a, the number of a task of `--array`."""

    name: str
    folder: Path  # of the script, and of the job's logs; on a file system that all nodes share
    arguments: Sequence[str]  # of `vlagents_ray.slurm.head`
    options: Mapping[str, str | None]  # of sbatch, over those that are set here
    resubmit: int = 0  # times, when it ran out of time
    setup: Path | None = None  # shell lines that come before everything else

    @property
    def file(self) -> Path:
        """Where it is written to."""
        return self.folder / f"{self.name}.sh"

    @property
    def log(self) -> str:
        """Where sbatch is to write the job's output, by its pattern."""
        return self.options.get("output") or str(self.folder.absolute() / "%j.log")

    def text(self) -> str:
        """As sbatch takes it."""
        usual = {
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
            for option, value in (usual | dict(self.options)).items()
        ]
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
    """For a line of #SBATCH, where double quotes keep a value together."""
    return f'"{value}"' if any(sign.isspace() for sign in value) else value
