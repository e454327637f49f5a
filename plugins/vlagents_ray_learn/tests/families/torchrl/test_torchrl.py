"""TorchRL's tiny VLA on a server, and its collectors, which act with served policies."""

from __future__ import annotations

import copy
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray import cloudpickle
from tensordict import NonTensorStack, TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torchrl.data.vla import UniformActionTokenizer
from torchrl.modules.inference_server import MPTransport
from torchrl.modules.vla import TinyVLA

from vlagents_ray import Act, Obs
from vlagents_ray.errors import ConfigError, MissingCamera
from vlagents_ray_learn.torchrl import PolicyServer, ServedPolicy, ServerAddress, TorchRLPolicy

PAGE = Path(__file__).parents[5] / "docs/evaluation/torchrl.md"
pytestmark = [pytest.mark.torch, pytest.mark.ray, pytest.mark.server]
WORDS = ("push the block", "lift the block", "push the block")
TOKENS, LOG_PROBS = ("vla_action", "tokens"), ("vla_action", "log_probs")


def tiny(**options: Any) -> TinyVLA:
    settings: dict[str, Any] = {
        "action_dim": 2,
        "chunk_size": 4,
        "action_head": "tokens",
        "vocab_size": 8,
    } | options
    return TinyVLA(**settings, return_vla_action_container=False)


def loaded(seed: int = 0, **options: Any) -> TinyVLA:
    """One whose lazy layers have sizes."""
    torch.manual_seed(seed)
    policy = tiny(**options)
    policy(seen())
    return policy


def seen() -> TensorDict:
    rng = torch.Generator().manual_seed(5)
    observation = {
        "image": torch.randint(0, 256, (3, 3, 16, 16), dtype=torch.uint8, generator=rng),
        "state": torch.randn(3, 4, generator=rng),
    }
    return TensorDict(
        {"observation": observation, "language_instruction": NonTensorStack(*WORDS)}, [3]
    )


def agent_of(policy: TinyVLA, tmp_path: Path) -> TorchRLPolicy:
    file = tmp_path / "factory"
    file.write_bytes(cloudpickle.dumps(lambda: policy))
    agent = TorchRLPolicy(str(file))
    agent.initialize()
    return agent


def sessions_of(agent: TorchRLPolicy, number: int = 3) -> list[Any]:
    sessions = [copy.copy(agent) for _ in range(number)]
    for i, session in enumerate(sessions):
        session.reset(Obs(), WORDS[i], seed=i)
    return sessions


def observations(**info: Any) -> list[Obs]:
    rows = seen()["observation"]
    return [
        Obs(
            {"front": rows["image"][i].permute(1, 2, 0).numpy()},
            state={"state": rows["state"][i].numpy()},
            info=info,
        )
        for i in range(3)
    ]


@pytest.mark.parametrize("mode", ["sequence", "token"])
def test_likeliest_tokens_are_those_of_the_policy_itself(mode: str, tmp_path: Path) -> None:
    policy = loaded(log_probs_mode=mode)
    agent = agent_of(policy, tmp_path)
    acts = [
        act for act in agent.act_batch(observations(), sessions_of(agent)) if isinstance(act, Act)
    ]
    with set_interaction_type(InteractionType.DETERMINISTIC), torch.no_grad():
        theirs = policy(seen())
    assert np.array_equal([act.action for act in acts], theirs[TOKENS].numpy())
    stated = np.stack([act.info["behaviour"]["logprob"] for act in acts])
    assert stated.shape == ((3,) if mode == "sequence" else (3, 4, 2))
    assert np.allclose(stated, theirs[LOG_PROBS].numpy(), atol=1e-5)


def test_drawn_tokens_depend_on_the_session_alone(tmp_path: Path) -> None:
    agent = agent_of(loaded(), tmp_path)
    together = agent.act_batch(observations(want=["logprob"]), sessions_of(agent))
    mixed_obs = [*observations()[:1], *observations(want=["logprob"])[1:]]
    mixed = agent.act_batch(mixed_obs, sessions_of(agent))
    drawn = [act.action for act in together if isinstance(act, Act)]
    again = [act.action for act in mixed if isinstance(act, Act)]
    # The first is the likeliest, in the same batch as draws.
    assert not np.array_equal(drawn[0], again[0])
    assert np.array_equal(drawn[1:], again[1:])


def test_frequencies_of_draws_are_the_policys_probabilities(tmp_path: Path) -> None:
    policy = loaded()
    policy.head.weight.data *= 20  # far from uniform
    agent = agent_of(policy, tmp_path)
    [session] = sessions_of(agent, 1)
    [obs] = observations(want=["logprob"])[:1]
    tokens = np.stack([session.act(obs).action for _ in range(2000)])  # (2000, 4, 2)
    with torch.no_grad():
        probabilities = policy.get_dist(seen()[:1]).base_dist.probs[0].numpy()
    found = (tokens[..., None] == np.arange(8)).mean(0)
    assert probabilities.max() > 0.5
    assert np.abs(found - probabilities).max() < 5 * np.sqrt(0.25 / 2000)


