"""Functions to find checkpoints, and to check that a model holds all tensors of its checkpoint."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

log = logging.getLogger(__name__)

STEP = "{step}"  # the placeholder in a checkpoint's name
# The settings of a policy that select its weights.
CHECKPOINT, CHECKPOINT_STEP = "checkpoint", "checkpoint_step"
_INDEX = ".safetensors.index.json"
# Number of compared elements of each tensor, enough to distinguish trained weights from random
# ones.
_COMPARED = 64
_LISTED = 8


def at_step(name: str, step: int | str | None) -> str:
    """Return the name of a checkpoint with its step filled in, if the name has a placeholder."""
    return name if step is None else name.replace(STEP, str(step))


def resolved(settings: Mapping[str, Any]) -> str | None:
    """Return the checkpoint in a policy's settings, with its step filled in."""
    checkpoint = settings.get(CHECKPOINT)
    if not isinstance(checkpoint, str):
        return checkpoint
    return at_step(checkpoint, settings.get(CHECKPOINT_STEP))


def checkpoint_name(settings: Mapping[str, Any]) -> str | None:
    """Return a name for the weights that a policy's settings select, which differs for each step:
    the checkpoint with its step. None if the settings contain neither.
    """
    checkpoint, step = settings.get(CHECKPOINT), settings.get(CHECKPOINT_STEP)
    if step is None or (isinstance(checkpoint, str) and STEP in checkpoint):
        return resolved(settings)
    return f"step {step}" if checkpoint is None else f"{checkpoint} at step {step}"


_used: ContextVar[list[Path] | None] = ContextVar("_used", default=None)


@contextmanager
def used_checkpoints() -> Iterator[list[Path]]:
    """Yield a list of the paths that `find_checkpoint` finds in this context.

    A path inside of an earlier path replaces the earlier path.
    """
    paths: list[Path] = []
    token = _used.set(paths)
    try:
        yield paths
    finally:
        _used.reset(token)


def find_checkpoint(name: str, step: int | None = None, needs: Iterable[str] = ()) -> Path:
    """Return the folder or the file of a checkpoint, which is downloaded if necessary.

    Args:
        name: A path on this machine; or a hub id, optionally with a commit, a tag or a branch:
            `org/name@REVISION`.
        step: Replaces `{step}` in `name`. It is padded with zeros to six digits if only that path
            exists.
        needs: Files (or glob patterns) that a folder must contain.

    Raises:
        ConfigError: There is no such checkpoint, or a file is missing.
    """
    candidates = [at_step(name, digits) for digits in (step, f"{step or 0:06d}")]
    name = next(
        (candidate for candidate in candidates if Path(candidate).expanduser().exists()),
        candidates[0],
    )
    path = Path(name).expanduser()
    if not path.exists():
        if name.startswith((".", "/", "~")) or name.partition("@")[0].count("/") != 1:
            raise ConfigError(
                f"checkpoint {name!r}: no such file or folder; this folder has {_beside(path)}"
            )
        path = _from_hub(name)

    if path.is_dir():
        missing = [pattern for pattern in needs if not any(path.glob(pattern))]
        if missing:
            names = sorted(entry.name for entry in path.iterdir())
            raise ConfigError(
                f"checkpoint {path}: expected {missing} in it, got {names[:20]}; is it a complete "
                "checkpoint of this family?"
            )

    used = _used.get()
    if used is not None and path not in used:
        used[:] = [*(outer for outer in used if not _holds(outer, path)), path]
    return path


def _holds(folder: Path, path: Path) -> bool:
    """Return whether a path is in a folder, or is the folder itself.

    Links are followed, such as a link `last` to the folder of a training step.
    """
    if not folder.is_dir():
        return False
    # A file in the hub's cache is a link to a file outside of the link's folder.
    resolved = (path.resolve(), path.parent.resolve() / path.name)
    return any(folder.resolve() in (target, *target.parents) for target in resolved)


def _beside(path: Path) -> str:
    """Return a text that lists the contents of the nearest existing folder above a missing path."""
    parent = next((folder for folder in path.parents if folder.is_dir()), Path("/"))
    names = sorted(entry.name for entry in parent.iterdir())
    shown = ", ".join(names[:_LISTED]) + (" …" if len(names) > _LISTED else "")
    return f"in {parent}: {shown or 'nothing'}"


def _from_hub(name: str) -> Path:
    hub = require("huggingface_hub")
    repository, at, commit = name.partition("@")
    if at and not commit:
        raise ConfigError(
            f"checkpoint {name!r}: expected a commit, a tag or a branch after the @, got nothing; "
            "name one"
        )

    try:
        path = Path(hub.snapshot_download(repository, revision=commit or None))
    # The error may be of many classes: unknown id, no access, no network, offline mode.
    except Exception as error:
        if type(error).__name__ == "RevisionNotFoundError":
            raise ConfigError(
                f"checkpoint {name!r}: expected a commit, a branch or a tag of {repository}, got "
                f"{commit!r}; its branches and tags are {_revisions(hub, repository)}"
            ) from error
        raise ConfigError(
            f"checkpoint {name!r}: neither a path on this machine nor available from the hub "
            f"({type(error).__name__}); download it to a folder and name that, or check the id "
            "(org/name or org/name@COMMIT), the network and your token"
        ) from error
    log.info("checkpoint %s: commit %s", name, path.name)
    return path


