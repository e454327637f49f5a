"""Why an attempt at an episode came to nothing, and who is to blame."""

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
    InvalidInput,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    MissingDependency,
    MissingState,
    NotReset,
    PolicyFailed,
    PolicyUnavailable,
    UnknownApp,
    UnknownCheckpoint,
    UnknownSession,
    VLAgentsError,
)

Cause = Literal["user", "policy", "worker"]


@dataclass(frozen=True, slots=True)
class Failure:
    """Why an attempt came to nothing, and who can do something about it.

    "user": a mistake in the settings, which stops the evaluation; "policy": the way to the policy;
    "worker": the simulator or its process, which is then replaced.
    """

    cause: Cause
    code: str  # of `vlagents_ray.errors`
    message: str
    traceback: str = ""
    log: str = ""  # the last of what the worker wrote, if it broke


_USER = (
    ConfigError,
    ContractMismatch,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    MissingDependency,
    MissingState,
    PolicyFailed,
    UnknownApp,
    UnknownCheckpoint,
)
_POLICY = (PolicyUnavailable, DeadlineExceeded, UnknownSession, NotReset)
_WORKER = (EnvFailed, InvalidInput)  # InvalidInput left here: the env gave an observation nobody can use


def explain(error: VLAgentsError) -> Failure:
    """Who is to blame for `error`. A `PolicyFailed` outside an episode is a policy that cannot start."""
    cause: Cause
    if isinstance(error, _USER):
        cause = "user"
    elif isinstance(error, _POLICY) or not isinstance(error, _WORKER):
        cause = "policy"
    else:
        cause = "worker"
    message = f"{error} (worker's Python: {sys.executable})" if isinstance(error, MissingDependency) else str(error)
    return Failure(cause, error.code, message, "".join(traceback.format_exception(error)))
