"""Prefixes of π0.5 in LeRobot; conftest.py leaves this file out if LeRobot has none, like
0.6.1.
"""

from __future__ import annotations

from pathlib import Path

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
    """A checkpoint of π0.5 whose config has prefixes."""
    folder = tmp_path_factory.mktemp("prefixed")
    chunk = {"chunk_size": tiny.CHUNK, "n_action_steps": tiny.EXECUTED, "num_inference_steps": 3}
    (folder / "pi05").mkdir()
    fast_tokenizer().save_pretrained(folder / "tokenizer")
    with local_tokenizer("pi05", folder / "tokenizer"):
        sizes = {"dtype": "float32", "image_resolution": (56, 56), LONGEST_PREFIX: LONGEST}
        tiny.write(folder / "pi05", tiny.config_of("pi05", **sizes, **chunk))
    return folder / "pi05"


@pytest.mark.usefixtures("connected")
@pytest.mark.parametrize("mode", ["trained", "guided"])
@pytest.mark.parametrize("delay", [1, LONGEST])
def test_actions_after_prefixes_are_theirs(delay: int, mode: str, trained: Path) -> None:
    settings = {} if mode == "trained" else {"overrides": {"rtc_config": {"mode": mode}}}
    policy, theirs = _loaded(trained, execute=tiny.CHUNK, **settings), Theirs(trained)

    plan = np.random.default_rng(5).uniform(-1, 1, (6, tiny.ACTION)).astype(np.float32)
    theirs.policy.config.rtc_config = RTCConfig(enabled=True, mode=mode)
    theirs.policy.init_rtc_processor()
    leftover = _normalised(plan, theirs.policy.config.normalization_mapping["ACTION"].name)
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = draws_of(policy).standard_normal(shape, dtype=np.float32)
    chunk = theirs.policy.predict_action_chunk(
        theirs.preprocess(view()),
        noise=torch.from_numpy(noise),
        prev_chunk_left_over=torch.from_numpy(leftover)[None],
        inference_delay=delay,
    )
    expected = theirs.after(chunk)[0].detach().numpy()

    assert policy.longest_prefix == (LONGEST if mode == "trained" else 0)
    act = begun(policy).act(view(**{LEFTOVER: plan, DELAY: delay}))
    assert act.info.get(GIVEN) == (delay if mode == "trained" else None)
    np.testing.assert_allclose(act.action, expected, atol=1e-4)
    if mode == "trained":
        np.testing.assert_allclose(act.action[:delay], plan[:delay], atol=1e-5)
