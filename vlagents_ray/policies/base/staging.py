"""The transfer of rows' inputs to the policy's device, where they are stacked into a batch.

On a GPU, the threads that prepare observations copy each row as soon as it is prepared. The copies
are made from pinned memory and on a separate stream. The rows of the next batch are therefore
copied while the current batch is computed, and the policy's thread does not wait for them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.base.accelerator import is_out_of_memory
from vlagents_ray.registry import require

# Alignment of tensors in a block, bytes. It suits all types, and a GPU copies in words of this
# size.
_ALIGNED = 16


class StagedRow(dict[str, np.ndarray]):
    """The arrays of a row by name, and a copy of all of them on the device.

    A pickle contains only the arrays.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        super().__init__({name: np.asarray(array, order="C") for name, array in arrays.items()})
        self.block: Any = None  # the copy on the device, (bytes,) uint8
        self.copied: Any = None  # event at the end of the copy, on a GPU

    def __reduce__(self) -> tuple[type[StagedRow], tuple[dict[str, np.ndarray]]]:
        return StagedRow, (dict(self),)

    @property
    def layout(self) -> list[tuple[str, tuple[int, ...], np.dtype[Any]]]:
        """The name, shape and type of each array, in the order of the block."""
        return [(name, array.shape, array.dtype) for name, array in self.items()]


class Staging:
    """Copies rows to a device, and stacks them there."""

    def __init__(self, device: Any) -> None:
        torch = require("torch")
        self.device = torch.device(device)
        self._stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._batch: Any = None  # (rows, bytes) uint8: the memory of the last batch on a CPU

    def upload(self, array: Any) -> Any:
        """Return a numpy array, or a tensor in the memory of the host, as a tensor on the device.

        On a GPU, the copy is made from pinned memory on the current stream, so that the policy's
        thread does not wait for it.
        """
        tensor = require("torch").as_tensor(array)
        if self._stream is not None:
            tensor = tensor.pin_memory()
        return tensor.to(self.device, non_blocking=True)

    def stage(self, arrays: Mapping[str, np.ndarray]) -> StagedRow:
        """Begin to copy the arrays of one row to the device; several threads may call it.

        Args:
            arrays: Arrays of numbers by name, of any shapes and types. They must not be changed
                after this call.
        """
        row = StagedRow(arrays)
        try:
            self._copy(row)
        except RuntimeError as error:
            # If memory is exhausted, `stack` copies the row, since the caller of `stack` can free
            # memory.
            if not is_out_of_memory(error):
                raise
        return row

    def stack(self, rows: Sequence[StagedRow], *, keep: bool = False) -> dict[str, Any]:
        """Stack the rows of a batch; called on the policy's thread.

        Args:
            rows: The rows of the batch, B.
            keep: Whether later batches also contain the rows, such as the rows of a history.
                Otherwise, their copies are freed, so that a GPU contains only copies for waiting
                requests.

        Returns:
            Tensors (B, …) on the device by name. On a CPU, they are valid until the next call.

        Raises:
            ValueError: The rows have arrays of different names, shapes or types.
        """
        torch, layout = require("torch"), rows[0].layout
        for row in rows:
            if row.layout != layout:
                raise ValueError(
                    f"stack: expected the same arrays in each row, got {layout} and {row.layout}"
                )
            # The row's copy was freed after an earlier batch, or the row was prepared in another
            # replica.
            if row.block is None:
                self._copy(row)

        if self._stream is not None:
            current = torch.cuda.current_stream(self.device)
            for row in rows:
                current.wait_event(row.copied)
                # The memory of the copy was allocated on the other stream.
                row.block.record_stream(current)
        blocks = [row.block for row in rows]
        batch = torch.stack(blocks, out=self._memory(len(blocks), len(blocks[0])))

        if not keep:
            for row in rows:
                row.block = row.copied = None

        tensors = {}
        for start, (name, array) in zip(_starts(rows[0]), rows[0].items(), strict=False):
            columns = batch[:, start : start + array.nbytes]
            typed = columns.view(getattr(torch, array.dtype.name))
            tensors[name] = typed.view(len(rows), *array.shape)
        return tensors

    def _memory(self, rows: int, size: int) -> Any:
        """Return reusable memory for a batch on a CPU, where an allocation would take longer than
        the copies.

        Args:
            rows: The number of rows.
            size: The bytes of a row.

        Returns:
            (rows, size) uint8; None on other devices.
        """
        if self.device.type != "cpu":
            return None

        torch = require("torch")
        if self._batch is None or self._batch.shape[1] != size or len(self._batch) < rows:
            # Later batches cannot be written into an inference tensor.
            with torch.inference_mode(False):
                self._batch = torch.empty(rows, size, dtype=torch.uint8)
        return self._batch[:rows]

    def _copy(self, row: StagedRow) -> None:
        """Copy the arrays of a row into one block on the device."""
        torch, starts = require("torch"), _starts(row)
        host = torch.empty(starts[-1], dtype=torch.uint8, pin_memory=self._stream is not None)
        for start, array in zip(starts, row.values(), strict=False):
            host.numpy()[start : start + array.nbytes] = array.reshape(-1).view(np.uint8)
        if self._stream is None:
            row.block = host.to(self.device)
            return
        with torch.cuda.stream(self._stream):
            row.block = host.to(self.device, non_blocking=True)
            row.copied = self._stream.record_event()


def _starts(row: StagedRow) -> list[int]:
    """Return the offset of each array in the block, bytes, and the length of the block."""
    starts = [0]
    for array in row.values():
        starts.append(starts[-1] + -(-array.nbytes // _ALIGNED) * _ALIGNED)
    return starts
