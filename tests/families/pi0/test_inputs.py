"""The inputs of π0's network: images as bytes to the device, and what an act then asks of a GPU."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch_calls import META, calls_of_an_act

from benchmarks.checkpoints import pi0 as recipe
from benchmarks.checkpoints.recipe import Recipe
from tests.families.pi0.conftest import WORDS, begun, made, seen
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DELAY, LEFTOVER, SAMPLES, WANT, Obs
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.pi0 import LoadedPi0, Pi0, Pi0HfPasses, _scale

# ATen calls that are no views of one act, 10 steps: 15,546 with transformers 5.23, of which each costs microseconds.
MOST_CALLS = 16_500


def row(policy: Pi0, i: int, obs: Obs) -> Row:
    session = begun(policy, i)
    session.observe(obs)
    assert session.episode is not None
    return Row(tuple(session.episode.frames), session.episode.instruction, session.episode.rng)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("settings", [{}, {"do_normalize": False}, {"do_normalize": False, "do_rescale": False}])
def test_inputs_are_those_of_the_processor_itself(folder: Path, settings: dict[str, bool]) -> None:
    policy = made(folder)
    assert policy.model is not None
    processor, views = policy.model.processor, [seen(i) for i in range(3)]
    for name, value in settings.items():
        setattr(processor.image_processor, name, value)
    policy.model = LoadedPi0(**{**vars(policy.model), "scale": _scale(processor, policy.model.staging)})
    found = policy._inputs([row(policy, i, obs) for i, obs in enumerate(views)])
    wanted = processor(
        images=[[obs.cameras["front"], obs.cameras["wrist"]] for obs in views],
        text=list(WORDS),
        state=np.stack([np.concatenate(list(obs.state.values())) for obs in views]),
        padding="max_length",
        max_length=found["input_ids"].shape[1],
    )
    assert found.keys() == wanted.keys()
    for name, tensor in wanted.items():
        assert found[name].dtype == tensor.dtype or name == "pixel_values"  # bytes without `do_rescale`
        torch.testing.assert_close(found[name].to(tensor.dtype), tensor, rtol=1e-6, atol=1e-6)


def test_a_processor_that_does_more_than_scale_is_refused() -> None:
    def squares(images: Any, **_: Any) -> dict[str, Any]:
        return {"pixel_values": [np.moveaxis(images[0], -1, 0).astype(np.float32) ** 2]}

    squares.pad_size = {"height": 32, "width": 16}  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="more than a factor and a summand"):
        _scale(SimpleNamespace(image_processor=squares), Staging("cpu"))


@pytest.fixture(scope="module")
def published() -> Pi0:
    """A policy of the published size, on the device meta."""
    network, processor = recipe.make_model(Recipe("pi0", Path("none"), "full", "bfloat16"))
    network = network.eval().requires_grad_(False).to(META)
    policy, staging = Pi0.from_config({"checkpoint": "none", "noise_level": 0.5}), Staging(META)
    passes = Pi0HfPasses(network, Compilation(False))
    policy.model = LoadedPi0(network, processor, torch.bfloat16, passes, staging, _scale(processor, staging))
    return policy


@pytest.mark.parametrize(
    ("info", "waits"),
    [({}, 1), ({SAMPLES: 2}, 1), ({WANT: ["logprob", "replay"]}, 2), ({LEFTOVER: np.ones((6, 7)), DELAY: 2}, 1)],
    ids=["an act", "samples", "log-probabilities", "a plan"],
)
def test_an_act_waits_only_for_its_results(published: Pi0, info: dict[str, Any], waits: int) -> None:
    sessions = [begun(published, i) for i in range(4)]
    counted = calls_of_an_act(published, sessions, [seen(i, **info) for i in range(4)])
    assert sum(counted.waits.values()) == waits, counted.waits
    assert counted.calls <= MOST_CALLS
