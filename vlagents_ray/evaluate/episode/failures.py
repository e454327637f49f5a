"""The attribution of errors to simulator, policy or settings, and checks of an environment's
outputs.

Without these checks, a wrong output would cause an error later, in the encoder or in the policy,
and would be attributed to them.
"""

from __future__ import annotations

import math
import re
import sys
import traceback
from bdb import BdbQuit
from collections.abc import Mapping
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any, Literal, NamedTuple

import numpy as np

from vlagents_ray import errors
from vlagents_ray.contract import Contract
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.interface import Obs
from vlagents_ray.validation import check_observation

Cause = Literal["user", "policy", "worker", "operator"]
# Ends of messages about the policy's server: the likely causes, and how to find the responsible
# line of the policy.
_CURES: dict[type[errors.VLAgentsError], str] = {
    errors.ConnectionLost: (
        "; or run the policy in this process with --workers 0, to find the line that ends the "
        "server"
    ),
    errors.DeadlineExceeded: (
        "; in an evaluation, timeout_s is policy_timeout_s; or run the policy in this process with "
        "--workers 0, to find the line that hangs"
    ),
}
# Errors that the user can correct.
_USER = (
    errors.ConfigError,
    errors.ContractMismatch,
    errors.MalformedMessage,
    errors.MessageTooLarge,
    errors.MissingCamera,
    errors.MissingDependency,
    errors.MissingState,
    errors.NotOffered,
    errors.PolicyFailed,
    errors.UnknownApp,
)
# Errors of the simulator; an `InvalidInput` reports an unusable observation of the environment.
_WORKER = (errors.EnvFailed, errors.InvalidInput)
# Subclasses of `InvalidInput` that are errors of the connection to the policy.
_POLICY = (errors.UnknownSession, errors.NotReset)
# Errors of an environment that are not a breakdown: they report wrong settings, a violation of its
# contract, a missing package, or a rejected action.
_FROM_ENV = (
    errors.ConfigError,
    errors.ContractMismatch,
    errors.EnvFailed,
    errors.InvalidAction,
    errors.MissingDependency,
)


@dataclass(frozen=True, slots=True)
class Failure:
    """The cause of a failed attempt, and the side that can correct it.

    "user": a mistake in the settings, which stops the evaluation; "policy": the connection to the
    policy; "worker": a real robot, or the simulator or its process, which is then replaced;
    "operator": the operator repeats a trial of a real robot.
    """

    cause: Cause
    code: str  # the `code` of a class in `vlagents_ray.errors`
    message: str
    traceback: str = ""
    log: str = ""  # the end of the worker's log, if the worker broke
    # If the simulation diverged: the result that applies if the policy is the cause.
    diverged: EpisodeResult | None = None
    names_no_episode: bool = False  # whether another episode in the same simulator may be the cause


def explain(error: errors.VLAgentsError) -> Failure:
    """Return the failure for `error`. A `PolicyFailed` outside an episode means that the policy
    cannot start.
    """
    cause: Cause = "policy"
    if isinstance(error, _USER):
        cause = "user"
    elif isinstance(error, _WORKER) and not isinstance(error, _POLICY):
        cause = "worker"

    message = str(error)
    if isinstance(error, errors.MissingDependency):
        message += f" (worker's Python: {sys.executable})"
    if cause == "policy":
        cures = (cure for kind, cure in _CURES.items() if isinstance(error, kind))
        message += next(cures, "")
    return Failure(cause, error.code, message, "".join(traceback.format_exception(error)))


def explain_batch(error: errors.VLAgentsError, episodes: int) -> Failure:
    """Return the failure for an `error` that ended `episodes` episodes in one simulator.

    If the simulator rejected an action or its simulation diverged, one of the episodes is the
    cause, but it is unknown which.
    """
    if episodes > 1 and (isinstance(error, errors.InvalidAction) or raised_by_divergence(error)):
        return replace(explain(error), cause="worker", names_no_episode=True)
    return explain(error)


class _Side:
    """A context that attributes exceptions to one side, simulator or policy; it has no state, and
    can be entered repeatedly.
    """

    __slots__ = ("_phase",)

    def __init__(self, phase: str) -> None:
        self._phase = phase

    def __enter__(self) -> None:
        pass


class env_side(_Side):  # noqa: N801 - a context manager
    """Convert any exception of a simulator to `EnvFailed`, except for wrong settings and rejected
    actions.
    """

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        _raise_if_quit(error)
        # During a reset, only the environment itself can have chosen the rejected action.
        refuses_own = self._phase == "reset" and isinstance(error, errors.InvalidAction)
        passes = isinstance(error, _FROM_ENV) and not refuses_own
        # ManiSkill raises SystemExit when an asset is missing.
        if isinstance(error, Exception | SystemExit) and not passes:
            raise errors.EnvFailed(f"env {self._phase}: {type(error).__name__}: {error}") from error


class policy_side(_Side):  # noqa: N801 - a context manager
    """Convert any exception of a policy to `PolicyFailed`, except for the errors of this
    package.
    """

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        _raise_if_quit(error)
        if isinstance(error, Exception) and not isinstance(error, errors.VLAgentsError):
            raise errors.PolicyFailed(
                f"policy {self._phase}: {type(error).__name__}: {error}"
            ) from error


