"""Checkpoints: found by name, step or commit, completely loaded by the model, and identified by
their digest.
"""

from __future__ import annotations

import json
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from empty_hub import empty_hub

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.adapter import LoraAdapter
from vlagents_ray.policies.base.checkpoint import (
    SavedTensors,
    find_checkpoint,
    require_filled,
    require_loaded,
    used_checkpoints,
)
from vlagents_ray.policies.base.checkpoint_files import (
    digest,
    files_in,
    revision,
    unfinished,
    weights_of,
)


def test_a_step_takes_its_place_in_the_path(tmp_path: Path) -> None:
    (tmp_path / "step_2000").mkdir()
    assert find_checkpoint(f"{tmp_path}/step_{{step}}", 2000) == tmp_path / "step_2000"


def test_what_is_not_there_is_said_with_what_is(tmp_path: Path) -> None:
    (tmp_path / "step_1000").mkdir()
    with pytest.raises(ConfigError, match=r"step_2000.*step_1000"):
        find_checkpoint(f"{tmp_path}/step_{{step}}", 2000)
    with pytest.raises(ConfigError, match=r"expected \['config.json'\] in it"):
        find_checkpoint(str(tmp_path / "step_1000"), needs=["config.json"])


def model() -> Any:
    torch = pytest.importorskip("torch")
    layers = torch.nn.Sequential(
        torch.nn.Linear(8, 8), torch.nn.BatchNorm1d(8), torch.nn.Linear(8, 8)
    )
    layers[2].weight = layers[0].weight  # tied weights
    return layers


@pytest.mark.torch
def test_a_model_that_holds_its_checkpoint_passes() -> None:
    net = model()
    saved = {name: tensor.clone() for name, tensor in net.state_dict().items()}
    require_loaded(net, saved)
    require_loaded(net, {name: tensor for name, tensor in saved.items() if name != "2.weight"})
    require_loaded(net.bfloat16(), saved)


@pytest.mark.torch
@pytest.mark.parametrize("name", ["0.weight", "2.bias", "1.running_mean"])
def test_random_weights_missing_ones_and_wrong_shapes_are_told(name: str) -> None:
    net = model()
    saved = {key: tensor.clone() for key, tensor in net.state_dict().items()}
    for wrong in (saved[name] + 1e-3, saved[name][:4]):
        with pytest.raises(
            ConfigError, match=f"1 are not what it holds .*{name}|2 are not what it holds .*{name}"
        ):
            require_loaded(net, saved | {name: wrong})
    tied = {name, "2.weight"} if name == "0.weight" else {name}
    with pytest.raises(ConfigError, match=f"are not in it .*{name}"):
        require_loaded(net, {key: tensor for key, tensor in saved.items() if key not in tied})


def test_saved_tensors_are_read_when_asked_for() -> None:
    reads: list[str] = []

    def reader(name: str) -> np.ndarray:
        reads.append(name)
        return np.zeros(1)

    saved = SavedTensors({name: lambda name=name: reader(name) for name in ("a", "b")})
    assert sorted(saved) == ["a", "b"]
    assert reads == []
    assert saved["a"].shape == (1,)
    assert reads == ["a"]


WANTED = {"dense": {"kernel": np.empty((2, 3)), "bias": np.empty(3)}, "scale": np.empty(1)}


def test_parameters_of_the_right_names_and_shapes_pass() -> None:
    require_filled(
        {"scale": np.ones(1), "dense": {"bias": np.ones(3), "kernel": np.ones((2, 3))}}, WANTED
    )


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (
            {"dense": {"kernel": np.ones((2, 3))}, "scale": np.ones(1)},
            r"1 parameters are not in it \['dense/bias'\]",
        ),
        (
            {**WANTED, "scale": SimpleNamespace(shape=(1,))},
            r"1 parameters are not in it \['scale'\]",
        ),
        ({**WANTED, "scale": np.ones(2)}, r"1 have another shape \['scale'\]"),
        ({**WANTED, "extra": {"bias": np.ones(2)}}, r"1 are not the model's \['extra/bias'\]"),
    ],
)
def test_what_is_missing_other_or_too_much_is_named(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        require_filled(params, WANTED)


# bytes of each tensor, 12 MB in total, of which only a sample is read
TENSORS, LENGTH = 40, 300_000
COMMIT = "0123456789abcdef0123456789abcdef01234567"


def save(file: Path, tensors: list[bytes]) -> None:
    header, end = {}, 0
    for i, one in enumerate(tensors):
        header[f"t{i}"] = {"data_offsets": [end, end := end + len(one)]}
    text = json.dumps({"__metadata__": {}, **header}).encode()
    file.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(tensors))


