"""The inputs of π0's network, whose images reach the device as bytes, and how often a call waits
for a GPU.
"""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch_calls import META, calls_of_an_act

from benchmarks.checkpoints import pi0 as recipe
from benchmarks.checkpoints.recipe import Recipe
from plugins.vlagents_ray_models.tests.families.pi0.conftest import WORDS, begun, made, seen
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DELAY, LEFTOVER, SAMPLES, WANT, Obs
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.model_inputs import resize_with_pad
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray_models.pi0 import LoadedPi0, Pi0, Pi0HfPasses, _scale

# ATen calls that are no views of one act, 10 steps: 13,138 with transformers 5.23, of which each
# costs microseconds.
MOST_CALLS = 13_900
# An act with a plan also differentiates each step: 26,038.
MOST_GUIDED_CALLS = 27_500


def row(policy: Pi0, i: int, obs: Obs) -> Row:
    session = begun(policy, i)
    session.observe(obs)
    assert session.episode is not None
    return Row(tuple(session.episode.frames), session.episode.instruction, session.episode.rng)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize(
    "settings", [{}, {"do_normalize": False}, {"do_normalize": False, "do_rescale": False}]
)
def test_inputs_are_those_of_the_processor_itself(folder: Path, settings: dict[str, bool]) -> None:
    policy = made(folder)
    assert policy.model is not None
    processor, views = policy.model.processor, [seen(i) for i in range(3)]
    for name, value in settings.items():
        setattr(processor.image_processor, name, value)
    policy.model = LoadedPi0(
        **{**vars(policy.model), "scale": _scale(processor, policy.model.staging)}
    )
    inputs = policy._inputs([row(policy, i, obs) for i, obs in enumerate(views)])
    expected = processor(
        images=[[obs.cameras["front"], obs.cameras["wrist"]] for obs in views],
        text=list(WORDS),
        state=np.stack([np.concatenate(list(obs.state.values())) for obs in views]),
        padding="max_length",
        max_length=inputs["input_ids"].shape[1],
    )
    assert inputs.keys() == expected.keys()
    for name, tensor in expected.items():
        # The processor returns bytes without `do_rescale`.
        assert inputs[name].dtype == tensor.dtype or name == "pixel_values"
        torch.testing.assert_close(inputs[name].to(tensor.dtype), tensor, rtol=1e-6, atol=1e-6)


SIDES = ((480, 640), (640, 480), (224, 224), (100, 37), (1080, 1920))


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("images", [None, "transformers"])
def test_images_of_any_size_are_those_of_the_processor_itself(
    folder: Path, images: str | None
) -> None:
    policy = made(folder, images=images)
    assert policy.model is not None
    for i, side in enumerate(SIDES):
        obs = seen(i, side)
        obs.cameras["wrist"] = seen(i, SIDES[i - 1]).cameras["wrist"]  # of another size
        inputs = policy._inputs([row(policy, i, obs)])
        expected = policy.model.processor(
            images=[[obs.cameras["front"], obs.cameras["wrist"]]],
            text=[WORDS[0]],
            return_tensors="pt",
        )
        torch.testing.assert_close(
            inputs["pixel_values"], expected["pixel_values"], rtol=1e-6, atol=1e-6
        )


def test_images_for_openpis_weights_are_those_of_openpi(folder: Path) -> None:
    policy = made(folder, images="openpi")
    for i, side in enumerate(SIDES):
        image = seen(i, side).cameras["front"]
        np.testing.assert_array_equal(
            policy._resized([image])["images"][0], resize_with_pad(image, 224, 224)
        )


@pytest.mark.parametrize(
    ("settings", "style"),
    [
        ({}, "transformers"),
        ({"resample": 1}, "transformers"),
        ({"resample": 2}, "openpi"),
        ({"do_pad": False}, "openpi"),
        ({"do_resize": False}, "openpi"),
    ],
)
def test_the_image_processor_decides_unless_the_settings_do(
    folder: Path, settings: dict[str, Any], style: str
) -> None:
    processor = made(folder).loaded().processor
    for name, value in settings.items():
        setattr(processor.image_processor, name, value)
    for chosen in (None, "transformers", "openpi"):
        policy = Pi0.from_config({"checkpoint": str(folder), "images": chosen})
        assert policy._style(processor) == (chosen or style)


@pytest.mark.parametrize("words", ["pick_up the\ncube", "  push \n", "open the drawer"])
def test_instructions_are_cleaned_as_the_training_did(folder: Path, words: str) -> None:
    def tokens(images: str, text: str) -> list[int]:
        policy = made(folder, images=images)
        session = copy.copy(policy)
        session.reset(seen(0), text, seed=0)
        prompt = session._current_episode().prompt
        return list(prompt["input_ids"][prompt["attention_mask"] == 1])

    cleaned = words.strip().replace("_", " ").replace("\n", " ")  # openpi's tokenizer.py
    assert tokens("openpi", words) == tokens("transformers", cleaned)
    assert (tokens("transformers", words) == tokens("openpi", words)) == (words == cleaned)


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
    policy.model = LoadedPi0(
        network, processor, torch.bfloat16, passes, staging, _scale(processor, staging)
    )
    return policy


@pytest.mark.parametrize(
    ("info", "waits", "most"),
    [
        ({}, 1, MOST_CALLS),
        ({SAMPLES: 2}, 1, MOST_CALLS),
        ({WANT: ["logprob", "replay"]}, 2, MOST_CALLS),
        ({LEFTOVER: np.ones((6, 7)), DELAY: 2}, 1, MOST_GUIDED_CALLS),
    ],
    ids=["an act", "samples", "log-probabilities", "a plan"],
)
def test_an_act_waits_only_for_its_results(
    published: Pi0, info: dict[str, Any], waits: int, most: int
) -> None:
    sessions = [begun(published, i) for i in range(4)]
    counted = calls_of_an_act(published, sessions, [seen(i, **info) for i in range(4)])
    assert sum(counted.waits.values()) == waits, counted.waits
    assert counted.calls <= most
