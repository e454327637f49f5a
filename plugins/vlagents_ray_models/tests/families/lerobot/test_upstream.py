"""Our actions are those of LeRobot's own code, for one robot, given the same random numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.utils import prepare_observation_for_inference

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    TASKS,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray import Obs
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS

ATOL = 1e-5
OF_THIS_VERSION = tiny.KINDS[4:] if tiny.NEW else ("sac",)


class Theirs:
    """A checkpoint that LeRobot's own loop runs."""

    def __init__(self, folder: Path, **processors: dict[str, Any]) -> None:
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        if getattr(config, "rtc_config", False) is None:
            config.rtc_config = RTCConfig(enabled=False)
        self.policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        self.before, self.after = make_pre_post_processors(
            config, pretrained_path=str(folder), preprocessor_overrides=processors
        )

    def preprocess(self, obs: Obs, task: str = TASKS[0]) -> dict[str, Any]:
        """Return the policy's inputs for an observation."""
        observation = {"observation.state": obs.state["joints"].copy()}
        for name, image in obs.cameras.items():
            observation[f"observation.images.{name}"] = image.copy()
        prepared = prepare_observation_for_inference(observation, torch.device("cpu"), task)
        batch = self.before(prepared)
        return {key: value for key, value in batch.items() if value is not None}

    def select(self, obs: Obs, **options: Any) -> np.ndarray:
        """Return the action (D,) of the policy's own `select_action`."""
        with torch.inference_mode():
            action = self.policy.select_action(self.preprocess(obs), **options)
            return self.after(action)[0].numpy()


def draws_of(policy: LeRobot) -> np.random.Generator:
    """Return a copy of the generator of the first session in these tests."""
    return np.random.default_rng([policy.config.seed, 0])


@pytest.fixture
def upstream(made: Made) -> Iterator[Callable[[str], Theirs]]:
    state = torch.random.get_rng_state()
    yield lambda kind: Theirs(made(kind))
    torch.random.set_rng_state(state)


@pytest.mark.verifies("parity")
def test_act_is_theirs(loaded: Load, upstream: Callable[[str], Theirs]) -> None:
    theirs = upstream("act")
    rows = begun(loaded("act")).act(view()).action
    for row in rows:
        np.testing.assert_allclose(theirs.select(view()), row, atol=ATOL)


@pytest.mark.verifies("parity")
def test_the_ensemble_is_theirs(loaded: Load, upstream: Callable[[str], Theirs]) -> None:
    theirs, session = upstream("ensemble"), begun(loaded("ensemble"))
    for tick in range(2 * tiny.CHUNK):
        np.testing.assert_allclose(
            session.act(view(tick)).action, theirs.select(view(tick)), atol=ATOL
        )


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", ["smolvla"])
def test_flow_matching_is_theirs_with_the_same_noise(
    kind: str, loaded: Load, upstream: Callable[[str], Theirs]
) -> None:
    theirs, policy = upstream(kind), loaded(kind)
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = draws_of(policy).standard_normal(shape, dtype=np.float32)
    rows = begun(policy).act(view()).action
    np.testing.assert_allclose(
        rows[0], theirs.select(view(), noise=torch.from_numpy(noise)), atol=ATOL
    )
    for row in rows[1:]:
        np.testing.assert_allclose(row, theirs.select(view()), atol=ATOL)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", ["xvla", "vqbet", *OF_THIS_VERSION])
def test_what_draws_by_itself_is_theirs_from_the_same_seed(
    kind: str, loaded: Load, upstream: Callable[[str], Theirs]
) -> None:
    theirs, policy = upstream(kind), loaded(kind, actions="chunk")
    rows = begun(policy).act(view()).action
    torch.manual_seed(int(draws_of(policy).integers(2**63)))
    for row in rows:
        np.testing.assert_allclose(theirs.select(view()), row, atol=ATOL)


