"""Joining a Ray cluster that runs already."""

from __future__ import annotations

import re

import pytest
import ray

from vlagents_ray import ConfigError
from vlagents_ray.joining import joined


@pytest.mark.parametrize(
    "error", [ConnectionError("nobody there"), ray.exceptions.AuthenticationError("another token")], ids=repr
)
def test_a_cluster_that_cannot_be_joined_is_a_wrong_setting(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ConfigError, match=re.escape(f"Ray cluster at 'auto': {error}")), joined("auto"):
        pytest.fail("joined it")


def test_the_cluster_that_the_environment_names_is_named_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise ConnectionError("nobody there")

    monkeypatch.setattr(ray, "init", refuse)
    monkeypatch.setenv("RAY_ADDRESS", "198.18.0.9:6379")
    with pytest.raises(ConfigError, match=r"Ray cluster at '198\.18\.0\.9:6379'"), joined():
        pytest.fail("joined it")
