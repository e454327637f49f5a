from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.config import canonical, fingerprint


def test_an_unknown_setting_is_refused(config: Callable[..., EvalConfig]) -> None:
    with pytest.raises(ValidationError, match="wokers"):
        config(wokers=3)


def test_an_env_is_named_once(config: Callable[..., EvalConfig]) -> None:
    with pytest.raises(ValidationError, match="named twice"):
        config(envs=["a", "b", "a"])


def test_an_env_may_have_options_of_its_own(config: Callable[..., EvalConfig]) -> None:
    settings = config(envs=["a", "b/c"], env_options={"width": 1, "height": 2, "b/c": {"width": 3, "wrist": True}})
    assert settings.options_for("a") == {"width": 1, "height": 2}
    assert settings.options_for("b/c") == {"width": 3, "height": 2, "wrist": True}


def test_options_of_an_env_are_a_mapping(config: Callable[..., EvalConfig]) -> None:
    with pytest.raises(ValidationError, match="want a mapping"):
        config(envs=["a"], env_options={"a": 3})


def test_a_fingerprint_ignores_order_and_nothing_else() -> None:
    assert fingerprint({"a": 1, "b": [1, 2]}) == fingerprint({"b": [1, 2], "a": 1})
    assert fingerprint({"a": 1, "b": [1, 2]}) != fingerprint({"a": 1, "b": [2, 1]})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_json_lacks_are_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="Out of range"):
        canonical({"a": value})


def test_what_is_set_episode_by_episode_is_no_option(config: Callable[..., EvalConfig]) -> None:
    with pytest.raises(ValidationError, match=r"\['seed'\] are set episode by episode"):
        config(policy_options={"seed": 3, "checkpoint_step": 20})