@pytest.mark.verifies("parity")
def test_diffusion_is_theirs_over_several_chunks(
    loaded: Load, upstream: Callable[[str], Theirs], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scheduler, which adds noise at each step, draws from our generator."""
    theirs, policy = upstream("diffusion"), loaded("diffusion")
    draws, config = draws_of(policy), theirs.policy.config
    step = theirs.policy.diffusion.noise_scheduler.step

    def seeded(*args: Any, generator: None) -> Any:
        assert generator is None
        return step(*args, generator=torch_draws)

    monkeypatch.setattr(theirs.policy.diffusion.noise_scheduler, "step", seeded)
    session = begun(policy)
    for tick in range(2 * tiny.EXECUTED):
        if tick % tiny.EXECUTED == 0:
            noise = torch.from_numpy(
                draws.standard_normal((1, config.horizon, tiny.ACTION), dtype=np.float32)
            )
            torch_draws = torch.Generator().manual_seed(int(draws.integers(2**63)))
        expected = theirs.select(view(tick), noise=noise)
        np.testing.assert_allclose(session.act(view(tick)).action, expected, atol=ATOL)


@pytest.mark.verifies("parity")
def test_tdmpc_plans_as_theirs_from_its_last_plan(
    loaded: Load, upstream: Callable[[str], Theirs]
) -> None:
    theirs, policy = upstream("tdmpc"), loaded("tdmpc")
    draws, session = draws_of(policy), begun(policy)
    for tick in range(3):
        torch.manual_seed(int(draws.integers(2**63)))
        with torch.inference_mode():
            latent = theirs.policy.model.encode(theirs.preprocess(view(tick)))
            action = theirs.after(theirs.policy.plan(latent).clamp(-1, 1)[0])[0].numpy()
        np.testing.assert_allclose(session.act(view(tick)).action[0], action, atol=ATOL)


@pytest.mark.verifies("parity")
def test_smolvla_with_its_language_model_in_bfloat16_is_theirs(tmp_path: Path) -> None:
    """LeRobot first reads these weights from the hub; here they come from the checkpoint only, in
    the same types.
    """
    folder = tiny.make(tmp_path / "smolvla", "smolvla", load_vlm_weights=True)
    theirs, policy = Theirs(folder), LeRobot.from_config({"checkpoint": str(folder)})
    for file in (folder / "vlm").glob("*.safetensors"):
        file.unlink()
    policy.initialize()

    dtypes = dtypes_of(policy.model.sampler.policy)
    assert dtypes == dtypes_of(theirs.policy)
    assert torch.bfloat16 in dtypes.values()

    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = torch.from_numpy(draws_of(policy).standard_normal(shape, dtype=np.float32))
    np.testing.assert_allclose(
        begun(policy).act(view()).action[0], theirs.select(view(), noise=noise), atol=ATOL
    )

    exact = LeRobot.from_config({"checkpoint": str(folder), "dtype": "float32"})
    exact.initialize()
    assert set(dtypes_of(exact.model.sampler.policy).values()) == {torch.float32}


def dtypes_of(network: torch.nn.Module) -> dict[str, torch.dtype]:
    """Return the type of each parameter by its name."""
    return {name: parameter.dtype for name, parameter in network.named_parameters()}


@pytest.mark.verifies("parity")
@pytest.mark.usefixtures("connected")
@pytest.mark.parametrize(("left", "delay"), [(6, 2), (3, 2), (2, 5)])
def test_real_time_chunking_is_theirs_with_the_gradient_of_the_paper(
    left: int, delay: int, loaded: Load, upstream: Callable[[str], Theirs]
) -> None:
    theirs, policy = upstream("smolvla"), loaded("smolvla", execute=tiny.CHUNK)
    plan = np.random.default_rng(5).uniform(-1, 1, (left, tiny.ACTION)).astype(np.float32)
    rows = begun(policy).act(view(1, **{LEFTOVER: plan, DELAY: delay})).action

    theirs.policy.config.rtc_config = RTCConfig(enabled=True)
    theirs.policy.init_rtc_processor()
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = draws_of(policy).standard_normal(shape, dtype=np.float32)
    action = tiny.statistics()["action"]
    normalised = (plan - action["mean"]) / action["std"]
    chunk = theirs.policy.predict_action_chunk(
        theirs.preprocess(view(1)),
        noise=torch.from_numpy(noise),
        prev_chunk_left_over=torch.from_numpy(normalised)[None],
        inference_delay=delay,
    )
    np.testing.assert_allclose(rows, theirs.after(chunk)[0].numpy(), atol=1e-4)
