"""Prefixes of π0.5 as LeRobot gives them; conftest.py leaves this file out where LeRobot has
none, as 0.6.1.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.rtc.configuration_rtc import RTCConfig

from benchmarks.checkpoints.lerobot import local_tokenizer
from benchmarks.checkpoints.tokenizer import fast_tokenizer
from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import begun, view
from plugins.vlagents_ray_models.tests.families.lerobot.test_pi import _loaded, _normalised, shrunk  # noqa: F401 - a fixture
from plugins.vlagents_ray_models.tests.families.lerobot.test_upstream import Theirs, draws_of
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER
from vlagents_ray_models.lerobot.samplers import LONGEST_PREFIX

LONGEST = 4


@pytest.fixture(scope="module")
def trained(shrunk: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A checkpoint of π0.5 whose config says that it was trained with prefixes."""
    folder = tmp_path_factory.mktemp("prefixed")
    chunk = {"chunk_size": tiny.CHUNK, "n_action_steps": tiny.EXECUTED, "num_inference_steps": 3}
    (folder / "pi05").mkdir()
    fast_tokenizer().save_pretrained(folder / "tokenizer")
    with local_tokenizer("pi05", folder / "tokenizer"):
        sizes = {"dtype": "float32", "image_resolution": (56, 56), LONGEST_PREFIX: LONGEST}
        tiny.write(folder / "pi05", tiny.config_of("pi05", **sizes, **chunk))
    return folder / "pi05"


@pytest.mark.parametrize("mode", ["trained", "guided"])
@pytest.mark.parametrize("delay", [1, LONGEST])
def test_given_prefixes_are_theirs(delay: int, mode: str, trained: Path) -> None:
    chosen = {} if mode == "trained" else {"overrides": {"rtc_config": {"mode": mode}}}
    policy, theirs = _loaded(trained, execute=tiny.CHUNK, **chosen), Theirs(trained)
    plan = np.random.default_rng(5).uniform(-1, 1, (6, tiny.ACTION)).astype(np.float32)
    theirs.policy.config.rtc_config = RTCConfig(enabled=True, mode=mode)
    theirs.policy.init_rtc_processor()
    left = _normalised(plan, theirs.policy.config.normalization_mapping["ACTION"].name)
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    given: dict[str, Any] = {
        "noise": torch.from_numpy(draws_of(policy).standard_normal(shape, dtype=np.float32)),
        "prev_chunk_left_over": torch.from_numpy(left)[None],
        "inference_delay": delay,
    }
    wanted = (
        theirs.after(theirs.policy.predict_action_chunk(theirs.preprocess(view()), **given))[0]
        .detach()
        .numpy()
    )
    act = begun(policy).act(view(**{LEFTOVER: plan, DELAY: delay}))
    ours = act.action
    assert act.info.get(GIVEN) == (delay if mode == "trained" else None)
    np.testing.assert_allclose(ours, wanted, atol=1e-4)
    if mode == "trained":
        np.testing.assert_allclose(ours[:delay], plan[:delay], atol=1e-5)
