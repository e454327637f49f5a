"""π0, π0.5 and π0-FAST, for a transformers with openpi's changes; conftest.py leaves this file
out for others.

LeRobot makes these models in two sizes only, so that the tests replace the functions that choose
them.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from counting_compiler import counting_compiler
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from normal_steps import logprob_of_steps
from pushed_weights import check_pushed_weights
from recorded_programs import recorded_programs
from rounding_errors import check_rounding
from safetensors.torch import load_file, save_file

from benchmarks.checkpoints.lerobot import local_tokenizer
from benchmarks.checkpoints.tokenizer import fast_tokenizer
from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import TASKS, begun, view
from plugins.vlagents_ray_models.tests.families.lerobot.test_upstream import Theirs, draws_of
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT, Act
from vlagents_ray.testing import check_agent
from vlagents_ray_models.lerobot import LeRobot

KINDS, FAST = ("pi0", "pi05"), "pi0_fast"
# The code of an action tokenizer, as on the hub, but without a vocabulary.
ACTION_TOKENIZER = """
class Characters:
    scale, min_token = 16, -32
    bpe_tokenizer = property(lambda self: self)

    @classmethod
    def from_pretrained(cls, *_, **__):
        return cls()

    @classmethod
    def register_for_auto_class(cls, *_): ...

    def decode(self, tokens):
        return "".join(chr(int(token) % 64) for token in tokens)
"""
ATOL = 1e-5
VOCABULARY = len(fast_tokenizer())  # π0-FAST turns each of its tokens into a word


@pytest.fixture(scope="module")
def shrunk() -> Iterator[pytest.MonkeyPatch]:
    """Make LeRobot's models small."""
    with pytest.MonkeyPatch.context() as patch:
        for kind in (*KINDS, FAST):
            modeling = importlib.import_module(f"lerobot.policies.{kind}.modeling_{kind}")
            size = modeling.GemmaConfig(
                width=32, depth=2, mlp_dim=64, num_heads=4, num_kv_heads=1, head_dim=16
            )
            patch.setattr(modeling, "get_gemma_config", lambda _, size=size: size)

            if tiny.NEW:
                names = ("PaliGemmaForConditionalGenerationWithPiGemma", "PiGemmaForCausalLM")
            else:
                names = ("PaliGemmaForConditionalGeneration", "GemmaForCausalLM")
            for name, shrink in zip(names, (_small_vision, _few_words), strict=True):
                if not hasattr(modeling, name):  # π0-FAST has no second network
                    continue
                cls = getattr(modeling, name)
                patch.setattr(
                    modeling,
                    name,
                    lambda config, cls=cls, shrink=shrink: cls(config=shrink(config)),
                )
        yield patch


