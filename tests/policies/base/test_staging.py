"""Transfers of rows to the policy's device: pinned, on a separate stream, and stacked there without
a wait.
"""

from __future__ import annotations

import copy
import pickle
import threading
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from fake_cuda import FakeCuda

from vlagents_ray.policies.base.staging import StagedRow, Staging

pytestmark = pytest.mark.torch

CUDA = torch.device("cuda", 0)


def arrays(seed: int, side: int = 5) -> dict[str, np.ndarray]:
    """Return arrays of odd sizes and of all types that policies use."""
    rng = np.random.default_rng(seed)
    return {
        "image": rng.integers(0, 256, (side, side, 3), np.uint8),
        "state": rng.normal(size=7).astype(np.float32),
        "tokens": rng.integers(0, 1000, 3),
        "seen": rng.random(3) > 0.5,
        "empty": np.zeros((0, 4), np.float32),
        "number": np.float64(rng.random()),
        "turned": rng.normal(size=(3, 4)).astype(np.float32).T,
    }


def require_stacked(batch: dict[str, torch.Tensor], *rows: dict[str, np.ndarray]) -> None:
    assert list(batch) == list(rows[0])
    for name, tensor in batch.items():
        values = (
            tensor.values if hasattr(tensor, "values") and not callable(tensor.values) else tensor
        )
        wanted = torch.from_numpy(np.stack([np.asarray(row[name]) for row in rows]))
        assert values.dtype == wanted.dtype
        torch.testing.assert_close(values, wanted, rtol=0, atol=0)


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> FakeCuda:
    fake = FakeCuda()
    fake.install(monkeypatch)
    fake.install_copies(monkeypatch)
    return fake


@pytest.mark.parametrize("count", [1, 3])
def test_a_batch_has_the_arrays_of_its_rows(count: int) -> None:
    staging, rows = Staging("cpu"), [arrays(i) for i in range(count)]
    require_stacked(staging.stack([staging.stage(row) for row in rows]), *rows)


def test_batches_on_a_cpu_share_their_memory_whatever_the_mode() -> None:
    staging = Staging("cpu")
    rows = [staging.stage(arrays(i)) for i in range(3)]
    with torch.inference_mode():
        first = staging.stack(rows)["image"].data_ptr()
    assert staging.stack(rows[1:])["image"].data_ptr() == first
    require_stacked(staging.stack(rows[1:]), arrays(1), arrays(2))
    require_stacked(staging.stack([staging.stage(arrays(4, side=9))]), arrays(4, side=9))


def test_rows_of_other_shapes_are_refused_though_they_are_as_long() -> None:
    staging = Staging("cpu")
    wide, high = (
        staging.stage({"image": np.zeros(shape, np.uint8)}) for shape in ((4, 8, 3), (8, 4, 3))
    )
    with pytest.raises(ValueError, match=r"\(4, 8, 3\).*\(8, 4, 3\)"):
        staging.stack([wide, high])


def test_a_gpu_copies_rows_of_other_threads_and_the_batch_waits_for_the_copies(
    cuda: FakeCuda,
) -> None:
    staging, rows = Staging(CUDA), [StagedRow({}) for _ in range(4)]

    def stage(place: int) -> None:
        rows[place] = staging.stage(arrays(place))

    threads = [threading.Thread(target=stage, args=(place,)) for place in range(len(rows))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    blocks = [row.block for row in rows]
    # None has been copied yet.
    assert not any(torch.equal(block.values, cuda.pinned[0]) for block in blocks)
    require_stacked(staging.stack(rows), *map(arrays, range(4)))
    assert all(block.streams == [cuda.current_stream(CUDA)] for block in blocks)
    assert all(row.block is None for row in rows)  # only waiting requests use memory there
    require_stacked(staging.stack(rows[:1]), arrays(0))


def test_a_gpu_copies_a_row_once_for_all_batches_of_a_history(cuda: FakeCuda) -> None:
    staging = Staging(CUDA)
    frames = [staging.stage(arrays(i)) for i in range(3)]
    for newest in (1, 2):
        batch = staging.stack([frames[newest - 1], frames[newest]], keep=True)
        require_stacked(batch, arrays(newest - 1), arrays(newest))
    assert len(cuda.pinned) == len(frames)


def test_a_gpu_takes_an_array_in_the_order_of_the_current_stream(cuda: FakeCuda) -> None:
    numbers = np.arange(6, dtype=np.float32).reshape(2, 3)
    found = Staging(CUDA).upload(numbers)
    torch.testing.assert_close(found.values, torch.from_numpy(numbers))


def test_a_row_moves_to_another_replica_as_arrays_and_is_copied_there(cuda: FakeCuda) -> None:
    row = Staging(CUDA).stage(arrays(0))
    moved = pickle.loads(pickle.dumps(row))  # noqa: S301 - data of this test
    assert (moved.block, moved.copied) == (None, None)
    require_stacked(Staging("cpu").stack([moved]), arrays(0))
    staging = Staging(CUDA)
    again = copy.deepcopy(row)
    require_stacked(staging.stack([again, staging.stage(arrays(1))]), arrays(0), arrays(1))


def test_a_row_for_which_a_gpu_has_no_memory_is_copied_with_its_batch(
    cuda: FakeCuda, monkeypatch: pytest.MonkeyPatch
) -> None:
    staging, copy = Staging(CUDA), Staging._copy
    full = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
    monkeypatch.setattr(Staging, "_copy", Mock(side_effect=full))
    row = staging.stage(arrays(0))
    with pytest.raises(torch.OutOfMemoryError):
        staging.stack([row])
    monkeypatch.setattr(Staging, "_copy", copy)
    require_stacked(staging.stack([row]), arrays(0))
