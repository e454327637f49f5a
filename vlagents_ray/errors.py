"""The errors of vlagents_ray, in one tree.

    VLAgentsError
    ├── InvalidInput (also ValueError)      the request is wrong; sending it again will not help
    │   ├── MalformedMessage (UnsupportedImage), MessageTooLarge
    │   ├── InvalidObservation              MissingCamera, MissingState, NotOffered
    │   ├── UnknownSession, UnknownApp, NotReset, ContractMismatch
    │   ├── InvalidWeights, UnchangedWeights, NotTrainable, WeightsNotStaged
    │   └── Unauthorized, Forbidden
    ├── Overloaded, TooManyRequests         not executed; send it again later
    ├── PolicyFailed                        InvalidAction
    ├── PolicyUnavailable                   NoReplica, ConnectionLost
    ├── DeadlineExceeded (also TimeoutError)
    │   └── OutcomeUnknown
    ├── ConfigError (also ValueError)       UnknownPolicy (UnknownWrapper), UnknownEnv, WeightsLost
    └── EnvFailed, StorageFailed, ClusterLost, MissingDependency (also ImportError)

`code` is stable: by default the name of the class, "unknown_session" of `UnknownSession`. A server
sends it in a problem+json document, with `status` as the HTTP status. A message contains the
expected and the received value, and the cure.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import islice
from typing import ClassVar, Literal

_SHOWN_ITEMS = 8  # maximum number of items of a list or dict that an error shows
_SHOWN_LEVELS = 3  # maximum depth of lists and dicts that an error shows


def shown(value: object, max_characters: int = 80) -> str:
    """Return a text of at most `max_characters` that shows a value from the network in an error
    message.

    The time and memory of this call do not depend on the size of the value, whereas `repr` or `str`
    would first write the whole value.
    """
    text = _shown(value, max_characters, _SHOWN_LEVELS)
    return text if len(text) <= max_characters else f"{text[: max_characters - 1]}…"


def _shown(value: object, max_characters: int, levels: int) -> str:
    if isinstance(value, str | bytes | bytearray):
        return repr(value[:max_characters]) + ("…" if len(value) > max_characters else "")

    is_short_number = isinstance(value, bool | float) or (
        isinstance(value, int) and value.bit_length() <= 128
    )
    if value is None or is_short_number:
        return repr(value)

    if not isinstance(value, dict | list | tuple | set | frozenset):
        shape = getattr(value, "shape", None)
        return type(value).__name__ + ("" if shape is None else f" of shape {shape}")

    items = []
    for item in islice(value, _SHOWN_ITEMS if levels else 0):
        if isinstance(value, dict):
            key = _shown(item, max_characters, 0)
            items.append(f"{key}: {_shown(value[item], max_characters, levels - 1)}")
        else:
            items.append(_shown(item, max_characters, levels - 1))
    if len(value) > len(items):
        items.append("…")

    text = ", ".join(items)
    if isinstance(value, list):
        return f"[{text}]"
    if isinstance(value, tuple):
        return f"({text})"
    return f"{{{text}}}"


def printable(text: str) -> str:
    """Return a text from another party without characters that control a terminal or forge a line
    of a log.

    Control and format characters, such as escape sequences, become "�". Line feeds and tabs stay,
    but all lines after the first are indented, so that none can be mistaken for a log record.
    """
    if text.isprintable():
        return text
    first_line, *further_lines = map(_printable_line, text.splitlines())
    indented = [line if line.startswith((" ", "\t")) else f"  {line}" for line in further_lines]
    return "\n".join([first_line, *indented])


def _printable_line(line: str) -> str:
    characters = (char if char.isprintable() or char == "\t" else "�" for char in line)
    return "".join(characters)


class VLAgentsError(Exception):
    """The base class of all errors that this package raises on purpose."""

    code: ClassVar[str] = "internal"
    status: ClassVar[int] = 500

    def __str__(self) -> str:
        """Return the message without control characters, since a server or a client may have sent
        parts of the message.
        """
        return printable(super().__str__())


class InvalidInput(VLAgentsError, ValueError):
    """The request or argument is wrong; sending it again will not help."""

    status = 400


class MalformedMessage(InvalidInput):
    """The bytes cannot be decoded: they are truncated, not JSON, not an image, or have an
    unknown key.
    """

    code = "malformed"


class UnsupportedImage(MalformedMessage):
    """An image file has a form that costs too much to decode: a JPEG that is not baseline, or a
    PNG that is interlaced or does not have 8 bits.
    """

    code = "unsupported_image"
    status = 415


class MessageTooLarge(InvalidInput):
    """A body, an image, a number of cameras or a depth of nesting exceeds the server's limit."""

    code = "too_large"
    status = 413


class InvalidObservation(InvalidInput):
    """An observation has a wrong shape, type or value (e.g. NaN), or lacks what the policy's
    contract names.
    """

    status = 422


class MissingCamera(InvalidObservation):
    """The policy's contract names a camera that the observation lacks."""

    def __init__(self, name: str, have: Iterable[str] = ()) -> None:
        super().__init__(
            f"camera {name!r} is missing: got {sorted(have)}; send it, or rename one of yours to "
            f"{name!r}"
        )