def tensors() -> list[bytes]:
    return [bytes([i]) * LENGTH for i in range(TENSORS)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "checkpoint"
    (made / "sub").mkdir(parents=True)
    linked = tmp_path / "linked"
    linked.mkdir()
    (linked / "params").write_text("a")
    (made / "step").symlink_to(linked)
    save(made / "model.safetensors", tensors())
    (made / "config.json").write_text('{"a": 1}')
    (made / "sub" / "opaque").write_bytes(bytes(9 * 2**20))
    with zipfile.ZipFile(made / "old.pt", "w") as archive:
        archive.writestr("archive/data/0", bytes(9 * 2**20))
    return made


def change_a_tensor(folder: Path) -> None:
    other = tensors()
    other[17] = bytes([99]) * LENGTH
    save(folder / "model.safetensors", other)


def change_a_byte_of_the_zip(folder: Path) -> None:
    with zipfile.ZipFile(folder / "old.pt", "w") as archive:
        archive.writestr("archive/data/0", bytes(5 * 2**20) + b"x" + bytes(4 * 2**20 - 1))


CHANGES: dict[str, Callable[[Path], object]] = {
    "one tensor of many": change_a_tensor,
    "a byte in a zip file": change_a_byte_of_the_zip,
    "another file throughout": lambda folder: (folder / "sub" / "opaque").write_bytes(
        b"x" * 9 * 2**20
    ),
    "settings": lambda folder: (folder / "config.json").write_text('{"a": 2}'),
    "a name": lambda folder: (folder / "config.json").rename(folder / "b.json"),
    "a place": lambda folder: (folder / "config.json").rename(folder / "sub" / "config.json"),
    "one more file": lambda folder: (folder / "more.json").touch(),
    "a file behind a link to a folder": lambda folder: (
        folder.with_name("linked") / "params"
    ).write_text("b"),
}


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES.values(), ids=list(CHANGES))
def test_what_changes_the_weights_changes_the_digest(
    change: Callable[[Path], object], folder: Path
) -> None:
    before = digest([folder])
    change(folder)
    assert digest([folder]) != before


def test_a_copy_has_the_same_and_what_is_written_about_it_does_not_count(
    folder: Path, tmp_path: Path
) -> None:
    before = digest([folder])
    assert before.startswith("sampled-sha256:")
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / "README.md").write_text("of an ACT")
    (copy / ".cache").mkdir()
    (copy / ".cache" / "lock").touch()
    assert digest([copy]) == before
    assert digest([folder / "config.json"]) == digest([copy / "config.json"]) != before
    assert weights_of([]) is None


def test_what_a_policy_found_stands_for_its_weights_and_a_part_for_the_whole(folder: Path) -> None:
    other = folder.with_name("other")
    other.mkdir()
    with used_checkpoints() as found:
        find_checkpoint(str(folder))
        find_checkpoint(str(other))
        find_checkpoint(str(folder / "config.json"))
        find_checkpoint(str(folder / "sub"))
        find_checkpoint(str(folder / "sub"))
    assert found == [other, folder / "config.json", folder / "sub"]
    find_checkpoint(str(folder))
    assert len(found) == 3


def test_another_name_of_a_folder_is_not_counted_beside_it(folder: Path) -> None:
    """LeRobot's `checkpoints/last` is a link to the newest step."""
    last = folder.with_name("last")
    last.symlink_to(folder)
    found = []
    for names in ((folder / "sub",), (last, folder / "sub"), (last, last / "sub")):
        with used_checkpoints() as used:
            for name in names:
                find_checkpoint(str(name))
        found.append(digest(used))
    assert found[0] == found[1] == found[2]
    with used_checkpoints() as used:
        find_checkpoint(str(last))
        find_checkpoint(str(folder))
    assert digest(used) == digest([folder])


def test_a_link_to_a_folder_above_is_no_endless_way(folder: Path) -> None:
    before = digest([folder])
    (folder / "sub" / "round").symlink_to(folder)
    assert digest([folder]) == before


