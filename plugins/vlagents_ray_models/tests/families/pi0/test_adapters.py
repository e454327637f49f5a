"""LoRA adapters over transformers' π0, chosen by session in one batch, against each one merged
into its base.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from adapted_network import merge, pairs, save
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.pi0.conftest import WORDS, made, seen
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray_models.pi0 import Pi0

ATOL = 1e-4  # of actions of size 1, which ten steps of a flow and the merged sums round differently
TARGETS = (
    r".*\.(q_proj|v_proj|down_proj|fc1|fc2|patch_embedding|linear)|action_.*|embed_action_time\..*"
)
CHOSEN = ("first", None, "second", "first", "second")


@pytest.fixture(scope="module")
def saved(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, dict[str, np.ndarray]]]:
    """Folders and values of adapters, by their names."""
    root, adapters = tmp_path_factory.mktemp("adapters"), {}
    network = made(folder).model.network
    adaptable = (torch.nn.Linear, torch.nn.Conv2d)
    layers = {}
    for name, module in network.named_modules():
        if type(module) in adaptable and re.fullmatch(TARGETS, name):
            layers[name] = module
    assert {type(module) for module in layers.values()} == set(adaptable)

    for seed, (name, rank) in enumerate((("first", 2), ("second", 4))):
        random_values = pairs(network, list(layers), rank, seed)
        values = {key: 0.3 * value for key, value in random_values.items()}
        adapters[name] = save(root / name, values), values
    return adapters


def begun(policy: Pi0, seed: int, **options: Any) -> Pi0:
    session = AgentCopies(policy).make()
    session.reset(seen(seed), WORDS[seed % len(WORDS)], seed=seed, **options)
    assert isinstance(session, Pi0)
    return session


def test_each_row_of_one_pass_acts_as_its_adapter_merged_alone(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]]
) -> None:
    policy = made(folder, adapters={name: str(path) for name, (path, _) in saved.items()})
    views = [seen(seed, **{SAMPLES: 3 * (seed % 2)}) for seed in range(len(CHOSEN))]
    acts = policy.act_batch(
        views, [begun(policy, seed, adapter=name) for seed, name in enumerate(CHOSEN)]
    )
    base = made(folder)
    plain = [begun(base, seed).act(views[seed]).action for seed in range(len(CHOSEN))]
    for chosen in (None, "first", "second"):
        alone = made(folder)
        if chosen is not None:
            merge(alone.model.network, saved[chosen][1])
        for seed, act in enumerate(acts):
            if CHOSEN[seed] != chosen:
                continue
            expected = begun(alone, seed).act(views[seed])
            assert isinstance(act, Act)
            np.testing.assert_allclose(act.action, expected.action, atol=ATOL)
            if DISTRIBUTION in expected.info:
                np.testing.assert_allclose(
                    act.info[DISTRIBUTION]["samples"],
                    expected.info[DISTRIBUTION]["samples"],
                    atol=ATOL,
                )
            assert chosen is None or np.abs(expected.action - plain[seed]).max() > 100 * ATOL


def test_a_learner_pushes_one_of_several_adapters(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]]
) -> None:
    policy = made(folder, adapters={name: str(path) for name, (path, _) in saved.items()})
    unchanged = (None, "second")
    before = [begun(policy, 0, adapter=name).act(seen(0)).action for name in unchanged]
    check_pushed_weights(
        policy, lambda: begun(policy, 0, adapter="first").act(seen(0)).action, "first/"
    )
    for name, action in zip(unchanged, before, strict=True):
        assert np.array_equal(begun(policy, 0, adapter=name).act(seen(0)).action, action)


def test_an_adapter_with_other_statistics_is_refused(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]], tmp_path: Path
) -> None:
    adapter = shutil.copytree(saved["first"][0], tmp_path / "own")
    adapters = {"own": str(adapter)}
    file = Path(shutil.copy(folder / "processor_config.json", adapter))
    made(folder, adapters=adapters)

    processor = json.loads(file.read_text())
    file.write_text(json.dumps(processor | {"state_mean": None}))  # it has no statistics of states
    made(folder, adapters=adapters)

    file.write_text("[3]")
    with pytest.raises(ConfigError, match=r"adapter 'own': .*is no processor's config"):
        made(folder, adapters=adapters)

    processor["state_mean"][0] += 1
    file.write_text(json.dumps(processor))
    with pytest.raises(
        ConfigError, match=r"adapter 'own': .*expected \['state_mean'\] as the base has, got others"
    ):
        made(folder, adapters=adapters)
