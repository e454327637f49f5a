"""The named values of a trainable object: a torch module, or nested dicts and lists of arrays and
torch modules.

The name of a value in a torch module is its name in the `state_dict`. In nested dicts, the name
consists of the keys, joined with "/", followed by the name in a module. Torch and JAX are never
imported here: their objects exist only if they have been imported.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidWeights, NotTrainable, UnchangedWeights

_BFLOAT16 = np.dtype("V2")
_SHOWN = 5  # largest number of faults in a message
_THREADS = 4  # number of threads that compute a fingerprint; numpy releases Python's lock
# The number of 4-byte words of a value that are summed at once for a fingerprint.
_WORDS = 2**20
# The number of pieces, of `_WORDS` words each, that are summed together on a GPU. This takes 112
# MiB.
_PIECES = 8
# The odd factor by which the sum of a fingerprint is multiplied before the next words are added.
_FACTOR = -7046029254386353131
# The number of elements of a tensor that an operation processes at once if it needs further memory.
_AT_ONCE = 2**24
_KINDS = (("float", "bfloat"), ("int", "uint"), ("bool",), ("complex",))


def named_values(trainable: Any) -> dict[str, Any]:
    """Return references to the values of a trainable object.

    Args:
        trainable: A torch module, or nested dicts and lists of arrays and torch modules.

    Returns:
        The values by name.

    Raises:
        NotTrainable: The object is something else.
    """
    if _is_module(trainable):
        # A module may have state other than tensors (`get_extra_state`), which a learner does not
        # train.
        return {name: value for name, value in trainable.state_dict().items() if is_array(value)}

    values = dict[str, Any]()
    for name, container, key in _leaves(trainable):
        if _is_module(container[key]):
            for inner_name, value in named_values(container[key]).items():
                values[f"{name}/{inner_name}"] = value
        else:
            values[name] = container[key]
    return values


def set_values(trainable: Any, values: Mapping[str, Any]) -> None:
    """Replace values of a trainable object with new values of the same shapes, types and devices.

    Values on a GPU are copied to the addresses of the old values, which a CUDA graph may have
    recorded. Other values are replaced by reference, which takes no time and no memory, so `values`
    must not be changed afterwards.

    Args:
        trainable: The object, as for `named_values`.
        values: The new values by name. A value whose name is missing stays unchanged.
    """
    if _is_module(trainable):
        _set_values_of_module(trainable, values)
        return

    for name, container, key in list(_leaves(trainable)):
        current = container[key]
        if _is_module(current):
            prefix = f"{name}/"
            inner_values = {}
            for full_name in values:
                if full_name.startswith(prefix):
                    inner_values[full_name.removeprefix(prefix)] = values[full_name]
            set_values(current, inner_values)
        elif name in values and _is_tensor(current) and _on_gpu(current):
            _overwrite(current, values[name])
        elif name in values:
            container[key] = values[name]


def _set_values_of_module(module: Any, values: Mapping[str, Any]) -> None:
    """Replace values of a torch module, as `set_values` does."""
    tensors = dict(module.named_buffers(remove_duplicate=False))
    tensors |= module.named_parameters(remove_duplicate=False)
    torch = sys.modules["torch"]
    with torch.no_grad():
        for name, alias in module.state_dict().items():
            if name not in values:
                continue
            if name in tensors and not _on_gpu(alias):
                value = values[name]
                if value.is_inference():
                    # A guided chunk needs gradients, which tensors of inference mode do not have.
                    with torch.inference_mode(False):
                        value = value.clone()
                tensors[name].data = value
            else:
                _overwrite(alias, values[name])


def _overwrite(target: Any, value: Any) -> None:
    """Copy a tensor into the memory of another one."""
    with sys.modules["torch"].no_grad():
        if target.is_contiguous():
            copy(value, target)
        else:
            target.copy_(value)


@contextmanager
def evaluation_mode(trainable: Any) -> Iterator[None]:
    """Put torch modules into evaluation mode (no dropout, no batch statistics) within the context,
    and restore the mode of each inner module.
    """
    values = [trainable]
    if isinstance(trainable, dict | list):
        values = [container[key] for _, container, key in _leaves(trainable)]

    modules: list[Any] = []
    for value in values:
        if _is_module(value):
            modules += value.modules()

    modes = [module.training for module in modules]
    try:
        for module in modules:
            module.training = False
        yield
    finally:
        for module, mode in zip(modules, modes, strict=True):
            module.training = mode


def is_copied(trainable: Any) -> bool:
    """Return whether `set_values` copies into the memory of the old value, so that references to
    the old value see the new one.
    """
    return has_gpu_tensors(named_values(trainable))


def has_gpu_tensors(values: Mapping[str, Any]) -> bool:
    """Return whether one of the values is a torch tensor on a GPU."""
    return any(_is_tensor(value) and _on_gpu(value) for value in values.values())


def portable(value: Any) -> np.ndarray:
    """Convert a value to a numpy array that every process can read.

    A value on the CPU is not copied.

    A bfloat16, which numpy does not have, becomes two bytes of type `V2`, as `converted` and
    `dtype_name` expect.
    """
    if _is_tensor(value):
        value = on_host(value)
        if dtype_name(value) == "bfloat16":
            value = value.view(sys.modules["torch"].int16)
            return np.asarray(value).view(_BFLOAT16)
    array = np.asarray(value)
    return array.view(_BFLOAT16) if array.dtype.kind == "V" else array


def on_host(value: Any) -> Any:
    """Return a contiguous tensor in the memory of the host.

    It is copied only if it is on a GPU or not contiguous.
    """
    value = value.detach()
    if value.is_cuda:
        return copy(value, sys.modules["torch"].empty(value.shape, dtype=value.dtype))
    return value.cpu().contiguous()


def swap(first: Mapping[str, Any], second: Mapping[str, Any]) -> None:
    """Swap the values of contiguous tensors in place, with little additional memory.

    Args:
        first: The tensors by name.
        second: Tensors with the same names, shapes and devices. Names that share memory in `first`
            (see `are_apart`) must also share memory in `second`, as in a result of `completed`.
    """
    with sys.modules["torch"].no_grad():
        untied = {memory_of(name, value): (name, value) for name, value in first.items()}
        for name, value in untied.values():
            pieces = value.view(-1).split(_AT_ONCE)
            other_pieces = second[name].view(-1).split(_AT_ONCE)
            for piece, other_piece in zip(pieces, other_pieces, strict=True):
                before = piece.clone()
                piece.copy_(other_piece)
                other_piece.copy_(before)


def memory_of(name: str, value: Any) -> Any:
    """Return a key that is equal for tied values of a module, i.e. values in the same memory.

    Args:
        name: The name of the value, which is the key if the value has no memory.
        value: The value.
    """
    if not _is_tensor(value) or value.layout != sys.modules["torch"].strided or not value.numel():
        return name
    return value.device, value.data_ptr(), value.shape, value.stride(), value.dtype


def mapped(function: Callable[[Any], Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Apply a function to values.

    Args:
        function: The function, which is called once for tied values.
        values: The values by name.

    Returns:
        The results by name; tied values have the same result.
    """
    untied = {memory_of(name, value): value for name, value in values.items()}
    results = {memory: function(value) for memory, value in untied.items()}
    return {name: results[memory_of(name, value)] for name, value in values.items()}


