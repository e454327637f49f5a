"""Where a checkpoint lies, and whether a model really holds what is in it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

STEP = "{step}"  # in a checkpoint's name
_INDEX = ".safetensors.index.json"
_COMPARED = 64  # elements of each tensor: enough to tell trained weights from random ones
_LISTED = 8


def at_step(name: str, step: int | str | None) -> str:
    """The name of a checkpoint with its step filled in, if it has a place for one."""
    return name if step is None else name.replace(STEP, str(step))


def find_checkpoint(name: str, step: int | None = None, needs: Iterable[str] = ()) -> Path:
    """The folder or file of a checkpoint: a path on this machine, or a hub id, downloaded if it is not cached.

    `step` replaces `{step}` in `name`, with leading zeros to six digits where only that exists. `needs` are files (or
    glob patterns) that a folder must hold.
    Raises `ConfigError` when there is no such checkpoint, or a file is missing.
    """
    names = [at_step(name, digits) for digits in (step, f"{step or 0:06d}")]
    name = next((one for one in names if Path(one).expanduser().exists()), names[0])
    path = Path(name).expanduser()
    if not path.exists():
        if name.startswith((".", "/", "~")) or name.count("/") != 1:
            raise ConfigError(f"checkpoint {name!r}: no such file or folder; have {_beside(path)}")
        path = _from_hub(name)
    if path.is_dir():
        missing = [pattern for pattern in needs if not any(path.glob(pattern))]
        if missing:
            raise ConfigError(
                f"checkpoint {path}: misses {missing}, has {sorted(p.name for p in path.iterdir())[:20]}; "
                f"is it a checkpoint of this family, and whole?"
            )
    return path


def _beside(path: Path) -> str:
    """What lies where the checkpoint was expected, for a message."""
    parent = next((p for p in path.parents if p.is_dir()), Path("/"))
    names = sorted(p.name for p in parent.iterdir())
    shown = ", ".join(names[:_LISTED]) + (" …" if len(names) > _LISTED else "")
    return f"in {parent}: {shown or 'nothing'}"


def _from_hub(name: str) -> Path:
    hub = require("huggingface_hub")
    try:
        return Path(hub.snapshot_download(name))
    except Exception as error:  # of a dozen kinds: no such id, no access, no network, offline mode
        raise ConfigError(
            f"checkpoint {name!r}: neither a path here nor to be had from the hub ({type(error).__name__}); "
            f"download it to a folder and name that, or check the id, the network and your token"
        ) from error


class SavedTensors:
    """The tensors of a checkpoint on disk by name, each read when it is asked for."""

    def __init__(self, readers: Mapping[str, Callable[[], Any]]) -> None:
        self._readers = readers

    @classmethod
    def of(cls, path: Path) -> SavedTensors:
        """Those of a .safetensors file, or of a folder with one, or with several and their index."""
        files = [path] if path.is_file() else _safetensors(path)
        opened = [require("safetensors").safe_open(str(file), framework="pt") for file in files]
        return cls({key: _Reader(file, key) for file in opened for key in file.keys()})  # noqa: SIM118 - no mapping

    def __iter__(self) -> Iterator[str]:
        return iter(self._readers)

    def __getitem__(self, name: str) -> Any:
        return self._readers[name]()

    def renamed(self, rename: Callable[[str], str | None]) -> SavedTensors:
        """The same under other names; those for which there is None are left out."""
        named = {rename(key): reader for key, reader in self._readers.items()}
        return SavedTensors({key: reader for key, reader in named.items() if key is not None})


class _Reader:
    def __init__(self, file: Any, key: str) -> None:
        self._file, self._key = file, key

    def __call__(self) -> Any:
        return self._file.get_tensor(self._key)


def _safetensors(folder: Path) -> list[Path]:
    for index in sorted(folder.glob(f"*{_INDEX}")):
        names = set(json.loads(index.read_text(encoding="utf-8"))["weight_map"].values())
        absent = sorted(name for name in names if not (folder / name).is_file())
        if absent:
            raise ConfigError(f"checkpoint {folder}: {index.name} names {absent}, which are missing; copy all of it")
        return [folder / name for name in sorted(names)]
    found = sorted(folder.glob("*.safetensors"))
    if len(found) != 1:
        raise ConfigError(f"checkpoint {folder}: got {[p.name for p in found]}, want one .safetensors file or an index")
    return found


def require_loaded(model: Any, saved: SavedTensors | Mapping[str, Any]) -> None:
    """Raise `ConfigError` unless every parameter and saved buffer of `model` is what the checkpoint holds.

    Names and shapes are compared, and 64 elements of each tensor, up to the model's dtype. A parameter that is
    tied to another one need not be there itself. Some libraries go on with random weights where they could not
    load theirs: what such a policy does looks like a bad policy, and costs its user a week.
    """
    torch = require("torch")
    names = set(saved)
    state = model.state_dict(keep_vars=True)
    tied: dict[int, set[str]] = {}
    for name, tensor in state.items():
        tied.setdefault(tensor.data_ptr() if tensor.numel() else id(tensor), set()).add(name)
    absent, different = [], []
    for name, tensor in state.items():
        source = next((n for n in (name, *sorted(tied.get(tensor.data_ptr(), ()))) if n in names), None)
        if source is None:
            absent.append(name)
        elif not _same(torch, tensor.detach(), saved[source]):
            different.append(name)
    if absent or different:
        raise ConfigError(
            f"the checkpoint does not fill the model: {len(absent)} parameters are not in it {absent[:_LISTED]}, "
            f"{len(different)} are not what it holds {different[:_LISTED]}; it has {len(names)}, the model "
            f"{len(state)}: is it a checkpoint of this model and this version of its library?"
        )


def require_filled(params: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raise `ConfigError` unless the nested `params` are arrays of just the names and shapes that are `wanted`.

    For JAX, whose loaders hand out what they read: what is an array there came from the checkpoint.
    """
    have, want = dict(_leaves(params)), dict(_leaves(wanted))
    absent = sorted(name for name in want if not hasattr(have.get(name), "__array__"))
    unknown = sorted(set(have) - set(want))
    different = sorted(name for name in want if name not in absent and have[name].shape != want[name].shape)
    if absent or unknown or different:
        raise ConfigError(
            f"the checkpoint does not fill the model: {len(absent)} parameters are not in it {absent[:_LISTED]}, "
            f"{len(different)} have another shape {different[:_LISTED]}, {len(unknown)} are not the model's "
            f"{unknown[:_LISTED]}: is it a checkpoint of this model and this version of its library?"
        )


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def _same(torch: Any, have: Any, want: Any) -> bool:
    if have.shape != want.shape:
        return False
    step = max(1, have.numel() // _COMPARED)
    ours = have.reshape(-1)[::step].cpu()
    return bool(torch.equal(ours, want.reshape(-1)[::step].cpu().to(ours.dtype)))
