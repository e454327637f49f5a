"""A checkpoint that a trainer is still writing is never used, but a complete one always is."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.checkpoint_watcher import FINISHED, CheckpointWatcher, rounds

Write = Callable[[Path], Iterator[None]]


def safetensors(numbers: int = 50) -> bytes:
    header = {
        "__metadata__": {"format": "pt"},
        "w": {"dtype": "F32", "shape": [numbers], "data_offsets": [0, 4 * numbers]},
    }
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + np.arange(numbers, dtype=np.float32).tobytes()


def in_pieces(path: Path, data: bytes, pieces: int = 5) -> Iterator[None]:
    """Write a file piece by piece. Between two yields a watcher may look at it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        yield
        for part in np.array_split(np.frombuffer(data, np.uint8), pieces):
            file.write(part.tobytes())
            file.flush()
            yield


def one_file(folder: Path) -> Iterator[None]:
    yield from in_pieces(folder / "config.json", b'{"type": "act"}', 3)
    yield from in_pieces(folder / "model.safetensors", safetensors())


def shards(folder: Path) -> Iterator[None]:
    """Write the index before the shards, which is the worst possible order."""
    names = [f"model-0000{i}.safetensors" for i in (1, 2)]
    weights = {"weight_map": {f"w{i}": name for i, name in enumerate(names)}}
    yield from in_pieces(folder / "model.safetensors.index.json", json.dumps(weights).encode(), 3)
    for name in names:
        yield from in_pieces(folder / name, safetensors())


def zipped(folder: Path) -> Iterator[None]:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        archive.writestr("data.pkl", bytes(500))
    yield from in_pieces(folder / "model.pt", whole.getvalue())


def renamed(folder: Path) -> Iterator[None]:
    """Write as orbax does: under another name until the checkpoint is complete."""
    temporary = folder.with_name(f"{folder.name}.orbax-checkpoint-tmp-7")
    yield from in_pieces(temporary / "params" / "array", bytes(300))
    temporary.rename(folder)
    yield


KINDS: list[Write] = [one_file, shards, zipped, renamed]


@pytest.mark.parametrize("write", KINDS)
def test_half_a_checkpoint_is_never_taken_and_a_whole_one_is(write: Write, tmp_path: Path) -> None:
    watcher = CheckpointWatcher(str(tmp_path / "{step}"), settle_s=10)
    now, moments = 0.0, 0
    for _ in write(tmp_path / "100"):
        now += 1  # continuous writes, with less than the settling time between two changes
        moments += 1
        assert watcher.scan(now) == []
    assert moments > 3
    assert watcher.scan(now + 9) == []
    assert watcher.waiting() == {100: "changed less than 10 s ago"}
    assert watcher.scan(now + 20) == [100]
    assert watcher.scan(now + 99) == [], "each checkpoint is reported once"


@pytest.mark.parametrize("write", KINDS)
def test_a_trainer_that_stops_for_long_is_not_mistaken_for_one_that_is_done(
    write: Write, tmp_path: Path
) -> None:
    moments = len(list(write(tmp_path / "elsewhere" / "100")))
    watcher = CheckpointWatcher(str(tmp_path / "{step}"), settle_s=1)
    for moment, _ in enumerate(write(tmp_path / "100"), 1):
        found = [step for look in range(3) for step in watcher.scan(100 * moment + 10 * look)]
        assert found == ([100] if moment == moments else [])


def test_a_marker_says_that_it_is_done_and_no_waiting_is_needed_unless_it_is_not_whole(
    tmp_path: Path,
) -> None:
    watcher = CheckpointWatcher(str(tmp_path / "{step}"), settle_s=1e9, marker=".complete")
    list(one_file(tmp_path / "5"))
    assert watcher.scan(0) == []
    assert watcher.waiting() == {5: "has no .complete"}
    (tmp_path / "5" / ".complete").touch()
    assert watcher.scan(0) == [5]
    (tmp_path / "6").mkdir()
    (tmp_path / "6" / "model.safetensors").write_bytes(safetensors()[:-1])
    (tmp_path / "6" / ".complete").touch()
    assert watcher.scan(0) == []
    assert "its header says" in watcher.waiting()[6]


def test_steps_are_found_in_any_part_of_the_path_with_and_without_leading_zeros(
    tmp_path: Path,
) -> None:
    for name in ("step_000100", "step_2000", "step_0300", "last", "step_x"):
        list(one_file(tmp_path / name / "model"))
    watcher = CheckpointWatcher(str(tmp_path / "step_{step}" / "model"), settle_s=0)
    assert watcher.scan(0) == [100, 2000], "a policy is never served from a folder named 0300"


def test_what_the_policy_loads_has_to_be_there(tmp_path: Path) -> None:
    watcher = CheckpointWatcher(str(tmp_path / "{step}" / "model"), settle_s=0)
    list(one_file(tmp_path / "1" / "optimizer"))
    assert watcher.scan(0) == []
    assert watcher.waiting() == {1: "model: expected a file, got none"}


def test_a_file_can_be_a_checkpoint_and_a_pattern_has_a_place_for_the_step(tmp_path: Path) -> None:
    (tmp_path / "epoch=7.ckpt").write_bytes(bytes(10))
    assert CheckpointWatcher(str(tmp_path / "epoch={step}.ckpt"), settle_s=0).scan(0) == [7]
    with pytest.raises(ConfigError, match="write it in place of the step"):
        CheckpointWatcher("/runs/a")


def rounds_until(tmp_path: Path, until: int | None, then: Callable[[int], None]) -> list[list[int]]:
    pauses = iter(range(100))
    clock = iter(range(1000))
    watcher = CheckpointWatcher(str(tmp_path / "{step}"), settle_s=1)
    return list(rounds(watcher, until, lambda: then(next(pauses)), lambda: float(next(clock))))


def test_watching_ends_with_the_step_that_was_named(tmp_path: Path) -> None:
    def train(pause: int) -> None:
        list(one_file(tmp_path / str(100 * pause)))

    assert rounds_until(tmp_path, 200, train) == [[0], [100], [200]]


def test_a_step_beyond_the_last_one_ends_it_too(tmp_path: Path) -> None:
    for step in (10, 20, 30):
        list(one_file(tmp_path / str(step)))
    assert rounds_until(tmp_path, 25, lambda _: None) == [[10, 20]]


def test_watching_ends_when_the_trainer_says_so_and_all_is_taken(tmp_path: Path) -> None:
    def train(pause: int) -> None:
        if pause == 0:
            list(one_file(tmp_path / "10"))
            (tmp_path / "20").mkdir()  # this folder stays empty
            (tmp_path / FINISHED).touch()

    assert rounds_until(tmp_path, None, train) == [[10]]
