"""Every error of vlagents_ray, in one tree.

    VLAgentsError
    ├── InvalidInput (also ValueError)      the caller sent something wrong; retrying will not help
    │   ├── MalformedMessage     400        the bytes are not what they claim to be
    │   ├── MessageTooLarge      413        a body, an image or a nesting over the server's limit
    │   ├── InvalidObservation   422        readable, but the wrong shape, type or value
    │   │   ├── MissingCamera    422
    │   │   └── MissingState     422
    │   ├── UnknownSession       404        expired, closed, or never reset
    │   ├── UnknownApp           404        no such application on this server
    │   ├── UnknownCheckpoint    400        a reset asked for one that the deployment does not offer
    │   ├── NotReset             409        `act` before `reset`
    │   ├── ContractMismatch     409        robot or env and policy do not fit together
    │   ├── Unauthorized         401        no API key, or none that is valid (any more)
    │   └── Forbidden            403        a valid key, but not for this application
    ├── TooManyRequests          429        over the rate or the sessions of the API key
    ├── PolicyFailed             500        the policy raised, or returned an unusable action
    │   ├── InvalidAction        500
    │   └── CheckpointFailed     500        the checkpoint that a reset asked for did not load
    ├── PolicyUnavailable        503        not ready yet, restarting, or full
    │   └── ConnectionLost       503        the connection broke; the request may have been executed
    ├── DeadlineExceeded         504        no answer in time (also TimeoutError)
    ├── ConfigError (also ValueError)       a setting is unknown, missing or contradictory
    │   ├── UnknownPolicy
    │   └── UnknownEnv
    ├── EnvFailed                           a simulator broke: an infrastructure failure, never a policy's
    ├── ClusterLost                         the head of the Ray cluster does not answer any more
    └── MissingDependency (also ImportError)

`code` is stable and is what travels in a problem+json document; `status` is the HTTP status that
carries it. Messages say what was got, what was wanted, and the cure.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar


class VLAgentsError(Exception):
    """Base of all errors raised on purpose by this package."""

    code: ClassVar[str] = "internal"
    status: ClassVar[int] = 500


class InvalidInput(VLAgentsError, ValueError):
    """What was handed in is wrong; sending it again will not help."""

    code = "invalid_input"
    status = 400


class MalformedMessage(InvalidInput):
    """The bytes are not what they claim to be: truncated, not JSON, not an image, unknown key."""

    code = "malformed"


class MessageTooLarge(InvalidInput):
    """A body, an image, a camera count or a nesting over the server's limit."""

    code = "too_large"
    status = 413


class InvalidObservation(InvalidInput):
    """Readable, but the wrong shape, type or value (NaN) for this policy."""

    code = "invalid_observation"
    status = 422


class MissingCamera(InvalidObservation):
    """The policy's contract names a camera that the observation lacks."""

    code = "missing_camera"

    def __init__(self, name: str, have: Iterable[str] = ()) -> None:
        super().__init__(f"camera {name!r} is missing: got {sorted(have)}; send it, or rename one of yours to {name!r}")


class MissingState(InvalidObservation):
    """The policy's contract names a part of the proprioception that the observation lacks."""

    code = "missing_state"

    def __init__(self, name: str, have: Iterable[str] = ()) -> None:
        super().__init__(f"state {name!r} is missing: got {sorted(have)}; send it, or rename one of yours to {name!r}")


class UnknownSession(InvalidInput):
    """The session expired, was closed, lived on a replica that is gone, or was never reset."""

    code = "unknown_session"
    status = 404


class UnknownApp(InvalidInput):
    """No such application (or path) on this server."""

    code = "unknown_app"
    status = 404


class UnknownCheckpoint(InvalidInput):
    """A reset asked for a checkpoint that the deployment does not offer; the message lists what it does."""

    code = "unknown_checkpoint"


class NotReset(InvalidInput):
    """`act` was called before `reset` in this session."""

    code = "not_reset"
    status = 409


class ContractMismatch(InvalidInput):
    """Robot or env and policy do not fit together; the message lists every difference."""

    code = "contract_mismatch"
    status = 409


class Unauthorized(InvalidInput):
    """The request brings no API key, or one that is unknown, revoked or expired."""

    code = "unauthorized"
    status = 401


class Forbidden(InvalidInput):
    """The API key is valid, but not for this application."""

    code = "forbidden"
    status = 403


class TooManyRequests(VLAgentsError):
    """The API key's requests come faster, or hold more sessions, than it allows; nothing was executed."""

    code = "too_many_requests"
    status = 429
    retry_after_s: float = 1.0  # seconds after which the next request would be let in


class PolicyFailed(VLAgentsError):
    """The policy raised while it was initialized, reset or asked for an action."""

    code = "policy_failed"


class InvalidAction(PolicyFailed):
    """The policy returned something that must not reach a robot: wrong shape, NaN, not an array."""

    code = "invalid_action"


class CheckpointFailed(PolicyFailed):
    """The checkpoint that a reset asked for did not load; others go on, and the next reset has it tried again."""

    code = "checkpoint_failed"


class PolicyUnavailable(VLAgentsError):
    """The server is not ready, is restarting, is full, or cannot be reached."""

    code = "unavailable"
    status = 503


class ConnectionLost(PolicyUnavailable):
    """The connection broke during a request, which may or may not have been executed."""

    code = "connection_lost"


class DeadlineExceeded(VLAgentsError, TimeoutError):
    """No answer within the caller's deadline; the request is dropped if it has not started."""

    code = "deadline_exceeded"
    status = 504


class ConfigError(VLAgentsError, ValueError):
    """A setting is unknown, missing or contradictory."""

    code = "config"


class UnknownPolicy(ConfigError):
    """No policy is registered under this name."""

    code = "unknown_policy"


class UnknownEnv(ConfigError):
    """No environment is registered under this name."""

    code = "unknown_env"


class EnvFailed(VLAgentsError):
    """A simulator broke or hung: an infrastructure failure, never counted against the policy."""

    code = "env_failed"


class ClusterLost(VLAgentsError):
    """The head of the Ray cluster does not answer any more, and nothing goes on without it."""

    code = "cluster_lost"


class MissingDependency(VLAgentsError, ImportError):
    """An optional package is not installed; the message names the extra that brings it."""

    code = "missing_dependency"


def _tree(cls: type[VLAgentsError]) -> Iterable[type[VLAgentsError]]:
    yield cls
    for sub in cls.__subclasses__():
        yield from _tree(sub)


BY_CODE: dict[str, type[VLAgentsError]] = {cls.code: cls for cls in _tree(VLAgentsError)}


def from_code(code: str, detail: str) -> VLAgentsError:
    """The error that a server meant by `code`; an unknown code gives a plain `VLAgentsError`."""
    cls = BY_CODE.get(code, VLAgentsError)
    error = cls.__new__(cls)
    Exception.__init__(error, detail)
    return error
