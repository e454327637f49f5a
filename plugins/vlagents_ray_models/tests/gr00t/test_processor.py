"""NVIDIA's processor keeps state in its transforms, so only one thread at a time may use it."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vlagents_ray_models.gr00t import Gr00tNetwork


class Processor:
    """Stores the observation that it reads, as a transform stores its parameters."""

    text: Any = None

    def __call__(self, messages: list[dict[str, Any]]) -> Any:
        self.text = messages[0]["content"].text
        time.sleep(1e-3)  # another thread may call it
        return self.text


def test_each_observation_is_read_by_itself_on_several_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    types: Any = ModuleType("gr00t.data.types")
    types.VLAStepData = SimpleNamespace
    types.MessageType = SimpleNamespace(EPISODE_STEP=SimpleNamespace(value="step"))
    for name, module in {
        "gr00t": ModuleType("gr00t"),
        "gr00t.data": ModuleType("gr00t.data"),
        types.__name__: types,
    }.items():
        monkeypatch.setitem(sys.modules, name, module)
    robot: Any = SimpleNamespace(state={"arm": 2}, cameras=("front",))
    network = Gr00tNetwork(None, Processor(), robot)

    def read(text: str) -> Any:
        images = [{"front": np.zeros((2, 2, 3), np.uint8)}]
        return network.read(images, [{"arm": np.zeros(2)}], text).processed

    texts = [f"task {number}" for number in range(40)]
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(read, texts)) == texts
