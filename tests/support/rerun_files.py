"""What a file of Rerun holds, read by its own reader."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

_RERUN = {  # component -> what it is called here
    "Scalars:scalars": "values",
    "EncodedImage:blob": "file",
    "TextLog:text": "text",
    "TextDocument:text": "text",
    "Tensor:data": "tensor",
}


def read_rrd(path: Path) -> dict[str, dict[int | None, Any]]:
    """What a `.rrd` file says: entity -> tick (None: always) -> numbers, an image's file, a text, a tensor's rows."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[int | None, Any]] = defaultdict(dict)
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        ticks = batch["tick"].to_pylist() if "tick" in batch.schema.names else [None] * chunk.num_rows
        for column in _RERUN.keys() & set(batch.schema.names):
            for tick, value in zip(ticks, batch[column].to_pylist(), strict=True):
                found[chunk.entity_path.lstrip("/")][tick] = _plain(_RERUN[column], value)
    return dict(found)


def _plain(kind: str, value: Any) -> Any:
    if kind == "values":
        return value
    if kind == "file":
        return bytes(value[0])
    if kind == "text":
        return value[0]
    buffer = value[0]["buffer"]
    numbers = next(iter(buffer.values())) if isinstance(buffer, dict) else buffer
    rows, columns = value[0]["shape"]
    return [numbers[i * columns : (i + 1) * columns] for i in range(rows)]