def _raise_if_quit(error: BaseException | None) -> None:
    """Raise `KeyboardInterrupt` if the user has quit a debugger, which is not an error of either
    side.
    """
    if isinstance(error, BdbQuit):
        raise KeyboardInterrupt from error


class EnvStep(NamedTuple):
    """The outputs of one step of an environment."""

    obs: Obs
    reward: float
    terminated: bool
    truncated: bool
    success: bool


def is_finite(obs: object, reward: object) -> bool:
    """Return whether the numbers in a step's outputs are finite; a diverged simulation returns
    numbers that are not.
    """
    values: list[Any] = [reward]
    if isinstance(obs, Obs):
        values += [*obs.state.values(), 0 if obs.gripper is None else obs.gripper]
    arrays = [np.asarray(value) for value in values]
    return all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f")


# Words in the messages of simulators that raise an exception instead of returning a NaN: MuJoCo's
# "Nan, Inf or huge value in QACC. The simulation is unstable", dm_control's "Physics state is
# invalid", SciPy's "array must not contain infs or NaNs".
_DIVERGENCE = re.compile(
    r"\b(nans?|infs?|(non-?|not )finite|diverge[ds]?|divergence|unstable|physics state is "
    r"invalid)\b",
    re.IGNORECASE,
)


def raised_by_divergence(error: errors.VLAgentsError) -> bool:
    """Return whether a simulator raised `error` because its simulation diverged, judging from the
    error's type and message.
    """
    if not isinstance(error, errors.EnvFailed):
        return False
    of_numbers = isinstance(
        error.__cause__, FloatingPointError | OverflowError | np.linalg.LinAlgError
    )
    return of_numbers or _DIVERGENCE.search(str(error)) is not None


def checked_instruction(instruction: object, where: str) -> str:
    """Return `instruction`, or raise `EnvFailed` if it is not text."""
    if not isinstance(instruction, str):
        raise errors.EnvFailed(
            f"env {where}: expected the instruction as a str (empty if the task has none), got "
            f"{instruction!r}"
        )
    return instruction


def checked_step(
    obs: object,
    reward: object,
    terminated: object,
    truncated: object,
    info: object,
    contract: Contract,
    *,
    images: bool = True,
) -> EnvStep:
    """Check the outputs of `EvalEnv.step` and return them; without `images`, the environment may
    have left out images.

    Raises:
        EnvFailed: The observation does not fit the environment's own contract, the reward is not a
            finite number, or a flag is not a bool.
    """
    if not isinstance(info, (dict, Mapping)) or "success" not in info:
        description = f"{type(info).__name__} as info"
        if isinstance(info, Mapping):
            description = f"info with {sorted(map(str, info))}"
        raise errors.EnvFailed(
            f"env step: expected an info with 'success', got {description}; see EvalEnv.step"
        )

    return EnvStep(
        checked_obs(obs, contract, "step", images=images),
        _number(reward),
        _truth(terminated, "terminated"),
        _truth(truncated, "truncated"),
        _truth(info["success"], "info['success']"),
    )


def checked_obs(obs: object, contract: Contract, where: str, *, images: bool = True) -> Obs:
    """Check an observation against the environment's own `contract`, and return it.

    Raises:
        ContractMismatch: The first observation does not fit, so every episode would fail in the
            same way.
        EnvFailed: A number is not finite, or a later observation does not fit.
    """
    error_class: type[errors.VLAgentsError] = errors.EnvFailed
    if where == "reset":
        error_class = errors.ContractMismatch

    if not isinstance(obs, Obs):
        raise error_class(
            f"env {where}: expected an Obs as the observation, got {type(obs).__name__}"
        )
    for name, value in (("cameras", obs.cameras), ("state", obs.state), ("info", obs.info)):
        if not isinstance(value, (dict, Mapping)):  # testing for `dict` first is faster
            raise error_class(
                f"env {where}: expected a dict as the observation's {name}, got "
                f"{type(value).__name__}"
            )

    try:
        check_observation(obs, contract if images else replace(contract, cameras=None))
    except errors.InvalidObservation as error:
        if not is_finite(obs, 0.0):
            error_class = errors.EnvFailed
        raise error_class(
            f"env {where}: the observation contradicts the env's contract: {error}"
        ) from error
    except TypeError as error:  # e.g. the gripper is not a number
        raise error_class(
            f"env {where}: expected a gripper in [0, 1], got {obs.gripper!r}"
        ) from error
    return obs


def _number(reward: Any) -> float:
    try:
        # The reward of a diverged simulation may be NaN, which neither the results file nor JSON
        # can represent.
        if math.isfinite(reward):
            return float(reward)
    except (TypeError, ValueError):
        pass
    raise errors.EnvFailed(f"env step: expected a finite number as the reward, got {reward!r}")


def _truth(value: object, name: str) -> bool:
    """Return `value` as a bool; 0 and 1 are accepted, but text raises an error, since "no" would be
    true.
    """
    if value is True or value is False:  # the usual case
        return value
    if isinstance(value, bool | np.bool_) or (isinstance(value, Real) and value in (0, 1)):
        return bool(value)
    raise errors.EnvFailed(f"env step: expected {name} to be a bool, got {value!r}")
