"""Checks of a virtual environment: whether it has an interpreter and its packages, and can build
the policy.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, from_code
from vlagents_ray.serve.config.deployment import EnvironmentArgs

_PACKAGES = ("ray", "numpy", "vlagents-ray")
_TIMEOUT_S = 120.0  # imports from a network drive without a cache are slow
OLDEST = (3, 10)
# The program must run in any interpreter, including an old Python. Its last line is the result,
# since imports may print other lines.
_PROBE = """
import json, sys
found = {"python": "%d.%d.%d" % sys.version_info[:3]}
if sys.version_info >= (3, 10):
    from importlib.metadata import PackageNotFoundError, version
    for name in sys.argv[1:]:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            pass
    settings = json.load(sys.stdin)
    if settings["policy"] is not None and found.get("vlagents-ray") == settings["version"]:
        from vlagents_ray.serve.python_env.child_main import examine
        found["policy"] = examine(**settings["policy"])
print()
print("VLA" + json.dumps(found))
"""


@dataclass(frozen=True, slots=True)
class EnvironmentProbe:
    """The results of probing an interpreter."""

    # Versions of "python", "ray", "numpy" and "vlagents-ray", as far as they are installed.
    versions: dict[str, str]
    policy: dict[str, Any] | None = None  # result of `child_main.examine`, if it was requested

    def obstacle_to_replicas(self) -> str | None:
        """Return the reason why a replica of this process's cluster cannot run in the environment;
        None if it can.
        """
        ours = platform.python_version()
        theirs = self.versions["python"]
        if _minor(ours) != _minor(theirs):
            return f"it has Python {theirs}, the cluster has Python {ours}"

        our_ray = importlib.metadata.version("ray")
        their_ray = self.versions.get("ray")
        if their_ray == our_ray:
            return None
        described = f"Ray {their_ray}" if their_ray else "no Ray"
        return f"it has {described}, the cluster has {our_ray}"


def probe(
    python: str, policy: dict[str, Any] | None = None, env_vars: Mapping[str, str] | None = None
) -> EnvironmentProbe:
    """Start the interpreter once, to read the versions of its packages and optionally to build a
    policy.

    Args:
        python: The path of the interpreter.
        policy: The arguments of `child_main.examine`; None builds no policy.
        env_vars: Further environment variables.

    Raises:
        ConfigError: No policy of this server can run in the interpreter.
    """
    if not Path(python).is_file():
        inside = Path(python) / "bin" / "python"
        if inside.is_file():
            cure = f"did you mean {inside}?"
        else:
            cure = f"create one with `{_command_for(python)}`"
        raise ConfigError(
            f"environment.python: expected an interpreter, got {python!r}, which does not exist; "
            f"{cure}"
        )

    version = importlib.metadata.version("vlagents-ray")
    try:
        done = subprocess.run(  # noqa: S603 - the deployment's own interpreter
            [python, "-c", _PROBE, *_PACKAGES],
            # The settings are not a command-line argument, which every user of the machine could
            # read.
            input=json.dumps({"policy": policy, "version": version}),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
            env={**os.environ, **(env_vars or {})},
        )
    except subprocess.TimeoutExpired as error:
        raise ConfigError(
            "environment.python: expected a Python interpreter that runs on this machine, got "
            f"{python!r} (no answer in {_TIMEOUT_S} s; is the machine busy?)"
        ) from error
    except OSError as error:
        raise ConfigError(
            "environment.python: expected a Python interpreter that runs on this machine, got "
            f"{python!r} ({error})"
        ) from error

    last_line = done.stdout.strip().rpartition("\n")[2]
    if not last_line.startswith("VLA{"):
        output = (done.stderr or done.stdout).strip()[-500:] or "no output"
        raise ConfigError(
            f"environment.python: expected a Python interpreter, got {python!r}, which is another "
            f"program, or broken: {output}"
        )

    versions: dict[str, Any] = json.loads(last_line[3:])
    examined = versions.pop("policy", None)
    if _minor(versions["python"]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise ConfigError(
            f"environment.python: expected Python {oldest} or newer, got {python}, which is "
            f"{versions['python']}"
        )
    theirs = versions.get("vlagents-ray")
    if theirs != version:
        installed = f"vlagents-ray {theirs}" if theirs else "no vlagents-ray"
        raise ConfigError(
            f"environment.python: expected {version} as here, got {installed} in {python}; install "
            f"that version there, or create the environment with `{_command_for(python)}`"
        )
    return EnvironmentProbe(versions, examined)


def _command_for(python: str) -> str:
    """Return the command that creates an interpreter's environment: the folder .venv-NAME belongs
    to the requirements NAME.
    """
    folder = Path(python).parent.parent
    prefix, _, name = folder.name.partition(".venv-")
    if prefix or not name:
        return "vlagents-ray venv create REQUIREMENTS"
    return f"vlagents-ray venv create {name} --out {folder}"


def with_process(environment: EnvironmentArgs) -> EnvironmentArgs:
    """Return the settings with a decision instead of the `process` "auto"; raise `ConfigError` if
    the policy cannot run as configured.
    """
    if environment.python is None:
        return environment
    process = _process(environment, probe(environment.python))
    return environment.model_copy(update={"process": process})


def check_policy(
    environment: EnvironmentArgs, policy: str, config: dict[str, Any], wrappers: Sequence[Any] = ()
) -> Contract | None:
    """Build the policy in its environment, as a replica will, and return its contract.

    Returns:
        The contract; None if the policy has none before it is loaded.

    Raises:
        ConfigError: The policy cannot be built there, or the environment is unusable or has no
            interpreter.
    """
    if environment.python is None:
        raise ConfigError("environment: expected an interpreter, got none; set environment.python")

    arguments = {"policy": policy, "config": dict(config), "wrappers": list(wrappers)}
    interpreter = probe(environment.python, arguments, environment.env_vars)
    _process(environment, interpreter)

    examined = interpreter.policy or {}
    if "error" in examined:
        raise from_code(examined["code"], f"in {environment.python}: {examined['error']}")
    contract = examined.get("contract")
    return None if contract is None else Contract.from_json(contract)


def _process(
    environment: EnvironmentArgs, interpreter: EnvironmentProbe
) -> Literal["replica", "child"]:
    """Return where the policy runs; raise `ConfigError` if it cannot run in the configured
    `process`.
    """
    if environment.process == "child":
        return "child"
    obstacle = interpreter.obstacle_to_replicas()
    if obstacle is not None and environment.process == "replica":
        raise ConfigError(
            "environment.process: expected 'child' or 'auto', got 'replica', which cannot run in "
            f"{environment.python}: {obstacle}; use one of them, or create the environment again "
            "with `vlagents-ray venv create`"
        )
    return "child" if obstacle else "replica"


def _minor(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")[:2]))
