"""The cache of the tokens of instructions, and the choice between the processors of a checkpoint and
those of its adapter.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray_models.lerobot import processors
from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.processors import PIPELINES, cached_tokenizer, load_processors


@pytest.mark.torch
def test_cached_tokens_are_the_tokenizers_and_changes_of_a_batch_do_not_reach_them() -> None:
    torch = pytest.importorskip("torch")
    tokenized: list[list[str]] = []

    def tokenizer(
        texts: list[str], *, padding: str, return_tensors: str, max_length: int
    ) -> dict[str, Any]:
        assert (padding, return_tensors) == ("max_length", "pt")
        tokenized.append(texts)
        ids = torch.tensor([[*map(ord, text), *[0] * (max_length - len(text))] for text in texts])
        return {"input_ids": ids, "attention_mask": (ids > 0).long()}

    def plain(texts: list[str]) -> dict[str, Any]:
        return tokenizer(texts, padding="max_length", return_tensors="pt", max_length=8)

    cached = cached_tokenizer(tokenizer, "cpu", max_length=8)
    for texts in (["lift"], ["push", "lift"], ["lift"], ["lift", "push", "lift"]):
        batch, expected = cached(texts), plain(texts)
        assert batch.keys() == expected.keys()
        assert all(torch.equal(batch[name], expected[name]) for name in expected)
        batch["input_ids"].zero_()
    assert sum(texts == ["push"] for texts in tokenized) == 1


class SavedProcessors:
    """The processors in a folder, whose statistics are in a file there."""

    def __init__(self, folder: Path, settings: Any, config: Any, staging: Any) -> None:
        self.folder = folder

    def statistics(self, key: str) -> dict[str, list[float]]:
        saved: dict[str, dict[str, list[float]]] = json.loads(
            (self.folder / "statistics.json").read_text()
        )
        return saved[key]


def write_processors(folder: Path, state: int = 3) -> Path:
    folder.mkdir()
    for name in PIPELINES:
        (folder / name).write_text('{"steps": []}')
    statistics = {"observation.state": {"mean": [0.0] * state}, "action": {"mean": [0.0] * 2}}
    (folder / "statistics.json").write_text(json.dumps(statistics))
    return folder


def loaded_from(base: Path, adapter: Path | None, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder from which processors are loaded."""
    monkeypatch.setattr(processors, "Processors", SavedProcessors)
    settings = SimpleNamespace(
        robot_state_feature=SimpleNamespace(shape=(3,)),
        action_feature=SimpleNamespace(shape=(2,)),
        image_features={},
        chunk_size=8,
    )
    config = LeRobotConfig(checkpoint=str(base))
    loaded: Any = load_processors(base, adapter, settings, config, SimpleNamespace())  # type: ignore[arg-type]
    folder: Path = loaded.folder
    return folder


def test_the_processors_of_an_adapter_replace_those_of_its_base(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, adapter = write_processors(tmp_path / "base"), write_processors(tmp_path / "adapter")
    plain = tmp_path / "plain"
    plain.mkdir()
    assert loaded_from(base, None, monkeypatch) == base
    assert loaded_from(base, plain, monkeypatch) == base
    assert loaded_from(base, adapter, monkeypatch) == adapter


def test_processors_of_an_adapter_that_do_not_fit_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = write_processors(tmp_path / "base")
    longer = write_processors(tmp_path / "longer", state=4)
    with pytest.raises(
        ConfigError, match=r"observation.state: expected statistics of 3 numbers.*, got 4"
    ):
        loaded_from(base, longer, monkeypatch)

    half = write_processors(tmp_path / "half")
    (half / PIPELINES[1]).unlink()
    with pytest.raises(ConfigError, match=r"expected both .*got no .*'policy_postprocessor.json'"):
        loaded_from(base, half, monkeypatch)

    other = write_processors(tmp_path / "other")
    (other / "config.json").write_text('{"chunk_size": 7, "input_features": {}}')
    with pytest.raises(ConfigError, match=r"trained with {'chunk_size': 8}.*got {'chunk_size': 7}"):
        loaded_from(base, other, monkeypatch)

    unknown = write_processors(tmp_path / "unknown")
    (unknown / PIPELINES[0]).write_text('{"steps": [{"class": "subprocess.Popen"}]}')
    with pytest.raises(ConfigError, match=r"got the class 'subprocess.Popen'"):
        loaded_from(base, unknown, monkeypatch)
