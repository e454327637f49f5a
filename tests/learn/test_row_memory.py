from __future__ import annotations

import numpy as np
import pyarrow as pa

from vlagents_ray.learn.columns import RowMemory, arrays, tensors

IMAGE = (224, 224, 3)


def address(rows: np.ndarray) -> int:
    address: int = rows.__array_interface__["data"][0]
    return address


def test_memory_is_used_again_once_nobody_views_it() -> None:
    memory = RowMemory(4)
    rows = memory.rows(128, IMAGE, np.uint8)
    assert rows.shape == (128, *IMAGE)
    before = address(rows)
    del rows
    assert address(memory.rows(100, IMAGE, np.uint8)) == before


def test_memory_that_an_arrow_batch_views_is_not_used_again() -> None:
    memory = RowMemory(4)
    rows = memory.rows(128, IMAGE, np.uint8)
    rows[:] = 7
    batch = pa.RecordBatch.from_pydict({"cameras.front": tensors(pa, rows[:80])})
    viewed = address(rows)
    del rows
    other = memory.rows(128, IMAGE, np.uint8)
    other[:] = 9
    seen = arrays(batch)["cameras.front"]
    del batch
    another = memory.rows(128, IMAGE, np.uint8)
    another[:] = 9
    assert (seen == 7).all()
    del seen
    assert address(memory.rows(128, IMAGE, np.uint8)) == viewed


def test_a_block_has_all_the_rows_that_fit() -> None:
    memory = RowMemory(4)
    memory.rows(256, IMAGE, np.uint8)  # nobody keeps it
    assert len(memory.rows(128, IMAGE, np.uint8)) == 256


def test_rows_have_their_type() -> None:
    memory = RowMemory(4)
    memory.rows(128, IMAGE, np.uint8)
    rows = memory.rows(1000, (500,), np.float32)
    rows[:] = 0.5
    assert (rows.dtype, rows.shape[1:], float(rows[-1, -1])) == (np.dtype(np.float32), (500,), 0.5)


def test_no_more_blocks_are_kept_than_stated() -> None:
    memory = RowMemory(1)
    several = [memory.rows(128, IMAGE, np.uint8) for _ in range(3)]
    several.clear()
    assert len(memory._free) == 1