def _revisions(hub: Any, repository: str) -> str:
    try:
        refs = hub.HfApi().list_repo_refs(repository)
        names = [ref.name for ref in (*refs.branches, *refs.tags)]
    except Exception as error:  # noqa: BLE001 - the message is about another error
        return f"not known here ({type(error).__name__})"
    return ", ".join(names[:_LISTED]) + (", …" if len(names) > _LISTED else "")


class SavedTensors:
    """The tensors of a checkpoint on disk by name. Each tensor is read when it is accessed."""

    def __init__(self, readers: Mapping[str, Callable[[], Any]]) -> None:
        self._readers = readers

    @classmethod
    def open(cls, path: Path) -> SavedTensors:
        """Open a .safetensors file, or a folder with one such file, or with several files and
        their index.
        """
        files = [path] if path.is_file() else _safetensors(path)
        readers: dict[str, Callable[[], Any]] = {}
        for file in files:
            opened = require("safetensors").safe_open(str(file), framework="pt")
            readers |= {name: partial(opened.get_tensor, name) for name in opened.keys()}  # noqa: SIM118 - no mapping
        return cls(readers)

    def __iter__(self) -> Iterator[str]:
        return iter(self._readers)

    def __getitem__(self, name: str) -> Any:
        return self._readers[name]()


def _safetensors(folder: Path) -> list[Path]:
    for index in sorted(folder.glob(f"*{_INDEX}")):
        names = set(json.loads(index.read_text(encoding="utf-8"))["weight_map"].values())
        absent = sorted(name for name in names if not (folder / name).is_file())
        if absent:
            raise ConfigError(
                f"checkpoint {folder}: {index.name} names {absent}, which are missing; copy all of "
                "it"
            )
        return [folder / name for name in sorted(names)]

    files = sorted(folder.glob("*.safetensors"))
    if len(files) != 1:
        raise ConfigError(
            f"checkpoint {folder}: expected one .safetensors file or an index, got "
            f"{[file.name for file in files]}"
        )
    return files


def require_loaded(model: Any, saved: SavedTensors | Mapping[str, Any]) -> None:
    """Check that a model has the values of its checkpoint.

    Some libraries continue with random weights if they cannot load the weights of the checkpoint.
    The result looks like a bad policy, and is hard to diagnose.

    The check compares the names and shapes of all parameters and saved buffers, and 64 elements of
    each tensor in the model's dtype. A parameter that is tied to another parameter may be missing.
    """
    torch = require("torch")
    saved_names = set(saved)
    state = model.state_dict(keep_vars=True)

    # Parameters that share memory are tied.
    tied: dict[int, set[str]] = {}
    for name, tensor in state.items():
        address = tensor.data_ptr() if tensor.numel() else id(tensor)
        tied.setdefault(address, set()).add(name)

    absent, different = [], []
    for name, tensor in state.items():
        names = (name, *sorted(tied.get(tensor.data_ptr(), ())))
        source = next((candidate for candidate in names if candidate in saved_names), None)
        if source is None:
            absent.append(name)
        elif not _same(torch, tensor.detach(), saved[source]):
            different.append(name)

    if absent or different:
        raise ConfigError(
            f"the checkpoint does not fill the model: {len(absent)} parameters are not in it "
            f"{absent[:_LISTED]}, {len(different)} are not what it holds {different[:_LISTED]}; "
            f"it has {len(saved_names)}, the model {len(state)}: is it a checkpoint of this model "
            "and this version of its library?"
        )


def from_pretrained(cls: Any, path: Path, **options: Any) -> Any:
    """Load a model with transformers, `cls.from_pretrained(path, **options)`.

    Since version 5, transformers renames parameters when it reads them. `require_loaded`, which
    compares names, cannot check such models. The check uses the parameters without values that
    transformers reports.
    """
    try:
        model, loading_info = cls.from_pretrained(path, output_loading_info=True, **options)
    except (OSError, RuntimeError, ValueError) as error:
        # The files are incomplete or in another format.
        raise ConfigError(
            f"checkpoint {path}: {cls.__name__} does not load: {str(error).strip()[:500]}"
        ) from error

    lacks = {}
    for key in ("missing_keys", "mismatched_keys"):
        if loading_info[key]:
            lacks[key] = sorted(map(str, loading_info[key]))[:_LISTED]
    if lacks:
        raise ConfigError(
            f"checkpoint {path}: it does not fill {cls.__name__}: {lacks}; is it a checkpoint of "
            "this model?"
        )
    return model


def require_filled(params: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Check that nested parameters have exactly the expected names and shapes.

    This check is for JAX models, whose loaders return only values from the checkpoint.
    """
    have, want = dict(_leaves(params)), dict(_leaves(expected))
    absent = sorted(name for name in want if not hasattr(have.get(name), "__array__"))
    unknown = sorted(set(have) - set(want))
    different = sorted(
        name for name in want if name not in absent and have[name].shape != want[name].shape
    )
    if absent or unknown or different:
        raise ConfigError(
            f"the checkpoint does not fill the model: {len(absent)} parameters are not in it "
            f"{absent[:_LISTED]}, {len(different)} have another shape {different[:_LISTED]}, "
            f"{len(unknown)} are not the model's {unknown[:_LISTED]}: is it a checkpoint of this "
            "model and this version of its library?"
        )


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def _same(torch: Any, have: Any, want: Any) -> bool:
    """Return whether two tensors have the same shape, and equal elements in a sample."""
    if have.shape != want.shape:
        return False

    step = max(1, have.numel() // _COMPARED)
    ours = have.reshape(-1)[::step].cpu()
    return bool(torch.equal(ours, want.reshape(-1)[::step].cpu().to(ours.dtype)))
