"""Random weights are written in the safetensors format, one tensor at a time."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.checkpoints.weights import parameters_on_meta, write_weights
from vlagents_ray.errors import ConfigError

pytestmark = pytest.mark.torch

# Writes 256 MiB in 16 tensors, and prints the growth of the process in MiB.
_PEAK = """
import resource, sys
from pathlib import Path
import torch
from benchmarks.checkpoints.weights import parameters_on_meta, write_weights

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

with parameters_on_meta():
    model = torch.nn.Sequential(*(torch.nn.Linear(2048, 2048, bias=False) for _ in range(16)))
torch.empty(2048, 2048).uniform_().to(torch.bfloat16)
before = peak()
write_weights(model, Path(sys.argv[1]))
print(peak() - before)
"""


def network() -> Any:
    import torch

    with parameters_on_meta():
        return torch.nn.Sequential(
            torch.nn.Linear(3, 64), torch.nn.BatchNorm1d(64), torch.nn.Linear(64, 2)
        ).bfloat16()


def written(folder: Path) -> dict[str, Any]:
    """Return the tensors of all files of a folder by name; each starts at a multiple of its type's
    size.
    """
    import torch

    types = {"F32": torch.float32, "BF16": torch.bfloat16, "I64": torch.int64}
    found = {}
    for file in sorted(folder.glob("*.safetensors")):
        content = file.read_bytes()
        start = 8 + int.from_bytes(content[:8], "little")
        assert start % 8 == 0
        header = json.loads(content[8:start])
        assert header.pop("__metadata__") == {"format": "pt"}
        assert max(entry["data_offsets"][1] for entry in header.values()) == len(content) - start
        for name, entry in header.items():
            kind, (begin, end) = types[entry["dtype"]], entry["data_offsets"]
            assert begin % kind.itemsize == 0
            tensor = torch.frombuffer(bytearray(content[start + begin : start + end]), dtype=kind)
            found[name] = tensor.reshape(entry["shape"])
    return found


def test_every_tensor_of_a_model_is_written_in_its_type(tmp_path: Path) -> None:
    model = network()
    assert all(parameter.is_meta for parameter in model.parameters())
    assert write_weights(model, tmp_path) == sum(
        parameter.numel() for parameter in model.parameters()
    )
    tensors = written(tmp_path)
    assert {name: (one.shape, one.dtype) for name, one in tensors.items()} == {
        name: (one.shape, one.dtype) for name, one in model.state_dict().items()
    }
    for name, tensor in tensors.items():
        if name.endswith(("weight", "0.bias", "2.bias")):
            assert tensor.float().abs().sum() > 0, name
            assert tensor.flatten()[0] != tensor.flatten()[1], name
    assert (tensors["1.running_var"] == 1).all()  # the buffer's own value
    assert tensors["1.num_batches_tracked"] == 0
    assert abs(float(tensors["1.weight"].float().mean()) - 1) < 0.1


def test_a_large_model_is_written_in_shards_with_an_index(tmp_path: Path) -> None:
    model = network()
    write_weights(model, tmp_path, shard_bytes=300)
    index = json.loads((tmp_path / "model.safetensors.index.json").read_text())
    files = sorted(path.name for path in tmp_path.glob("*.safetensors"))
    assert len(files) > 1
    assert files == sorted(set(index["weight_map"].values()))
    assert files[0] == f"model-00001-of-{len(files):05d}.safetensors"
    assert set(written(tmp_path)) == set(index["weight_map"]) == set(model.state_dict())
    assert index["metadata"]["total_size"] == sum(one.nbytes for one in written(tmp_path).values())


def test_a_parameter_with_two_names_is_written_and_counted_once(tmp_path: Path) -> None:
    import torch

    with parameters_on_meta():
        model = torch.nn.ModuleDict(
            {"embed": torch.nn.Embedding(5, 4), "head": torch.nn.Linear(4, 5, bias=False)}
        )
        model["head"].weight = model["embed"].weight
    assert write_weights(model, tmp_path) == 20
    assert list(written(tmp_path)) == ["embed.weight"]


def test_values_that_a_model_has_are_kept_and_a_recipe_may_change_some(tmp_path: Path) -> None:
    import torch

    model = torch.nn.Linear(3, 2)
    write_weights(model, tmp_path, changes={"bias": lambda bias: bias.fill_(7)})
    tensors = written(tmp_path)
    assert torch.equal(tensors["weight"], model.weight)
    assert tensors["bias"].tolist() == [7, 7]
    assert model.bias.tolist() != [7, 7]


def test_modules_made_afterwards_have_values_again() -> None:
    import torch

    with pytest.raises(ZeroDivisionError), parameters_on_meta():
        raise ZeroDivisionError
    assert not torch.nn.Linear(2, 2).weight.is_meta


def test_too_little_space_is_said_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10))
    with pytest.raises(ConfigError, match="free space"):
        write_weights(network(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_memory_holds_single_tensors_and_not_the_model(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _PEAK, str(tmp_path)],
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    [file] = tmp_path.iterdir()
    assert file.stat().st_size > 256 * 2**20
    assert float(done.stdout) < 128