def own_copy(value: Any) -> Any:
    """Return a copy of a value in memory that is not shared."""
    if _is_tensor(value):
        return value.detach().clone()
    return np.array(value) if isinstance(value, np.ndarray) else value  # JAX arrays never change.


def own_copies(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return copies of values in memory that is not shared.

    Args:
        values: The values by name.

    Returns:
        The copies by name; tied values have the same copy.
    """
    pairs: list[tuple[Any, Any]] = []

    def copied(value: Any) -> Any:
        if not _is_on_gpu_as_one_block(value):
            return own_copy(value)
        target = sys.modules["torch"].empty_like(value)
        pairs.append((value, target))
        return target

    copies = mapped(copied, values)
    _copy_together(pairs)
    return copies


def _copy_together(pairs: Iterable[tuple[Any, Any]]) -> None:
    """Copy tensors into other tensors on the same GPU.

    All tensors of the same types are copied in one operation. An operation for each of hundreds of
    tensors would delay inference calls, which use the same GPU and Python's lock.

    Args:
        pairs: Tensors to copy, each with the tensor into whose memory it is copied.
    """
    groups: dict[Any, tuple[list[Any], list[Any]]] = {}
    for source, target in pairs:
        kind = (target.device, source.dtype, target.dtype)
        sources, targets = groups.setdefault(kind, ([], []))
        sources.append(source.detach())
        targets.append(target)

    for sources, targets in groups.values():
        torch = sys.modules["torch"]
        with torch.no_grad():
            torch._foreach_copy_(targets, sources)


def _is_on_gpu_as_one_block(value: Any) -> bool:
    """Return whether a value is a tensor on a GPU, and is not sparse."""
    if not _is_tensor(value):
        return False
    return _on_gpu(value) and value.layout == sys.modules["torch"].strided


def converted(value: Any, current: Any) -> Any:
    """Convert a value to the type, precision and device of another one, in memory that is not
    shared.

    Numpy arrays in memory that nothing can write, such as Ray's objects, are not copied if
    `current` is on the CPU.

    Args:
        value: The value.
        current: The value with the type, precision and device of the result.
    """
    if _is_tensor(current):
        torch = sys.modules["torch"]
        if _is_tensor(value):
            tensor = value.detach()
        else:
            array = _unchanging(np.asarray(value))
            is_bfloat16 = array.dtype.kind == "V"
            with warnings.catch_warnings():
                # Torch warns about a read-only array, but nothing writes into this one.
                warnings.filterwarnings("ignore", message=".*not writ", category=UserWarning)
                tensor = torch.from_numpy(array.view(np.int16) if is_bfloat16 else array)
            tensor = tensor.view(torch.bfloat16) if is_bfloat16 else tensor

        if _is_on_gpu_as_one_block(current):
            return copy(tensor, current.new_empty(tensor.shape))
        new = tensor.to(current.device, current.dtype)
        is_shared = _is_tensor(value) and new.data_ptr() == value.data_ptr()
        return new.clone() if is_shared else new

    array = to_numpy(value)
    if isinstance(current, np.ndarray):
        array = _unchanging(array) if array.dtype == current.dtype else array.astype(current.dtype)
        array.flags.writeable = False
        return array
    return sys.modules["jax"].device_put(array.astype(current.dtype), current.sharding)


def _room_for(value: Any) -> Any:
    """Return contiguous memory for a value of the same shape, type and device."""
    torch = sys.modules["torch"]
    return torch.empty_like(value, memory_format=torch.contiguous_format)


def dtype_name(value: Any) -> str:
    """Return the name of a value's type without its library, such as "bfloat16"."""
    return "bfloat16" if value.dtype == _BFLOAT16 else str(value.dtype).rpartition(".")[2]


def is_array(value: Any) -> bool:
    """Return whether a value is an array or a tensor of any library."""
    return hasattr(value, "shape") and hasattr(value, "dtype")


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the name, the container and the key of each array or torch module."""
    if not isinstance(tree, dict | list):
        at = f" at {path.rstrip('/')!r}" if path else ""
        raise NotTrainable(
            f"trainable{at}: expected a torch module, or dicts and lists of arrays and modules, "
            f"got {type(tree).__name__}; or define parameters() and load_parameters()"
        )
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        if is_array(value) or _is_module(value):
            yield f"{path}{key}", tree, key
        else:
            yield from _leaves(value, f"{path}{key}/")


def _unchanging(array: np.ndarray) -> np.ndarray:
    """Return the array, or a copy if its memory is writable."""
    array = np.asarray(array, order="C")
    owner: Any = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return array.copy()
        owner = owner.base
    return array.view() if owner is None or memoryview(owner).readonly else array.copy()


def to_numpy(value: Any) -> np.ndarray:
    """Convert an array or tensor to a type that numpy has.

    A bfloat16 becomes a float32, of which it is the upper half.
    """
    array = portable(value)
    if array.dtype != _BFLOAT16:
        return array
    return (array.view(np.uint16).astype(np.uint32) << 16).view(np.float32)


def _is_tensor(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _is_module(value: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.nn.Module)


def to_host(groups: Iterable[Mapping[str, Any]], moved: list[tuple[Any, Any]]) -> None:
    """Move torch tensors from GPUs to the host.

    The tensors stay the same objects, with the same views and ties. They must not be read until
    `from_host` has been called.

    Args:
        groups: Groups of values by name. Values that are not on a GPU stay unchanged.
        moved: A list to which a pair is appended for each moved storage: the storage on the GPU,
            which is then empty, and its copy on the host. After an error, the list contains the
            storages that were moved before it.
    """
    tensors = []
    for values in groups:
        tensors += [value for value in values.values() if _is_tensor(value) and _on_gpu(value)]
    storages = {
        value.untyped_storage().data_ptr(): value.untyped_storage()
        for value in tensors
        if value.numel()
    }

    for storage in storages.values():
        if storage.resizable():  # otherwise the memory belongs to another library or process
            host_storage = sys.modules["torch"].UntypedStorage(storage.nbytes()).copy_(storage)
            moved.append((storage, host_storage))
            storage.resize_(0)


def _on_gpu(value: Any) -> bool:
    return bool(value.device.type != "cpu")


def from_host(moved: list[tuple[Any, Any]]) -> None:
    """Move tensors back to their GPUs, to other addresses.

    Args:
        moved: The list that `to_host` filled. It is emptied. After an error, it contains the
            storages that were not moved yet.
    """
    while moved:
        storage, host_storage = moved[-1]
        storage.resize_(host_storage.nbytes())
        storage.copy_(host_storage)
        moved.pop()


# The following functions work on a GPU at the same time as the inference calls of a policy: on
# other streams, and with reusable pinned memory.
#
# All threads share torch's default stream, on which the inference calls are queued. A thread that
# waits for its work on that stream also waits for all calls that were queued before it, and CUDA
# executes copies of pageable memory in the same order.

# The size of each of two buffers, bytes. One buffer is filled while the other is copied.
_BUFFER_BYTES = 2**25
_LOCK = threading.Lock()
# Device -> the stream of copies, and two buffers of pinned memory, each with the event at the end
# of its last copy.
_COPY_BUFFERS: dict[Any, tuple[Any, list[tuple[Any, Any]]]] = {}
# Device -> the stream of `beside_acts`. Each device has only one stream, since torch reuses freed
# memory only on the stream on which it was allocated.
_BESIDE: dict[Any, Any] = {}


@contextmanager
def beside_acts(device: Any, *, waits: bool = True) -> Iterator[None]:
    """Within the context, run this thread's GPU work on a stream other than the stream of the
    inference calls.

    The end of the context waits for the work. Memory that is allocated within the context may be
    reused in the next context as soon as it is freed. Work of other streams on that memory must be
    complete by then.

    Args:
        device: The GPU; None for the current one. The context does nothing for "cpu", or while the
            process uses no GPU.
        waits: Whether the work begins after the work that is already queued on the current stream,
            which may belong to inference calls. If False, the work may read only memory that
            earlier contexts have written, and memory to which nothing writes any more.
    """
    torch = sys.modules.get("torch")
    if torch is None or device == "cpu" or not torch.cuda.is_initialized():
        yield
        return
    device = torch.device("cuda", torch.cuda.current_device()) if device is None else device
    with _LOCK:
        stream = _BESIDE.get(device) or _BESIDE.setdefault(device, torch.cuda.Stream(device))
    if waits:
        stream.wait_stream(torch.cuda.current_stream(device))
    try:
        with torch.cuda.stream(stream):
            yield
    finally:
        stream.synchronize()


def copy(source: Any, target: Any) -> Any:
    """Copy a tensor into another tensor.

    If only one of the tensors is on a GPU, the copy begins after the work that this thread has
    queued on that GPU, and is complete when this function returns.

    Args:
        source: The tensor to copy.
        target: A contiguous tensor of the same shape.

    Returns:
        `target`.
    """
    torch = sys.modules["torch"]
    with torch.no_grad():
        if source.is_cuda == target.is_cuda or not target.numel():
            return target.copy_(source)

        on_gpu = source if source.is_cuda else target
        device, dtype = on_gpu.device, on_gpu.dtype
        length = _BUFFER_BYTES // dtype.itemsize  # number of elements that are copied at once
        with _LOCK, torch.cuda.device(device):
            stream, buffers = _copy_buffers(device)
            stream.wait_stream(torch.cuda.current_stream(device))
            source_pieces = source.reshape(-1).split(length)
            target_pieces = target.view(-1).split(length)
            try:
                with torch.cuda.stream(stream):
                    for number, (source_piece, target_piece) in enumerate(
                        zip(source_pieces, target_pieces, strict=True)
                    ):
                        memory, event = buffers[number % 2]
                        event.synchronize()
                        pinned = memory[: len(source_piece) * dtype.itemsize].view(dtype)
                        pinned.copy_(source_piece, non_blocking=True)
                        if target_piece.is_cuda:
                            target_piece.copy_(pinned, non_blocking=True)
                        event.record(stream)

                        if not target_piece.is_cuda:
                            event.synchronize()
                            target_piece.copy_(pinned)
            finally:
                # After this function returns, the memory may be freed or used on other streams.
                stream.synchronize()
    return target


def _copy_buffers(device: Any) -> tuple[Any, list[tuple[Any, Any]]]:
    """Return the stream of copies of a device, and its two buffers with their events."""
    torch = sys.modules["torch"]
    if device not in _COPY_BUFFERS:
        # Tensors that are made in inference mode could not be written outside of it.
        with torch.inference_mode(mode=False):
            buffers = [torch.empty(_BUFFER_BYTES, dtype=torch.uint8).pin_memory() for _ in range(2)]
        events = [torch.cuda.Event() for _ in buffers]
        _COPY_BUFFERS[device] = torch.cuda.Stream(device), list(zip(buffers, events, strict=True))
    return _COPY_BUFFERS[device]


# The following functions check that pushed values fit the values of a policy, and compute a digest.


def accepted(
    current: Mapping[str, Any], pushed: Mapping[str, Any], *, partial: bool = False
) -> dict[str, Any]:
    """Check pushed values, and convert them to the types and devices of the current values.

    Only the types, devices and shapes of the current values are read, except where pushed values
    are not finite. Names whose current values are tied receive the same value, namely the last one
    that was pushed.

    Args:
        current: The current values of the policy, by name.
        pushed: The new values, by name: numpy or JAX arrays or torch tensors, on any device.
        partial: Whether names may be missing, as in a push of some layers.

    Returns:
        The converted values by name, including names that are tied to a pushed name.

    Raises:
        InvalidWeights: A name is unknown or missing, or a value has another shape or kind of type,
            or is neither finite nor equal to the current value.
    """
    require_fit(current, pushed, partial=partial)
    memories = {name: memory_of(name, value) for name, value in current.items()}
    last_names = {memories[name]: name for name in pushed}
    new = _all_converted(current, pushed, last_names)

    values = {name: new[memory] for memory, name in last_names.items()}
    finite = _all_finite_tensors(values)
    finite |= {name: _is_finite(value) for name, value in values.items() if not finite.get(name)}
    finite |= _fetched({name: result for name, result in finite.items() if _is_tensor(result)})

    # Constants of a module, such as attention masks, may be infinite. A learner pushes them
    # unchanged.
    faults: list[str] = []
    for name, is_finite in finite.items():
        if not is_finite and not _is_equal(new[memories[name]], current[name]):
            faults.append(f"{name!r}: expected finite values, got NaN or infinity")
    _refuse(faults)
    return {name: new[memory] for name, memory in memories.items() if memory in new}


def _all_converted(
    current: Mapping[str, Any], pushed: Mapping[str, Any], names: Mapping[Any, str]
) -> dict[Any, Any]:
    """Convert pushed values as `converted` does, but in few operations if they are already on the
    GPU.

    Args:
        current: The current values of the policy, by name.
        pushed: The new values, by name.
        names: The names of the values to convert, by any keys.

    Returns:
        The converted values by the same keys.
    """
    new: dict[Any, Any] = {}
    pairs: list[tuple[Any, Any]] = []
    for key, name in names.items():
        value, current_value = pushed[name], current[name]
        on_gpus = _is_on_gpu_as_one_block(value) and _is_on_gpu_as_one_block(current_value)
        if on_gpus and value.device == current_value.device:
            new[key] = _room_for(current_value)
            pairs.append((value, new[key]))
        else:
            new[key] = converted(value, current_value)
    _copy_together(pairs)
    return new


def completed(
    current: Mapping[str, Any],
    new: Mapping[str, Any],
    *,
    allow_same: bool = False,
    in_place: bool = False,
) -> dict[str, Any]:
    """Return the values of a new version: the new values, and the current values of all other
    names.

    Args:
        current: The current values of the policy, by name.
        new: The new values, from `accepted`.
        allow_same: Whether all new values may be equal to the current values.
        in_place: Whether the memory of the current values will be overwritten. If so, the current
            values in the result are copies.

    Returns:
        The values by name, in the order of `current`.

    Raises:
        UnchangedWeights: All values are equal to the current values, and `allow_same` is not set.
    """
    if not allow_same and all(_is_equal(value, current[name]) for name, value in new.items()):
        raise UnchangedWeights(
            f"weights: expected values that differ from the policy's, got {len(new)} equal ones; "
            "push the parameters that the optimizer changes, or allow equal values with "
            "allow_same=True"
        )

    missing = {name: value for name, value in current.items() if name not in new}
    if in_place:
        missing = own_copies(missing)
    all_values = {**new, **missing}
    return {name: all_values[name] for name in current}


def are_apart(values: Mapping[str, Any]) -> bool:
    """Return whether `swap` can exchange all tensors.

    This requires that they are contiguous and share no memory, except for tied names of the same
    tensor.
    """
    untied = {memory_of(name, value): value for name, value in values.items() if value.numel()}
    if not all(value.is_contiguous() for value in untied.values()):
        return False

    spans: list[tuple[str, int, int]] = []
    for value in untied.values():
        begin = value.data_ptr()
        spans.append((str(value.device), begin, begin + value.nbytes))
    spans.sort()
    for (device, _, end), (next_device, next_begin, _) in itertools.pairwise(spans):
        if device == next_device and end > next_begin:
            return False
    return True


def require_fit(
    current: Mapping[str, Any], pushed: Mapping[str, Any], *, partial: bool = False
) -> None:
    """Check the names, shapes and types of pushed values.

    Args:
        current: The current values of the policy, by name.
        pushed: The pushed values, or their `vlagents_ray.weights.safetensors.ValueSpec`, by name.
        partial: Whether names may be missing.

    Raises:
        InvalidWeights: A name is unknown or missing, or a value has another shape or kind of type.
    """
    faults: list[str] = []
    for name in pushed:
        if name not in current:
            example = next(iter(current), "")
            faults.append(
                f"{name!r}: expected one of the policy's {len(current)} names, such as "
                f"{example!r}; push no others"
            )
    if not partial:
        missing = [name for name in current if name not in pushed]
        faults += [f"{name!r}: missing; push it, or set partial=True" for name in missing]
    elif not pushed:
        faults.append("no value: push at least one")

    # No variable of this frame may contain a pushed value: an error that refers to the frame would
    # keep the learner's memory open.
    for name in pushed:
        if name in current:
            fault = _misfit(name, pushed[name], current[name])
            if fault:
                faults.append(fault)
    _refuse(faults)


def fingerprint(values: Mapping[str, Any]) -> str:
    """Return a digest of values on any device: 32 hexadecimal characters that depend on names,
    shapes, types and all bytes.

    The digest detects any accidental difference. Each word is multiplied by two odd numbers, which
    depend on the word's index, and the products are summed modulo 2**64. A value on a GPU is summed
    on that GPU. A cryptographic digest would need all values on the host, and take a few seconds
    for a large model.
    """
    on_gpus = {
        name: value for name, value in values.items() if _is_tensor(value) and _on_gpu(value)
    }
    host_names = [name for name in values if name not in on_gpus]
    with ThreadPoolExecutor(_THREADS, "fingerprint") as threads:
        host_sums = threads.map(_sums, (values[name] for name in host_names))
        sums = dict(zip(host_names, host_sums, strict=True))
    sums |= _sums_on_gpus(on_gpus)

    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(values):
        shape = tuple(values[name].shape)
        digest.update(f"{name} {dtype_name(values[name])} {shape}\n".encode())
        digest.update(sums[name].tobytes())
    return digest.hexdigest()


def _refuse(faults: list[str]) -> None:
    """Raise `InvalidWeights` if there are faults."""
    if faults:
        more = f"; and {len(faults) - _SHOWN} more" if len(faults) > _SHOWN else ""
        raise InvalidWeights(
            f"weights, of which nothing was changed: {'; '.join(faults[:_SHOWN])}{more}"
        )


def _misfit(name: str, pushed: Any, current: Any) -> str | None:
    """Describe how a pushed value's shape or kind of type differs; None if the value fits."""
    if not is_array(pushed):
        return f"{name!r}: expected an array, got {type(pushed).__name__}"
    if tuple(pushed.shape) != tuple(current.shape):
        return f"{name!r}: expected shape {tuple(current.shape)}, got {tuple(pushed.shape)}"
    if _kind(dtype_name(pushed)) != _kind(dtype_name(current)):
        return f"{name!r}: expected {dtype_name(current)}, got {dtype_name(pushed)}"
    return None


def _kind(dtype: str) -> Any:
    """Return the kind of a type, such as floating point: a value may be converted to another
    precision, but not to another kind.
    """
    for prefixes in _KINDS:
        if dtype.startswith(prefixes):
            return prefixes
    return dtype


def _is_finite(value: Any) -> Any:
    """Return whether all numbers are finite, as a bool or a tensor with one bool."""
    if not dtype_name(value).startswith(("float", "bfloat", "complex")) or 0 in value.shape:
        return True
    if isinstance(value, np.ndarray):
        with np.errstate(over="ignore", invalid="ignore"):
            # Minimum and maximum are checked, since an array of booleans would take a quarter of
            # the value's memory.
            return bool(np.isfinite(value.min()) and np.isfinite(value.max()))
    if not _is_tensor(value):
        return bool(sys.modules["jax"].numpy.isfinite(value).all())
    if value.is_complex():
        value = sys.modules["torch"].view_as_real(value)
    # Minimum and maximum need no additional memory, as above.
    return sys.modules["torch"].stack(value.aminmax()).isfinite().all()


def _all_finite_tensors(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return True for the name of each torch tensor of real numbers that is known to be finite.

    The largest absolute values of all tensors of a device and type are computed together. Several
    operations for each of hundreds of tensors would delay inference calls, which use the same GPU
    and Python's lock.
    """
    groups: dict[Any, list[str]] = {}
    for name, value in values.items():
        if _is_tensor(value) and value.is_floating_point() and value.numel():
            groups.setdefault((value.device, value.dtype), []).append(name)

    finite: dict[str, Any] = {}
    for names in groups.values():
        torch = sys.modules["torch"]
        largest = torch._foreach_norm([values[name].detach() for name in names], float("inf"))
        are_finite = on_host(torch.stack(largest)).isfinite().tolist()
        for name, is_finite in zip(names, are_finite, strict=True):
            if is_finite:
                finite[name] = True
    return finite


def _is_equal(new: Any, current: Any) -> bool:
    """Return whether all numbers of two values of the same shape and type are equal."""
    if isinstance(new, np.ndarray):
        return np.array_equal(new, current)
    if not _is_tensor(new):
        return bool((new == current).all())

    must_move = new.is_cuda and not current.is_cuda
    new_pieces = new.reshape(-1).split(_AT_ONCE)
    current_pieces = current.reshape(-1).split(_AT_ONCE)
    for new_piece, current_piece in zip(new_pieces, current_pieces, strict=True):
        other_piece = converted(current_piece, new_piece) if must_move else current_piece
        if not bool((new_piece == other_piece).all()):
            return False
    return True


@functools.cache
def _keys(count: int) -> np.ndarray:
    """Return pseudo-random odd numbers, (2, count) int64, from the finalizer of splitmix64."""
    key = np.arange(1, 2 * count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        key = (key ^ (key >> np.uint64(shift))) * np.uint64(factor)
    return ((key ^ (key >> np.uint64(31))) | np.uint64(1)).view(np.int64).reshape(2, count)


def _sums(value: Any) -> np.ndarray:
    """Return the two sums of a value on the host, (2,) int64."""
    data = np.ascontiguousarray(portable(value)).reshape(-1).view(np.uint8)
    if len(data) % 4:
        data = np.pad(data, (0, -len(data) % 4))
    words = data.view(np.int32)

    sums: np.ndarray = np.zeros(2, np.int64)
    for begin in range(0, len(words), _WORDS):
        piece = words[begin : begin + _WORDS].astype(np.int64)
        sums = sums * _FACTOR + _keys(_WORDS)[:, : len(piece)] @ piece
    return sums


def _sums_on_gpus(values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the two sums of each tensor on a GPU, as `_sums` does, (2,) int64 by name.

    Pieces of the same length are summed together, whichever tensors they belong to. Several
    operations for each of hundreds of tensors would delay inference calls, which use the same GPU
    and Python's lock. The host combines the sums of the pieces.
    """
    names = {memory_of(name, value): name for name, value in values.items()}
    pieces_by_device: dict[Any, dict[int, list[tuple[Any, Any]]]] = {}
    for memory, name in names.items():
        words = _words_on_gpu(values[name])
        for piece in words.split(_WORDS) if len(words) else ():
            pieces_by_length = pieces_by_device.setdefault(words.device, {})
            pieces_by_length.setdefault(len(piece), []).append((memory, piece))

    sums = {memory: np.zeros(2, np.int64) for memory in names}
    for pieces_by_length in pieces_by_device.values():
        # The last piece of a tensor may be shorter.
        pieces = []
        for length in sorted(pieces_by_length, reverse=True):
            pieces += pieces_by_length[length]
        piece_sums = _piece_sums([piece for _, piece in pieces])
        for (memory, _), sums_of_piece in zip(pieces, piece_sums, strict=True):
            sums[memory] = sums[memory] * _FACTOR + sums_of_piece
    return {name: sums[memory_of(name, value)] for name, value in values.items()}


def _words_on_gpu(value: Any) -> Any:
    """Return the bytes of a tensor on a GPU as words, int32. The last word is padded with zeros."""
    torch = sys.modules["torch"]
    data = value.detach().reshape(-1).contiguous().view(torch.uint8)
    if len(data) % 4 or data.storage_offset() % 4:
        data = torch.nn.functional.pad(data, (0, -len(data) % 4))
    return data.view(torch.int32)


def _piece_sums(pieces: Sequence[Any]) -> np.ndarray:
    """Return the sums of pieces of tensors on one GPU.

    Args:
        pieces: Words, (at most `_WORDS`,) int32 each. Pieces of the same length are consecutive.

    Returns:
        The two sums of each piece, (N, 2) int64.
    """
    torch = sys.modules["torch"]
    empty = pieces[0].new_empty((2, _WORDS), dtype=torch.int64)
    keys = copy(torch.from_numpy(_keys(_WORDS)), empty)

    first_sums, second_sums = [], []
    for length, group in itertools.groupby(pieces, len):
        pieces_of_length = list(group)
        at_once = _PIECES * _WORDS // length
        for begin in range(0, len(pieces_of_length), at_once):
            rows = torch.stack(pieces_of_length[begin : begin + at_once])
            first_sums.append((rows * keys[0, :length]).sum(1))
            second_sums.append((rows * keys[1, :length]).sum(1))

    sums = torch.stack([torch.cat(first_sums), torch.cat(second_sums)], 1)
    return np.asarray(on_host(sums))


def _fetched(tensors: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return small tensors of equal shapes as arrays.

    A single copy from each device waits for all of its tensors.
    """
    arrays: dict[str, np.ndarray] = {}
    for device in {tensor.device for tensor in tensors.values()}:
        names = [name for name, tensor in tensors.items() if tensor.device == device]
        stacked = on_host(sys.modules["torch"].stack([tensors[name] for name in names])).numpy()
        arrays.update(zip(names, stacked, strict=True))
    return arrays
