"""The attribution of an exception: to the simulator, the policy, or the settings."""

from __future__ import annotations

import sys
import traceback
from dataclasses import dataclass
from typing import Literal

from vlagents_ray.errors import (
    ConfigError,
    ContractMismatch,
    DeadlineExceeded,
    EnvFailed,
    InvalidAction,
    InvalidInput,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    MissingDependency,
    MissingState,
    NotOffered,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownApp,
    UnknownCheckpoint,
    UnknownSession,
    VLAgentsError,
)

Cause = Literal["user", "policy", "worker", "operator"]


@dataclass(frozen=True, slots=True)
class Failure:
    """Why an attempt failed, and which side can correct it.

    "user": a mistake in the settings, which stops the evaluation; "policy": the connection to the policy; "worker": the
    simulator or its process, which is then replaced, or a real robot; "operator": a person had a trial of a real robot
    repeated.
    """

    cause: Cause
    code: str  # the code of a class in `vlagents_ray.errors`
    message: str
    traceback: str = ""
    log: str = ""  # the end of the worker's log, if it broke


_USER = (
    ConfigError,
    ContractMismatch,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    MissingDependency,
    MissingState,
    NotOffered,
    PolicyFailed,
    UnknownApp,
    UnknownCheckpoint,
)
_POLICY = (PolicyUnavailable, DeadlineExceeded, UnknownSession, NotReset)
_WORKER = (EnvFailed, InvalidInput)  # InvalidInput here: an unusable observation of the environment


def explain(error: VLAgentsError) -> Failure:
    """Return the failure for `error`. A `PolicyFailed` outside an episode means that the policy cannot start."""
    cause: Cause
    if isinstance(error, _USER):
        cause = "user"
    elif isinstance(error, _POLICY) or not isinstance(error, _WORKER):
        cause = "policy"
    else:
        cause = "worker"
    message = f"{error} (worker's Python: {sys.executable})" if isinstance(error, MissingDependency) else str(error)
    return Failure(cause, error.code, message, "".join(traceback.format_exception(error)))


# By these errors an environment does not say that it broke, but reports its settings, a breach of its contract, a
# missing package, or an action that it refuses.
_FROM_ENV = (ConfigError, ContractMismatch, EnvFailed, InvalidAction, MissingDependency)


class _Side:
    """A context that attributes exceptions to one side; it has no state, and may be entered again."""

    __slots__ = ("_what",)

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        pass


class env_side(_Side):  # noqa: N801 - a context manager
    """Turn any exception of a simulator into `EnvFailed`, except for wrong settings and refused actions."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        # ManiSkill raises SystemExit when an asset is missing.
        if isinstance(error, Exception | SystemExit) and not isinstance(error, _FROM_ENV):
            raise EnvFailed(f"env {self._what}: {type(error).__name__}: {error}") from error


class policy_side(_Side):  # noqa: N801 - a context manager
    """Turn any exception of a policy into `PolicyFailed`; this package's own errors pass."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, Exception) and not isinstance(error, VLAgentsError):
            raise PolicyFailed(f"policy {self._what}: {type(error).__name__}: {error}") from error
