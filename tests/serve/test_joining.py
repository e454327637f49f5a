"""Joining a Ray cluster that runs already."""

from __future__ import annotations

import re

import pytest
import ray

from vlagents_ray import ConfigError
from vlagents_ray.serve.cluster import joined


@pytest.mark.parametrize(
    "error", [ConnectionError("nobody there"), ray.exceptions.AuthenticationError("another token")], ids=repr
)
def test_a_cluster_that_cannot_be_joined_is_a_wrong_setting(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_options: object) -> None:
        raise error

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(ConfigError, match=re.escape(f"Ray cluster at 'auto': {error}")), joined("auto"):
        pytest.fail("joined it")
