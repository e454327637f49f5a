"""LeRobot's EnvHub: environments that a repository of the Hugging Face hub makes, `hub/USER/REPO@COMMIT`.

Such a repository has a Python file, `env.py`, with `make_env(n_envs, use_async_envs)`, which returns a Gymnasium
VectorEnv, a mapping {suite: {task id: VectorEnv}}, or one `gymnasium.Env`: `make_env` in LeRobot's envs/factory.py.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.envs.gymnasium.env import Gymnasium
from vlagents_ray.envs.gymnasium.vector import VectorRows
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, UnknownEnv
from vlagents_ray.registry import require

_NAME = re.compile(r"(?P<repository>[\w.-]+/[\w.-]+)(?:@(?P<revision>[\w./-]+))?(?::(?P<file>[\w./-]+))?")
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True, slots=True)
class HubFile:
    """A Python file of a repository at one commit."""

    repository: str  # "USER/REPO"
    commit: str  # 40 hex digits
    path: str  # in the repository

    @classmethod
    def parse(cls, task: str | None) -> HubFile:
        """Read `USER/REPO@COMMIT` or `USER/REPO@COMMIT:FILE`; raises `UnknownEnv` for anything else."""
        match = _NAME.fullmatch(task or "")
        if match is None:
            raise UnknownEnv(f"hub: got {task!r}, want USER/REPO@COMMIT or USER/REPO@COMMIT:FILE")
        revision, path = match["revision"] or "", match["file"] or "env.py"
        if not _COMMIT.fullmatch(revision):
            raise UnknownEnv(
                f"hub/{task}: got the revision {revision or 'none'!r}, want a commit, 40 hex digits, as a branch or "
                f"tag can change; the repository's page lists its commits"
            )
        if ".." in Path(path).parts or Path(path).is_absolute() or not path.endswith(".py"):
            raise UnknownEnv(
                f"hub/{task}: got the file {path!r}, want a Python file of the repository, as in envs/a.py"
            )
        return cls(match["repository"], revision, path)


class EnvHub(Gymnasium):
    """An environment whose code is in a repository of the hub; options and contract are those of `Gymnasium`.

    The code runs with all rights of this process, and so wants `trust_remote_code`.
    """

    suite = "hub"

    def __init__(
        self,
        task: str | None = None,
        *,
        trust_remote_code: bool = False,
        part: str | None = None,
        use_async_envs: bool = False,
        cameras: Mapping[str, str] | None = None,
        state: Mapping[str, str] | None = None,
        gripper: str | None = None,
        gripper_range: tuple[float, float] = (0.0, 1.0),
        success: str | None = None,
        instruction: str | None = None,
        control_hz: float | None = None,
        unit_actions: bool = False,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Run the repository's code, and check one observation of the environment.

        Args:
            task: USER/REPO@COMMIT, or USER/REPO@COMMIT:FILE for another file than env.py.
            trust_remote_code: Run the repository's code; whoever wrote it can do on this machine whatever this process
                can. The commit says which code.
            part: One of several that the repository makes, SUITE/ID; None if it makes one.
            use_async_envs: As the repository's `make_env` takes it: usually a process for each row.
            cameras: As for `Gymnasium`, and so are the others.
            instruction: The task in words; None is what the environment states as `task_description` or `task`.
            max_steps: The step limit; None is the environment's own.

        Raises:
            UnknownEnv: The name is not one of a file at a commit, or the repository does not have it.
            ConfigError: The code is not trusted, it makes no environment, or an option does not fit it.
            MissingDependency: A package that the code imports is not installed.
            EnvFailed: The code failed.
        """
        self._file = HubFile.parse(task)
        _require_trust(task, trust_remote_code)
        self._part, self._asynchronous = part, use_async_envs
        super().__init__(
            task,
            cameras=cameras,
            state=state,
            gripper=gripper,
            gripper_range=gripper_range,
            success=success,
            instruction=instruction,
            control_hz=control_hz,
            unit_actions=unit_actions,
            width=width,
            height=height,
            max_steps=max_steps,
            record_size=record_size,
        )

    @classmethod
    def require_task(cls, task: str | None) -> None:
        HubFile.parse(task)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract | None:
        """Return None; raises `ConfigError` before anything starts if the code is not trusted."""
        _require_trust(arguments["task"], arguments["trust_remote_code"])
        return None

    @classmethod
    def missing(cls) -> str | None:
        for module in ("gymnasium", "huggingface_hub"):
            if importlib.util.find_spec(module) is None:
                return f"{module} is not installed; pip install 'vlagents-ray[hub]'"
        return None

    def describe(self) -> dict[str, Any]:
        file = {"repository": self._file.repository, "commit": self._file.commit, "file": self._file.path}
        return {**super().describe(), **file, "part": self._part}

    @classmethod
    def _makes_vectors(cls, options: Mapping[str, Any]) -> bool:  # noqa: ARG003 - overrides one that looks at them
        return True

    def _make(self, max_steps: int | None) -> VectorRows:
        make = getattr(_imported(self._file, self._name), "make_env", None)
        if make is None:
            raise ConfigError(f"{self._name}: its file has no make_env(n_envs, use_async_envs); is it an EnvHub's?")
        try:
            made = make(n_envs=self.rows, use_async_envs=self._asynchronous)
        except Exception as error:
            raise EnvFailed(f"{self._name}: make_env raised {type(error).__name__}: {error}") from error
        vector = self._vector(made)
        if vector.num_envs != self.rows:
            got = vector.num_envs
            vector.close()
            raise ConfigError(f"{self._name}: make_env(n_envs={self.rows}) made {got}; set num_envs to {got}")
        return VectorRows(self._name, vector)

    def _vector(self, made: Any) -> Any:
        """Return the VectorEnv of what `make_env` returned, and close the others."""
        gymnasium = require("gymnasium")
        if isinstance(made, gymnasium.Env):
            mode = gymnasium.vector.AutoresetMode.DISABLED
            return gymnasium.vector.SyncVectorEnv([lambda: made], autoreset_mode=mode)
        if isinstance(made, gymnasium.vector.VectorEnv):
            return made
        parts = {
            f"{suite}/{number}": vector
            for suite, numbered in (made.items() if isinstance(made, Mapping) else ())
            for number, vector in (numbered.items() if isinstance(numbered, Mapping) else ())
        }
        wanted = next(iter(parts)) if len(parts) == 1 and self._part is None else self._part
        for name, vector in parts.items():
            if name != wanted:
                vector.close()
        if not parts:
            raise ConfigError(
                f"{self._name}: make_env returned {type(made).__name__}, want a gymnasium.vector.VectorEnv, a "
                f"gymnasium.Env, or {{suite: {{id: VectorEnv}}}}"
            )
        if wanted not in parts:
            raise ConfigError(f"{self._name}: got part={self._part!r}, want one of {sorted(parts)}")
        return parts[wanted]


def _require_trust(task: str | None, trusted: bool) -> None:
    if not trusted:
        raise ConfigError(
            f"hub/{task}: is Python code of somebody else's, which would run with all your rights; read it, and if you "
            f"trust it at this commit, set trust_remote_code: true in env_options"
        )


def _imported(file: HubFile, name: str) -> Any:
    """Download the file, unless it is in the hub's cache, and import it."""
    hub = require("huggingface_hub", extra="hub")
    try:
        path = hub.hf_hub_download(file.repository, file.path, revision=file.commit)
    except Exception as error:  # of many classes: no such repository, no access, no network, offline mode
        raise UnknownEnv(
            f"{name}: neither in the hub's cache nor to be had ({type(error).__name__}); check repository, commit and "
            f"file, the network and your token"
        ) from error
    module_name = re.sub(r"\W", "_", name)
    if module_name in sys.modules:
        return sys.modules[module_name]
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"{name}: {path} cannot be imported; want a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # where dataclasses and pickle look their classes up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module_name]
        if isinstance(error, ModuleNotFoundError):
            raise MissingDependency(f"{name}: its code imports {error.name!r}, which is not installed") from error
        raise EnvFailed(f"{name}: its code raised {type(error).__name__}: {error}") from error
    return module