def test_links_that_double_at_each_folder_are_followed_once(tmp_path: Path) -> None:
    """There are 2**24 ways to the only file."""
    for number in range(24):
        (tmp_path / f"d{number}").mkdir()
        for name in ("a", "b"):
            (tmp_path / f"d{number}" / name).symlink_to(tmp_path / f"d{number + 1}")
    (tmp_path / "d24").mkdir()
    (tmp_path / "d24" / "weights.bin").write_text("w")
    assert len(files_in(tmp_path / "d0")) == 1


@pytest.mark.parametrize("read", [unfinished, lambda file: digest([file])])
def test_a_header_that_is_nested_deeply_is_no_error_of_the_reader(
    tmp_path: Path, read: Callable[[Path], str | None]
) -> None:
    header = b"[" * 10**5 + b"]" * 10**5
    file = tmp_path / "model.safetensors"
    file.write_bytes(len(header).to_bytes(8, "little") + header)
    assert isinstance(read(file), str)


def test_the_commit_is_that_of_the_policy_and_not_of_an_encoder_beside_it(
    folder: Path, tmp_path: Path
) -> None:
    snapshot = tmp_path / "models--org--encoder" / "snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    assert weights_of([folder, snapshot]) == {
        "digest": digest([folder, snapshot]),
        "revision": None,
    }
    assert weights_of([snapshot, folder]) == {
        "digest": digest([snapshot, folder]),
        "revision": COMMIT,
    }


class RevisionNotFoundError(Exception):
    """A stand-in for huggingface_hub's error, which is recognized by its name."""


def test_a_revision_that_is_not_there_is_named_with_those_that_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def download(name: str, revision: str | None) -> str:
        raise RevisionNotFoundError(name)

    refs = SimpleNamespace(
        branches=[SimpleNamespace(name="main")], tags=[SimpleNamespace(name="v1")]
    )
    api = SimpleNamespace(list_repo_refs=lambda _name: refs)
    hub = SimpleNamespace(snapshot_download=download, HfApi=lambda: api)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(
        ConfigError,
        match=r"expected a commit, a branch or a tag of org/name, got 'v2'.*are main, v1$",
    ):
        find_checkpoint("org/name@v2")
    del hub.HfApi  # for example without a network
    with pytest.raises(ConfigError, match=r"got 'v2'.*not known here"):
        find_checkpoint("org/name@v2")
    with pytest.raises(
        ConfigError,
        match=r"'org/name@': expected a commit, a tag or a branch after the @, got nothing",
    ):
        find_checkpoint("org/name@")


def test_a_hub_id_takes_a_commit_and_says_which_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    snapshot = tmp_path / "models--org--name" / "snapshots" / COMMIT
    (snapshot / "sub").mkdir(parents=True)
    asked = []

    def download(name: str, revision: str | None) -> str:
        asked.append((name, revision))
        if revision == "gone":
            raise ValueError("no such revision")
        return str(snapshot)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=download))
    with caplog.at_level("INFO"):
        assert find_checkpoint(f"org/name@{COMMIT}") == find_checkpoint("org/name") == snapshot
    assert asked == [("org/name", COMMIT), ("org/name", None)]
    assert f"checkpoint org/name: commit {COMMIT}" in caplog.text
    assert revision(snapshot / "sub") == COMMIT
    assert revision(tmp_path) is None
    assert weights_of([snapshot]) == {"digest": digest([snapshot]), "revision": COMMIT}
    with pytest.raises(ConfigError, match=r"org/name@gone.*org/name@COMMIT"):
        find_checkpoint("org/name@gone")


@pytest.mark.parametrize(
    "start", [b"", (2**62).to_bytes(8, "little"), (9).to_bytes(8, "little") + b'{"a": 1}!']
)
def test_a_file_that_is_not_what_its_name_says_has_a_digest_too(
    start: bytes, tmp_path: Path
) -> None:
    found = []
    for rest in (b"x", b"x", b"y"):
        (tmp_path / "model.safetensors").write_bytes(start + rest * 2**21)
        found.append(digest([tmp_path]))
    assert found[0] == found[1] != found[2]


NAMED = f"org/name@{COMMIT}"


def test_an_adapter_is_asked_for_by_its_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = empty_hub(monkeypatch)
    with pytest.raises(ConfigError, match="nor available from the hub"):
        LoraAdapter.find(NAMED)
    assert asked == [("org/name", COMMIT)]