class MissingState(InvalidObservation):
    """The policy's contract names a part of the proprioception that the observation lacks."""

    def __init__(self, name: str, have: Iterable[str] = ()) -> None:
        super().__init__(
            f"state {name!r} is missing: got {sorted(have)}; send it, or rename one of yours to "
            f"{name!r}"
        )


class NotOffered(InvalidObservation):
    """The observation's `info["want"]` contains a name that the policy's contract does not list
    under `behaviour`.
    """


class UnknownSession(InvalidInput):
    """The session has expired, was closed, was never reset, or was on a stopped replica."""

    status = 404


class UnknownApp(InvalidInput):
    """The server has no application at this name or path."""

    status = 404


class NotReset(InvalidInput):
    """`act` was called before `reset` in this session."""

    status = 409


class ContractMismatch(InvalidInput):
    """The policy and the robot or env do not fit together; the message lists every difference."""

    status = 409


class InvalidWeights(InvalidInput):
    """Pushed weights have an unknown or missing name, another shape or type, or a value that is
    not finite.
    """

    status = 422


class UnchangedWeights(InvalidInput):
    """Pushed weights equal the policy's present weights: probably the wrong ones were pushed."""

    status = 409


class NotTrainable(InvalidInput):
    """The policy has no parameters that can be replaced while it is served."""

    status = 409


class WeightsNotStaged(InvalidInput):
    """The requested version of the weights was never staged on this replica, or was dropped because
    its learner sent nothing for too long.
    """

    status = 409


class Unauthorized(InvalidInput):
    """The request has no API key, or one that is unknown, revoked or expired."""

    status = 401


class Forbidden(InvalidInput):
    """The API key is valid, but not for this application."""

    status = 403


class TooManyRequests(VLAgentsError):
    """The requests or sessions of an API key exceed its limits; the request was not executed."""

    status = 429
    retry_after_s: float = 1.0  # seconds until the next request is accepted


class Overloaded(VLAgentsError):
    """The replica has no memory left for the request. The request was not executed; send it again
    later.
    """

    status = 503
    retry_after_s: float = 1.0  # seconds to wait before the next attempt


class PolicyFailed(VLAgentsError):
    """The policy raised an exception while it was initialized, reset, or computing an action."""


class InvalidAction(PolicyFailed):
    """The policy returned an action that must not reach a robot: not an array, a wrong shape, or
    NaN.
    """

    def __init__(
        self,
        *args: object,
        cause: Literal["invalid", "limits", "max_step", "dynamics", "leader"] = "invalid",
    ) -> None:
        super().__init__(*args)
        self.cause = cause  # see `vlagents_ray.chunking.fallback.Cause`


class PolicyUnavailable(VLAgentsError):
    """The server is not ready, is restarting, is full, or cannot be reached."""

    code = "unavailable"
    status = 503
    retry_after_s: float = 1.0  # seconds to wait before the next attempt


class NoReplica(PolicyUnavailable):
    """No replica of the application runs: its policy is loading or waits for resources, or the last
    replica died.

    Clients also raise this error if nothing accepts connections at the server's address.
    """


class ConnectionLost(PolicyUnavailable):
    """The connection broke during a request, which may or may not have been executed."""


class DeadlineExceeded(VLAgentsError, TimeoutError):
    """No answer arrived within the caller's deadline; a request that a server answers with this
    was not executed.
    """

    status = 504


class OutcomeUnknown(DeadlineExceeded):
    """The deadline passed during inference: the policy has computed the session's action, or is
    about to.
    """


class ConfigError(VLAgentsError, ValueError):
    """A setting is unknown, missing or contradictory."""

    code = "config"


class WeightsLost(ConfigError):
    """The policy's weights are not the learner's: the policy was restarted after the push, or the
    push did not reach it.
    """


class UnknownPolicy(ConfigError):
    """No policy is registered under this name."""


class UnknownWrapper(UnknownPolicy):
    """No wrapper is registered under this name."""


class UnknownEnv(ConfigError):
    """No environment is registered under this name."""


class EnvFailed(VLAgentsError):
    """A simulator failed or hung: an infrastructure failure, never counted as the policy's."""


class StorageFailed(VLAgentsError):
    """Results or a recording cannot be written, e.g. because the disk is full or the folder is
    read-only; earlier results and episodes are kept.
    """


class ClusterLost(VLAgentsError):
    """The head of the Ray cluster no longer answers, and nothing can run without it."""


class MissingDependency(VLAgentsError, ImportError):
    """An optional package is not installed; the message names the extra or the requirements file
    with it.
    """


def _tree(cls: type[VLAgentsError]) -> Iterable[type[VLAgentsError]]:
    yield cls
    for sub in cls.__subclasses__():
        yield from _tree(sub)


for _error in _tree(VLAgentsError):
    if "code" not in vars(_error):
        _error.code = re.sub(r"\B(?=[A-Z])", "_", _error.__name__).lower()

BY_CODE: dict[str, type[VLAgentsError]] = {cls.code: cls for cls in _tree(VLAgentsError)}


def from_code(code: str, detail: str) -> VLAgentsError:
    """Make the error with a server's `code` and message; an unknown code gives a plain
    `VLAgentsError`.
    """
    cls = BY_CODE.get(code, VLAgentsError)
    error = cls.__new__(cls)
    Exception.__init__(error, detail)
    return error
