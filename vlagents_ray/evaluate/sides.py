"""Whose fault an exception is: the simulator's or the policy's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from vlagents_ray.errors import EnvFailed, PolicyFailed, VLAgentsError


@contextmanager
def env_side(what: str) -> Iterator[None]:
    """Anything that a simulator raises becomes `EnvFailed`; this package's own errors pass."""
    try:
        yield
    except VLAgentsError:
        raise
    except (Exception, SystemExit) as error:  # ManiSkill leaves by SystemExit when an asset is missing
        raise EnvFailed(f"env {what}: {type(error).__name__}: {error}") from error


@contextmanager
def policy_side(what: str) -> Iterator[None]:
    """Anything that a policy raises becomes `PolicyFailed`; this package's own errors pass."""
    try:
        yield
    except VLAgentsError:
        raise
    except Exception as error:
        raise PolicyFailed(f"policy {what}: {type(error).__name__}: {error}") from error