@pytest.fixture(scope="module")
def made(
    shrunk: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Returns the checkpoint of a kind; a tokenizer is in the folder above."""
    folder = tmp_path_factory.mktemp("pi")
    fast_tokenizer().save_pretrained(folder / "tokenizer")
    for kind in KINDS:
        chunk = {
            "chunk_size": tiny.CHUNK,
            "n_action_steps": tiny.EXECUTED,
            "num_inference_steps": 3,
        }
        (folder / kind).mkdir()
        with local_tokenizer(kind, folder / "tokenizer"):
            tiny.write(
                folder / kind,
                tiny.config_of(kind, dtype="float32", image_resolution=(56, 56), **chunk),
            )
    if tiny.NEW:
        _write_fast(folder)
    return lambda kind: folder / kind


@pytest.mark.parametrize("kind", KINDS)
def test_keeps_the_contract(kind: str, made: Callable[[str], Path]) -> None:
    check_agent(LeRobot.from_config({"checkpoint": str(made(kind))}), instructions=TASKS, atol=ATOL)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", KINDS)
def test_a_session_gets_the_same_in_any_company(kind: str, made: Callable[[str], Path]) -> None:
    policy = _loaded(made(kind))
    alone = begun(policy, 1).act(view(1)).action
    for size in (2, 3, 8):
        numbers = range(1, size + 1)
        acts = policy.act_batch(
            [view(number) for number in numbers], [begun(policy, number) for number in numbers]
        )
        assert isinstance(acts[0], Act)
        np.testing.assert_allclose(acts[0].action, alone, atol=ATOL)


@pytest.mark.verifies("parity")
@pytest.mark.usefixtures("connected")
@pytest.mark.parametrize("delay", [None, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_flow_matching_and_its_guidance_are_theirs(
    kind: str, delay: int | None, made: Callable[[str], Path]
) -> None:
    policy, theirs = _loaded(made(kind), execute=tiny.CHUNK), Theirs(made(kind))
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = draws_of(policy).standard_normal(shape, dtype=np.float32)
    options: dict[str, Any] = {"noise": torch.from_numpy(noise)}
    info: dict[str, Any] = {}
    if delay is not None:
        plan = np.random.default_rng(5).uniform(-1, 1, (5, tiny.ACTION)).astype(np.float32)
        info = {LEFTOVER: plan, DELAY: delay}
        theirs.policy.config.rtc_config = RTCConfig(enabled=True)
        theirs.policy.init_rtc_processor()
        leftover = _normalised(plan, theirs.policy.config.normalization_mapping["ACTION"].name)
        options["prev_chunk_left_over"] = torch.from_numpy(leftover)[None]
        options["inference_delay"] = delay
    chunk = theirs.policy.predict_action_chunk(theirs.preprocess(view()), **options)
    ours = begun(policy).act(view(**info)).action
    np.testing.assert_allclose(ours, theirs.after(chunk)[0].detach().numpy(), atol=1e-4)


@pytest.mark.verifies("parity")
@pytest.mark.parametrize("kind", KINDS)
def test_in_bfloat16_the_error_is_that_of_lerobots_own_passes(
    kind: str, made: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, exact_policy = _loaded(made(kind), dtype="bfloat16"), _loaded(made(kind))
    network, exact_network = (
        loaded.model.sampler.policy.model for loaded in (policy, exact_policy)
    )
    exact_network.load_state_dict(network.state_dict())  # with the same rounded weights
    inputs: list[Any] = []
    sample = network.sample_actions

    def keep_and_sample(*args: Any, **options: Any) -> Any:
        inputs.extend(args)
        return sample(*args, **options)

    monkeypatch.setattr(network, "sample_actions", keep_and_sample)
    numbers = range(len(TASKS))
    policy.act_batch([view(i) for i in numbers], [begun(policy, i) for i in numbers])

    torch.manual_seed(0)
    shape = (len(TASKS), tiny.CHUNK, network.action_in_proj.in_features)
    noise, steps = torch.randn(*shape), 3
    with torch.inference_mode():
        ours = sample(*inputs, noise=noise, owners=list(numbers), steps=steps)
        theirs, exact = (
            type(owner).sample_actions(owner, *inputs, noise=noise, num_steps=steps)
            for owner in (network, exact_network)
        )
    check_rounding(ours.numpy(), theirs.numpy(), exact.numpy())


@pytest.mark.skipif(not tiny.NEW, reason="LeRobot 0.4 has no relative actions")
@pytest.mark.verifies("parity")
@pytest.mark.usefixtures("connected")
def test_actions_relative_to_the_state_and_their_leftovers_are_theirs(
    made: Callable[[str], Path], tmp_path: Path
) -> None:
    from lerobot.policies.rtc.relative import reanchor_relative_rtc_prefix

    chunk = {"chunk_size": tiny.CHUNK, "n_action_steps": tiny.EXECUTED, "num_inference_steps": 3}
    with local_tokenizer("pi0", made("pi0").parent / "tokenizer"):
        sizes = {"dtype": "float32", "image_resolution": (56, 56)}
        tiny.write(tmp_path, tiny.config_of("pi0", use_relative_actions=True, **sizes, **chunk))
    policy, theirs = _loaded(tmp_path, execute=tiny.CHUNK), Theirs(tmp_path)
    views = [view(1, **{SAMPLES: 2}), view(2)]
    acts = policy.act_batch(views, [begun(policy, 1), begun(policy, 2)])
    for number, act in zip((1, 2), acts, strict=True):
        assert isinstance(act, Act)
        alone = begun(policy, number).act(view(number))
        np.testing.assert_allclose(act.action, alone.action, atol=ATOL)

    plan = np.random.default_rng(5).uniform(-1, 1, (5, tiny.ACTION)).astype(np.float32)
    theirs.policy.config.rtc_config = RTCConfig(enabled=True)
    theirs.policy.init_rtc_processor()
    inputs = theirs.preprocess(view())
    steps = {type(step).__name__: step for step in theirs.before.steps}
    leftover = reanchor_relative_rtc_prefix(
        torch.from_numpy(plan),
        torch.from_numpy(view().state["joints"]),
        steps["RelativeActionsProcessorStep"],
        steps["NormalizerProcessorStep"],
        "cpu",
    )
    shape = (1, tiny.CHUNK, theirs.policy.config.max_action_dim)
    noise = draws_of(policy).standard_normal(shape, dtype=np.float32)
    chunk = theirs.policy.predict_action_chunk(
        inputs,
        noise=torch.from_numpy(noise),
        prev_chunk_left_over=leftover[None],
        inference_delay=2,
    )
    ours = begun(policy).act(view(**{LEFTOVER: plan, DELAY: 2})).action
    np.testing.assert_allclose(ours, theirs.after(chunk)[0].detach().numpy(), atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_random_steps_have_the_log_probability_of_the_networks_own_steps(
    kind: str, made: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = _loaded(made(kind), noise_level=0.5)
    network = policy.model.sampler.policy.model
    read: list[int] = []
    embed = network.embed_prefix
    # The inputs of LeRobot's own steps for the same observation.
    theirs, step_inputs = Theirs(made(kind)), dict[str, Any]()
    step = theirs.policy.model.denoise_step

    def count_and_embed(images: Any, *args: Any) -> Any:
        read.append(len(images[0]))
        return embed(images, *args)

    def keep_and_step(**inputs: Any) -> Any:
        step_inputs.update(inputs)
        return step(**inputs)

    monkeypatch.setattr(theirs.policy.model, "denoise_step", keep_and_step)
    theirs.policy.predict_action_chunk(theirs.preprocess(view(1), TASKS[1]))
    monkeypatch.setattr(network, "embed_prefix", count_and_embed)
    act = begun(policy, 1).act(view(1, **{WANT: ["logprob", "replay"], SAMPLES: 2}))
    assert read == [1]

    def velocity(noisy: Any, time: float) -> Any:
        timestep = torch.tensor([time], dtype=torch.float32)
        with torch.inference_mode():
            return step(**step_inputs | {"x_t": noisy, "timestep": timestep})

    behaviour, samples = act.info[BEHAVIOUR], act.info[DISTRIBUTION]
    chains = [behaviour["replay"]["chain"], *samples["replay"]["chain"]]
    logprobs = [behaviour["logprob"], *samples["logprob"]]
    for chain, logprob in zip(chains, logprobs, strict=True):
        total = logprob_of_steps(velocity, chain, 0.5)[: len(act.action), : tiny.ACTION]
        np.testing.assert_allclose(logprob, total, atol=5e-3)


# Rows of the programs: one layer of the vision encoder, for one camera, and one of the language
# model; of the steps, π0's embedding, one layer and the last norm.
PROGRAMS = {"pi0": [2] * 5, "pi05": [2] * 4}


@pytest.mark.parametrize("kind", KINDS)
def test_compiled_passes_act_as_without(kind: str, made: Callable[[str], Path]) -> None:
    plain = _loaded(made(kind))
    with counting_compiler() as programs:
        compiled = _loaded(made(kind), compile="require", batch_sizes=[2])
        assert programs.rows == PROGRAMS[kind]
        for size in (1, 2, 3):
            views = [view(i) for i in range(size)]
            expected, acts = (
                policy.act_batch(views, [begun(policy, i) for i in range(size)])
                for policy in (plain, compiled)
            )
            for expected_act, act in zip(expected, acts, strict=True):
                assert isinstance(expected_act, Act)
                assert isinstance(act, Act)
                np.testing.assert_allclose(expected_act.action, act.action, atol=ATOL)
        assert programs.rows == PROGRAMS[kind]


@pytest.mark.parametrize("kind", KINDS)
def test_flex_attention_acts_as_the_usual_one(
    kind: str, made: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    with recorded_programs(monkeypatch) as programs:
        policy = _loaded(made(kind), attention="flex", compile="require", batch_sizes=[1])
        action = begun(policy).act(view()).action
    counts = [calls.count("flex_attention") for calls in programs]
    assert sorted(counts) == [0] * (len(PROGRAMS[kind]) - 1) + [
        1
    ]  # of the layer of the steps alone
    np.testing.assert_allclose(action, begun(_loaded(made(kind))).act(view()).action, atol=ATOL)


# Parts of the names of weights: of all, and of those that are read once for a flow.
@pytest.mark.parametrize(
    ("kind", "part"),
    [
        ("pi0", ""),
        ("pi0", "layernorm.weight"),
        ("pi05", ""),
        ("pi05", "layernorm.dense"),
        ("pi05", "time_mlp_in"),
    ],
)
def test_it_acts_with_pushed_weights(kind: str, part: str, made: Callable[[str], Path]) -> None:
    policy = _loaded(made(kind))
    check_pushed_weights(policy, lambda: begun(policy).act(view()).action, part)


OF_FAST = pytest.mark.skipif(not tiny.NEW, reason="π0-FAST is tried with LeRobot 0.6 alone")


def settings_of_fast(made: Callable[[str], Path]) -> dict[str, Any]:
    """Return the settings that the checkpoint of π0-FAST needs.

    LeRobot does not save the name of its action tokenizer's text tokenizer.
    """
    step = {"paligemma_tokenizer_name": str(made(FAST).parent / "tokenizer")}
    return {"trust_remote_code": True, "processors": {"action_tokenizer_processor": step}}


@OF_FAST
@pytest.mark.verifies("parity")
def test_tokens_drawn_from_the_same_seed_are_theirs(made: Callable[[str], Path]) -> None:
    settings = settings_of_fast(made)
    policy = _loaded(made(FAST), **settings)
    theirs = Theirs(made(FAST), **settings["processors"])
    rows = begun(policy).act(view()).action
    assert len(rows) == tiny.EXECUTED
    torch.manual_seed(int(draws_of(policy).integers(2**63)))
    for row in rows:
        np.testing.assert_allclose(theirs.select(view()), row, atol=ATOL)


@OF_FAST
def test_pi0_fast_keeps_the_contract(made: Callable[[str], Path]) -> None:
    fast = LeRobot.from_config({"checkpoint": str(made(FAST)), **settings_of_fast(made)})
    check_agent(fast, instructions=TASKS, atol=ATOL)


@OF_FAST
@pytest.mark.verifies("isolation")
def test_tokens_that_are_no_actions_fail_their_own_session(
    made: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = _loaded(made(FAST), **settings_of_fast(made))
    alone = begun(policy, 2).act(view(2)).action
    network = policy.model.sampler.policy
    decode = network.detokenize_actions
    calls: list[None] = []

    def check_first_and_decode(*tokens: Any, **shape: Any) -> Any:
        calls.append(None)
        # Only the first row's tokens, which are random, are checked.
        network.config.validate_action_token_prefix = len(calls) == 1
        return decode(*tokens, **shape)

    monkeypatch.setattr(network, "detokenize_actions", check_first_and_decode)
    broken, whole = policy.act_batch([view(1), view(2)], [begun(policy, 1), begun(policy, 2)])
    assert isinstance(broken, Exception)
    assert isinstance(whole, Act)
    np.testing.assert_allclose(whole.action, alone, atol=ATOL)


@OF_FAST
@pytest.mark.verifies("loading")
def test_the_code_of_an_action_tokenizer_wants_trust(made: Callable[[str], Path]) -> None:
    with pytest.raises(ConfigError, match="trust_remote_code: true"):
        _loaded(made(FAST))


@pytest.mark.verifies("loading")
@pytest.mark.parametrize("kind", KINDS)
def test_weights_that_lerobot_would_replace_by_random_ones_are_an_error(
    kind: str, made: Callable[[str], Path]
) -> None:
    file = made(kind) / "model.safetensors"
    whole = load_file(file)
    try:
        partial = {name: tensor for name, tensor in whole.items() if "action_out_proj" not in name}
        save_file(partial, file)
        with pytest.raises(ConfigError, match="action_out_proj"):
            _loaded(made(kind))
        file.write_bytes(b"not a checkpoint")
        with pytest.raises(ConfigError, match="is it complete"):
            _loaded(made(kind))
        # openpi's names.
        save_file({name.removeprefix("model."): tensor for name, tensor in whole.items()}, file)
        _loaded(made(kind))
    finally:
        save_file(whole, file)


def _write_fast(folder: Path) -> None:
    """Write a checkpoint of π0-FAST, and the code of an action tokenizer, into a folder with a
    tokenizer.
    """
    code = folder / "actions"
    code.mkdir()
    (code / "characters.py").write_text(ACTION_TOKENIZER)
    processor = {
        "processor_class": "Characters",
        "auto_map": {"AutoProcessor": "characters.Characters"},
    }
    (code / "processor_config.json").write_text(json.dumps(processor))
    names = {"text_tokenizer_name": str(folder / "tokenizer"), "action_tokenizer_name": str(code)}
    tokens = {
        "max_decoding_steps": 16,
        "fast_skip_tokens": 0,
        "temperature": 1.0,
        "validate_action_token_prefix": False,
    }
    # Images have 224 pixels, the only size that it supports.
    sizes = {"dtype": "float32", "n_action_steps": tiny.EXECUTED}
    (folder / FAST).mkdir()
    tiny.write(
        folder / FAST, tiny.config_of(FAST, chunk_size=tiny.CHUNK, **names, **tokens, **sizes)
    )


def _loaded(folder: Path, **config: Any) -> LeRobot:
    policy = LeRobot.from_config({"checkpoint": str(folder), **config})
    policy.initialize()
    return policy


def _normalised(plan: np.ndarray, mode: str) -> np.ndarray:
    """Return actions in the policy's units."""
    statistics = tiny.statistics()["action"]
    if mode == "MEAN_STD":
        return (plan - statistics["mean"]) / statistics["std"]
    low, high = statistics["q01"], statistics["q99"]
    return 2 * (plan - low) / (high - low) - 1


def _small_vision(config: Any) -> Any:
    for key, value in {"num_hidden_layers": 1, "hidden_size": 32, "num_attention_heads": 2}.items():
        setattr(config.vision_config, key, value)
    config.vision_config.intermediate_size = 64
    config.vision_config.projection_dim = config.text_config.hidden_size
    _few_words(config.text_config)
    return config


def _few_words(config: Any) -> Any:
    config.vocab_size = VOCABULARY
    return config
