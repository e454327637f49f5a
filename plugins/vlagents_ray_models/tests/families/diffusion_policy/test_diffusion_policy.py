"""The authors' own code, called through the policy: the same actions, in any batch, and with
compiled cores.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from counting_compiler import CountingCompiler, counting_compiler
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.diffusion_policy.conftest import (
    LIBRARIES,
    Checkpoint,
    begun,
    loaded,
    made,
    seen,
)
from vlagents_ray import Obs
from vlagents_ray.contract import StateSpec
from vlagents_ray.errors import MissingCamera
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.base import Row
from vlagents_ray.testing import check_agent
from vlagents_ray_models.diffusion_policy import DiffusionPolicy

pytestmark = [pytest.mark.source("DIFFUSION_POLICY_SRC"), *LIBRARIES]

ATOL = 1e-5  # float32 on a CPU, actions between -3 and 5; measured: 2e-6
KINDS = ["unet", "transformer", "image", "hybrid"]


@pytest.fixture(scope="module")
def policies(checkpoint: Checkpoint) -> Callable[[str], DiffusionPolicy]:
    """Return a function that loads the policy of a kind once, with whole chunks."""
    by_kind: dict[str, DiffusionPolicy] = {}

    def load(kind: str) -> DiffusionPolicy:
        if kind not in by_kind:
            by_kind[kind] = loaded(checkpoint(kind), actions="chunk")
        return by_kind[kind]

    return load


class TorchDraws:
    """Replaces a session's generator, and draws as torch does after `torch.manual_seed(0)`."""

    def __init__(self) -> None:
        import torch

        self._torch, self._generator = torch, torch.Generator().manual_seed(0)

    def standard_normal(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        drawn: np.ndarray = self._torch.randn(shape, generator=self._generator).numpy()
        return drawn.astype(dtype)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", KINDS)
def test_gives_what_the_authors_code_gives(
    kind: str, policies: Callable[[str], DiffusionPolicy], monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    policy = policies(kind)
    views = [seen(1), seen(2)]
    frames = tuple(policy.perceive(view) for view in views)
    [prediction] = policy.predict([Row(frames, "", TorchDraws())])  # type: ignore[arg-type]

    if kind in ("unet", "transformer"):
        stacked = {"obs": np.stack([view.state["state"] for view in views])[None]}
    else:
        pictures = np.stack([view.cameras["front"] for view in views]).astype(np.float32) / 255
        positions = np.stack([view.state["agent_pos"] for view in views])[None]
        stacked = {"image": np.moveaxis(pictures, -1, 1)[None], "agent_pos": positions}
    torch.manual_seed(0)
    monkeypatch.delattr(policy.model.module, "conditional_sample")  # ours, in the place of theirs
    with torch.no_grad():
        expected = policy.model.module.predict_action(
            {name: torch.from_numpy(array) for name, array in stacked.items()}
        )
    np.testing.assert_allclose(prediction.actions, expected["action"][0].numpy(), atol=ATOL)


@pytest.mark.parametrize("kind", ["unet", "image"])
def test_keeps_the_contract(kind: str, checkpoint: Checkpoint) -> None:
    check_agent(made(checkpoint(kind)), steps=5, atol=ATOL)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", KINDS)
def test_a_session_gets_the_same_in_any_company(
    kind: str, policies: Callable[[str], DiffusionPolicy]
) -> None:
    policy = policies(kind)
    views = [seen(i) for i in range(8)]
    alone = [begun(policy, seed=i).act(view).action for i, view in enumerate(views)]
    for size in (2, 3, 8):
        sessions = [begun(policy, seed=i) for i in range(size)]
        for i, act in enumerate(policy.act_batch(views[:size], sessions)):
            np.testing.assert_allclose(act.action, alone[i], atol=ATOL)
    assert np.ptp(np.stack(alone), axis=0).min() > 100 * ATOL  # eight answers, not one


def test_an_image_of_another_size_is_made_as_the_authors_make_it(
    policies: Callable[[str], DiffusionPolicy],
) -> None:
    policy, view = policies("image"), seen(1, (96, 200))
    from diffusion_policy.real_world.real_inference_util import get_real_obs_dict

    shapes = {"obs": {"image": {"shape": [3, 48, 48], "type": "rgb"}}}
    expected = get_real_obs_dict({"image": view.cameras["front"][None]}, shapes)["image"][0]
    image = policy.perceive(view)["image"]
    np.testing.assert_array_equal(np.moveaxis(image, -1, 0).astype(np.float32) / 255, expected)


def test_the_state_may_be_of_several_parts(checkpoint: Checkpoint) -> None:
    policy = loaded(checkpoint("unet"), state=["joints", "gripper"], actions="chunk", execute=2)
    obs = Obs(gripper=0.25, state={"joints": np.array([1, 2, 3], np.float32)})
    np.testing.assert_array_equal(policy.perceive(obs)["obs"], [1, 2, 3, 0.25])
    contract = policy.contract
    assert (contract.state, contract.gripper, contract.chunk) == ({"joints": StateSpec()}, True, 2)


@pytest.mark.parametrize("kind", KINDS)
def test_it_acts_with_pushed_weights(kind: str, checkpoint: Checkpoint) -> None:
    policy = loaded(checkpoint(kind))  # policy of this test alone
    # The names are those of the authors' training.
    assert policy.parameters().keys() == policy.model.module.state_dict().keys()
    check_pushed_weights(policy, lambda: begun(policy).act(seen(0)).action)


@pytest.mark.verifies("isolation")
def test_a_missing_camera_fails_its_own_session_alone(
    policies: Callable[[str], DiffusionPolicy],
) -> None:
    policy = policies("image")
    blind = Obs(state=seen(0).state)
    bad, good = policy.act_batch([blind, seen(1)], [begun(policy), begun(policy)])
    assert isinstance(bad, MissingCamera)
    assert not isinstance(good, Exception)


# How many cores each kind has: a denoising step, and the image encoder if there are images.
CORES = {"unet": 1, "transformer": 1, "image": 2, "hybrid": 2}
SIZE = 3


@pytest.fixture(scope="module")
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as counting:
        yield counting


@pytest.fixture(scope="module", params=CORES)
def both(
    request: pytest.FixtureRequest, checkpoint: Checkpoint, compiler: CountingCompiler
) -> tuple[DiffusionPolicy, DiffusionPolicy]:
    """Load a policy, and the same one with compiled cores."""
    file, programs = checkpoint(request.param), len(compiler.rows)
    compiled = loaded(file, actions="chunk", compile="require", batch_sizes=[SIZE])
    assert compiler.rows[programs:] == [SIZE] * CORES[request.param]
    return loaded(file, actions="chunk"), compiled


def acts(policy: DiffusionPolicy, views: list[Obs]) -> list[Act]:
    results = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    assert all(isinstance(act, Act) for act in results)
    return results  # type: ignore[return-value]


def test_batches_of_any_size_are_those_without_compilation(
    both: tuple[DiffusionPolicy, DiffusionPolicy], compiler: CountingCompiler
) -> None:
    programs = len(compiler.rows)
    for size in (1, 2, SIZE, SIZE + 1):
        calls = compiler.calls
        plain, compiled = (acts(policy, [seen(i) for i in range(size)]) for policy in both)
        for expected, act in zip(plain, compiled, strict=True):
            np.testing.assert_allclose(act.action, expected.action, atol=ATOL)
        assert compiler.calls > calls
    assert len(compiler.rows) == programs


def test_samples_are_those_without_compilation(
    both: tuple[DiffusionPolicy, DiffusionPolicy], compiler: CountingCompiler
) -> None:
    programs = len(compiler.rows)
    views = [seen(0), seen(1, **{SAMPLES: 2})]
    plain, compiled = (acts(policy, views) for policy in both)
    for expected, act in zip(plain, compiled, strict=True):
        np.testing.assert_allclose(act.action, expected.action, atol=ATOL)

    samples = [acts(policy, views)[1].info[DISTRIBUTION]["samples"] for policy in both]
    np.testing.assert_allclose(*samples, atol=ATOL)
    assert len(compiler.rows) == programs