def test_a_policy_with_a_tokenizer_returns_chunks(tmp_path: Path) -> None:
    tokenizer = UniformActionTokenizer(8, low=-1.0, high=1.0)
    agent = agent_of(loaded(action_tokenizer=tokenizer), tmp_path)
    act = agent.act_batch(observations(), sessions_of(agent))[0]
    assert isinstance(act, Act)
    assert np.allclose(
        act.action, tokenizer.decode(torch.from_numpy(act.info["behaviour"]["replay"]["tokens"]))
    )
    assert agent.contract is not None
    assert agent.contract.action.space is None


def test_a_missing_camera_fails_its_session_alone(tmp_path: Path) -> None:
    agent = agent_of(loaded(), tmp_path)
    obs = observations()
    obs[1] = Obs(state=obs[1].state)
    acts = agent.act_batch(obs, sessions_of(agent))
    assert [type(act) for act in acts] == [Act, MissingCamera, Act]


def test_lazy_layers_have_no_parameters_before_the_first_act(tmp_path: Path) -> None:
    agent = agent_of(tiny(), tmp_path)
    assert agent.parameters() == {}
    agent.act_batch(observations(), sessions_of(agent))
    assert agent.parameters().keys() == loaded().state_dict().keys()


def test_a_transport_of_torchrl_is_refused() -> None:
    with pytest.raises(ConfigError, match="expected ServerAddress, got MPTransport"):
        PolicyServer(policy_factory=tiny, transport=MPTransport())


@pytest.fixture(scope="module")
def server() -> Iterator[PolicyServer]:
    running = PolicyServer(policy_factory=loaded, transport=ServerAddress(use_manager=True)).start()
    yield running
    running.shutdown()


def test_a_served_policy_acts_like_the_module(server: PolicyServer) -> None:
    client = pickle.loads(pickle.dumps(server.transport.client()))  # noqa: S301 - as for a worker's process
    try:
        theirs, ours = loaded()(seen()), client(seen())
        assert torch.equal(ours[TOKENS], theirs[TOKENS])
        assert torch.allclose(ours[LOG_PROBS], theirs[LOG_PROBS], atol=1e-5)
        assert ours["policy_version"].shape == (3,)
        alone = client(seen()[0])
        assert torch.equal(alone[TOKENS], theirs[TOKENS][0])
        square = client(seen().unsqueeze(0))
        assert torch.equal(square[TOKENS], theirs[TOKENS][None])
        with set_interaction_type(InteractionType.RANDOM):
            drawn = client(seen())
        assert not torch.equal(drawn[TOKENS], theirs[TOKENS])
    finally:
        client.close()


def test_new_weights_reach_the_next_act(server: PolicyServer) -> None:
    client = server.transport.client()
    try:
        before = client(seen())["policy_version"]
        learner = loaded(seed=1)
        assert server.update_model_weights(TensorDict.from_module(learner).data) == {
            "accepted": True
        }
        after = client(seen())
        assert (after["policy_version"] == before + 1).all()
        assert torch.equal(after[TOKENS], learner(seen())[TOKENS])
        # lazy: none.
        assert server.update_model_weights(TensorDict.from_module(tiny()).data) == {
            "accepted": True
        }
        assert torch.equal(client(seen())["policy_version"], after["policy_version"])
    finally:
        client.close()


def test_episodes_begin_where_torchrl_says(
    server: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[list[str]] = []
    client = ServedPolicy(server.transport.client()._url)
    client(seen())
    agent: Any = client._sessions[0]
    reset = agent.reset_batch
    monkeypatch.setattr(
        agent,
        "reset_batch",
        lambda obs, words, *args, **k: (begun.append(words), reset(obs, words, *args, **k))[1],
    )
    try:
        client(seen())
        client(seen().set("is_init", torch.tensor([[False], [True], [False]])))
        client(
            seen().set(
                "language_instruction", NonTensorStack(WORDS[0], WORDS[1], "open the drawer")
            )
        )
        assert [list(words) for words in begun] == [["lift the block"], ["open the drawer"]]
    finally:
        client.close()


def test_the_program_of_the_page_runs(tmp_path: Path) -> None:
    [_, program] = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (tmp_path / "program.py").write_text(program)
    command = [sys.executable, "program.py"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout.splitlines() == [
        "torch.Size([3, 10, 4, 2]) [0]",
        "torch.Size([3, 10, 4, 2]) [1]",
    ]
