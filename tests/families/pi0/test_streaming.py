"""π0 in parts: a flow whose first rows are finished after its first step."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.families.pi0 import tiny
from vlagents_ray import Act, Obs
from vlagents_ray.interface import DISTRIBUTION, SAMPLES
from vlagents_ray.policies.flow import row_times
from vlagents_ray.policies.pi0 import Pi0, passes, policy
from vlagents_ray.testing import check_agent

torch.set_num_threads(1)

STEPS = 5
EARLY = {"early_rows": 0.6, "steps": STEPS}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.save(tmp_path_factory.mktemp("pi0"))


@pytest.fixture(scope="module")
def early(folder: Path) -> Pi0:
    served = Pi0.from_config({"checkpoint": str(folder), **EARLY})
    served.initialize()
    return served


def seen(seed: int, **info: Any) -> Obs:
    rng = np.random.default_rng(seed)
    return Obs(
        cameras={name: rng.integers(0, 256, (64, 64, 3), dtype=np.uint8) for name in ("front", "wrist")},
        state={
            "xyz_axis_angle": rng.normal(size=6).astype(np.float32),
            "gripper_qpos": rng.normal(size=2).astype(np.float32),
        },
        info=info,
    )


def begun(policy: Pi0, seed: int = 0) -> Pi0:
    session = copy.copy(policy)
    session.reset(seen(seed), "pick up the cube", seed=seed)
    return session


def test_its_parts_keep_what_an_agent_promises(folder: Path) -> None:
    check_agent(Pi0.from_config({"checkpoint": str(folder), **EARLY}), obs=[seen(i) for i in range(3)], steps=2)


def test_padded_and_cut_chunks_keep_it_too(folder: Path) -> None:
    settings = {"checkpoint": str(folder), **EARLY, "batch_sizes": [2, 4], "execute": 4}
    check_agent(Pi0.from_config(settings), obs=[seen(i) for i in range(3)], steps=2)


def test_without_the_setting_there_are_no_parts(folder: Path) -> None:
    for settings in ({}, {"early_rows": 0.6, "actions": "queue"}):
        assert Pi0.from_config({"checkpoint": str(folder), **settings}).act_parts is None


def test_each_part_comes_after_the_step_of_the_flow_that_finishes_it(
    early: Pi0, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[int] = []
    one_pass = passes.row_velocity_of

    def counted(*args: Any) -> Any:
        counts.append(1)
        return one_pass(*args)

    monkeypatch.setattr(policy, "row_velocity_of", counted)
    found = [(len(part.rows()), part.more, len(counts)) for part in begun(early).act_stream(seen(0))]
    finished = [int((times == 0).sum()) for times in row_times(STEPS, tiny.CHUNK, 0.6)[1:]]
    lengths = np.diff(finished, prepend=0).tolist()
    assert found == [(n, step < STEPS, step) for step, n in enumerate(lengths, 1) if n]
    assert found[0][2] == 1
    assert sum(n for n, _, _ in found) == tiny.CHUNK


def test_rows_of_equal_times_have_the_velocity_of_the_whole_flow(early: Pi0) -> None:
    session = begun(early)
    [row] = early._rows(seen(0), session)
    network = early.model.network  # type: ignore[union-attr]
    with torch.inference_mode():
        inputs = early._inputs([row])
        mask, state = inputs["attention_mask"], inputs["state"]
        encoded = passes.encode(
            network, inputs["input_ids"], inputs["pixel_values"], inputs["pixel_attention_mask"], mask
        )
        noise = torch.randn(1, tiny.CHUNK, 32, generator=torch.Generator().manual_seed(0))
        one = passes.velocity_of(network, encoded, mask, state, noise, torch.tensor([0.4]))
        by_row = passes.row_velocity_of(network, encoded, mask, state, noise, torch.full((1, tiny.CHUNK), 0.4))
    assert torch.equal(one, by_row)


def test_the_last_row_takes_all_steps_and_the_first_but_one() -> None:
    times = row_times(10, 50, 0.6)
    np.testing.assert_allclose(times[:, -1], np.linspace(1, 0, 11), atol=1e-6)
    assert times[1, 0] == 0.0
    assert (np.diff(times, axis=0) <= 0).all()
    assert (np.diff((times == 0).argmax(0)) >= 0).all()  # no row is finished before an earlier one
    assert (times[-1] == 0).all()
    assert (times[0] == 1).all()


def test_one_step_finishes_all_rows_and_is_the_whole_flow(folder: Path) -> None:
    served = Pi0.from_config({"checkpoint": str(folder), "early_rows": 0.6, "steps": 1})
    served.initialize()
    [part] = begun(served).act_stream(seen(0))
    np.testing.assert_allclose(part.action, begun(served).act(seen(0)).action, atol=1e-6)


def test_samples_come_with_a_whole_chunk(early: Pi0) -> None:
    sampled, plain = seen(0, **{SAMPLES: 2}), seen(1)
    sessions = [begun(early, 0), begun(early, 1)]
    lists = list(early.act_batch_stream([sampled, plain], sessions))
    first = [parts[0] for parts in lists if parts[0] is not None]
    assert len(first) == 1
    assert isinstance(first[0], Act)
    assert DISTRIBUTION in first[0].info
    second = [parts[1] for parts in lists if parts[1] is not None]
    alone = list(begun(early, 1).act_stream(plain))
    for part, same in zip(second, alone, strict=True):
        assert isinstance(part, Act)
        np.testing.assert_allclose(part.action, same.action, atol=1e-5)
