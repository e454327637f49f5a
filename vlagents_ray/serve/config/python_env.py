"""The settings under `environment:` in a deployment file: the Python environment that the policy runs in."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from vlagents_ray.ray_tools.runtime_env import require_no_secrets

_PYTHON = re.compile(r"^# python: (3\.\d+)\s*$", re.MULTILINE)


def python_wanted_by(requirements: Path) -> str | None:
    """Return the Python minor version that a requirements file names in a line `# python: 3.12`; None without one."""
    found = _PYTHON.search(requirements.read_text())
    return None if found is None else found[1]


class EnvironmentArgs(BaseModel):
    """The Python environment of a policy; by default the policy runs in the replica, in the cluster's environment."""

    model_config = ConfigDict(extra="forbid", hide_input_in_errors=True)  # errors are logged

    python: str | None = Field(
        default=None,
        description="interpreter of a virtual environment, on every node the same; a relative path is one from the "
        "working directory",
    )
    process: Literal["auto", "replica", "child"] = Field(
        default="auto",
        description="with `python`: is the replica itself to run there (same Python minor and Ray as the cluster's), "
        "or a child process behind it? auto: the replica where it can",
    )
    requirements: list[str] | None = Field(
        default=None, description="instead of `python`: what Ray installs on each node, once; a list, or a file's path"
    )
    installer: Literal["uv", "pip"] = Field(default="pip", description="of `requirements`")
    env_vars: dict[str, str] = Field(default_factory=dict, description="variables of the policy's process")

    @field_validator("python")
    @classmethod
    def _absolute(cls, python: str | None) -> str | None:
        """Make the path absolute without following links: an environment's interpreter links to that of its creator."""
        return None if python is None else os.path.abspath(Path(python).expanduser())

    @field_validator("requirements", mode="before")
    @classmethod
    def _read(cls, requirements: Any) -> Any:
        if not isinstance(requirements, str):
            return requirements
        file = Path(requirements)
        if not file.is_file():
            raise ValueError(f"no such file: got {requirements!r}, want a requirements file or a list of requirements")
        wanted, ours = python_wanted_by(file), "{}.{}".format(*sys.version_info[:2])
        if wanted not in (None, ours):
            raise ValueError(
                f"{requirements} wants Python {wanted}, and Ray installs requirements for the cluster's, {ours}; make "
                f"an environment, `vlagents-ray env make {requirements}`, and name its Python in `python` instead"
            )
        lines = [line.partition(" #")[0].strip() for line in file.read_text().splitlines()]
        return [line for line in lines if line and not line.startswith("#")]

    @model_validator(mode="after")
    def _one(self) -> EnvironmentArgs:
        if self.python is not None and self.requirements is not None:
            raise ValueError(
                f"python {self.python!r} and requirements exclude each other; keep one, or install the requirements "
                f"into that environment (`vlagents-ray env make`)"
            )
        if self.python is None and self.process != "auto":
            raise ValueError(f"process: got {self.process!r} without `python`; name an interpreter, or leave it out")
        # The check covers a child process, too: Serve shows the deployment, and a child may become a replica.
        require_no_secrets({"env_vars": self.env_vars, "requirements": self.requirements})
        if self.requirements == []:
            raise ValueError("requirements: got none; name some, or leave it out")
        return self

    def runtime_env(self) -> dict[str, Any]:
        """Return Ray's `runtime_env` of the replica; empty if the policy runs in a child process."""
        if self.process == "child":
            return {}
        found: dict[str, Any] = {}
        if self.python is not None:
            found["py_executable"] = self.python
        if self.requirements is not None:
            found[self.installer] = self.requirements
        if self.env_vars:
            found["env_vars"] = self.env_vars
        return found
