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
    """Folders and values of adapters."""
    root, found = tmp_path_factory.mktemp("adapters"), {}
    network = made(folder).model.network
    kinds = (torch.nn.Linear, torch.nn.Conv2d)
    layers = [
        name
        for name, one in network.named_modules()
        if type(one) in kinds and re.fullmatch(TARGETS, name)
    ]
    assert {type(dict(network.named_modules())[name]) for name in layers} == set(kinds)
    for seed, (name, rank) in enumerate((("first", 2), ("second", 4))):
        values = {key: 0.3 * value for key, value in pairs(network, layers, rank, seed).items()}
        found[name] = save(root / name, values), values
    return found


def session(policy: Pi0, seed: int, **options: Any) -> Pi0:
    one = AgentCopies(policy).make()
    one.reset(seen(seed), WORDS[seed % len(WORDS)], seed=seed, **options)
    assert isinstance(one, Pi0)
    return one


def test_each_row_of_one_pass_acts_as_its_adapter_merged_alone(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]]
) -> None:
    policy = made(folder, adapters={name: str(path) for name, (path, _) in saved.items()})
    asked = [seen(seed, **{SAMPLES: 3 * (seed % 2)}) for seed in range(len(CHOSEN))]
    acts = policy.act_batch(
        asked, [session(policy, seed, adapter=name) for seed, name in enumerate(CHOSEN)]
    )
    base = made(folder)
    plain = [session(base, seed).act(asked[seed]).action for seed in range(len(CHOSEN))]
    for chosen in (None, "first", "second"):
        alone = made(folder)
        if chosen is not None:
            merge(alone.model.network, saved[chosen][1])
        for seed, act in enumerate(acts):
            if CHOSEN[seed] != chosen:
                continue
            wanted = session(alone, seed).act(asked[seed])
            assert isinstance(act, Act)
            np.testing.assert_allclose(act.action, wanted.action, atol=ATOL)
            if DISTRIBUTION in wanted.info:
                samples = (one.info[DISTRIBUTION]["samples"] for one in (act, wanted))
                np.testing.assert_allclose(*samples, atol=ATOL)
            assert chosen is None or np.abs(wanted.action - plain[seed]).max() > 100 * ATOL


def test_a_learner_pushes_one_of_them(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]]
) -> None:
    policy = made(folder, adapters={name: str(path) for name, (path, _) in saved.items()})
    others = [session(policy, 0, adapter=name).act(seen(0)).action for name in (None, "second")]
    check_pushed_weights(
        policy, lambda: session(policy, 0, adapter="first").act(seen(0)).action, "first/"
    )
    for name, action in zip((None, "second"), others, strict=True):
        assert np.array_equal(session(policy, 0, adapter=name).act(seen(0)).action, action)


def test_an_adapter_with_other_statistics_is_refused(
    folder: Path, saved: dict[str, tuple[Path, dict[str, np.ndarray]]], tmp_path: Path
) -> None:
    own = shutil.copytree(saved["first"][0], tmp_path / "own")
    shutil.copy(folder / "processor_config.json", own)
    made(folder, adapters={"own": str(own)})
    processor = json.loads((own / "processor_config.json").read_text())
    # It states none.
    (own / "processor_config.json").write_text(json.dumps(processor | {"state_mean": None}))
    made(folder, adapters={"own": str(own)})
    (own / "processor_config.json").write_text("[3]")
    with pytest.raises(ConfigError, match=r"adapter 'own': .*is no processor's config"):
        made(folder, adapters={"own": str(own)})
    processor["state_mean"][0] += 1
    (own / "processor_config.json").write_text(json.dumps(processor))
    with pytest.raises(
        ConfigError, match=r"adapter 'own': .*got other \['state_mean'\] than the base has"
    ):
        made(folder, adapters={"own": str(own)})
