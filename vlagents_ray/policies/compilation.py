"""Pure cores of a model, compiled for a few batch sizes, and compared with the eager pass before they are used.

A core is a function of tensors alone, whose first dimension is the batch and whose other dimensions are fixed; it
returns such a tensor, or a tuple of them. `torch.compile` makes one program for each core and batch size, without graph
breaks; on a GPU it is captured in a CUDA graph. All programs are made while the policy loads. A batch between two sizes
is padded with copies of its last row, whose results are dropped; one for which there is no program, as its rows have
another shape, or as it is too large, runs eagerly.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Literal

from vlagents_ray.errors import ConfigError, NotTrainable
from vlagents_ray.policies.loading import report_uncompiled
from vlagents_ray.registry import require

logger = logging.getLogger(__name__)

_TORCH = "TORCHINDUCTOR_CACHE_DIR"


def keep_torch_programs() -> None:
    """Keep torch's programs in the user's cache, unless `TORCHINDUCTOR_CACHE_DIR` names another folder.

    Torch writes its own choice, /tmp/torchinductor_USER, into that variable when it first needs it.
    """
    chosen = Path(os.environ.get(_TORCH, "")).name
    if (not chosen or chosen.startswith("torchinductor_")) and (folder := _folder("torch")) is not None:
        os.environ[_TORCH] = str(folder)


def keep_jax_programs(jax: Any, platform: str) -> None:
    """Keep JAX's programs for a GPU in the user's cache, unless `JAX_COMPILATION_CACHE_DIR` is set."""
    if platform == "cpu":
        return
    chosen = getattr(jax.config, "jax_compilation_cache_dir", "an older JAX, without this setting")
    if chosen is None and (folder := _folder("jax")) is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))


def _folder(library: str) -> Path | None:
    """Return the folder of a library's programs; None, with a warning, if it cannot be made."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "vlagents_ray" / "programs" / library
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        logger.warning("compiled programs are not kept for the next start: %s", error)
        return None
    return folder


Quantization = Literal["int8", "float8"]

_CONFIGS: dict[Quantization, str] = {"int8": "Int8WeightOnlyConfig", "float8": "Float8WeightOnlyConfig"}


def quantize(policy: Any, kind: Quantization) -> None:
    """Replace the weights of all linear layers of a loaded policy's network, in place.

    Args:
        policy: The policy; its `network` names the attribute that is a torch module, on the device of its forward pass.
        kind: "int8", with a scale for each output of a layer, or "float8", of four bits of exponent and three of
            mantissa.

    Raises:
        ConfigError: The policy names no network, or torchao cannot quantize it here.
        MissingDependency: torchao is not installed.
    """
    if policy.network is None:
        raise ConfigError(f"quantization: {type(policy).__name__} does not offer it; leave it out")
    torchao = require("torchao.quantization")
    try:
        torchao.quantize_(attrgetter(policy.network)(policy), getattr(torchao, _CONFIGS[kind])())
    except (RuntimeError, AttributeError, NotImplementedError, AssertionError) as error:
        raise ConfigError(
            f"quantization {kind!r}: torchao cannot use it here ({type(error).__name__}: {error}); try the other one, "
            f"or dtype: bfloat16"
        ) from error


def require_whole(kind: Quantization | None) -> None:
    """Raise `NotTrainable` if weights are quantized, since a learner's weights are not."""
    if kind is not None:
        raise NotTrainable(f"quantization {kind!r}: weights of 8 bits cannot be replaced by a learner's; leave it out")


_WARM_UP = 3  # calls before the capture, in which libraries allocate their own memory
_EMPTY = "CUDA Graph is empty"  # in torch's warning


class CaptureLock:
    """Keeps acts, of which it is the context, and pushes of weights out of the captures of this process.

    A call that waits for a whole device ends any capture on it, with an error on both threads, whatever the mode of the
    capture. A waiting capture goes before the next act, but waits for a push without delaying acts.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._acting: set[int] = set()  # threads
        self._capturing = False  # or about to
        self.pushes = threading.RLock()  # the context of a push, within which its thread may also act

    def __enter__(self) -> None:
        """Begin an act: wait for the end of a capture. None begins until its end; a thread enters once at a time."""
        with self._changed:
            self._changed.wait_for(lambda: not self._capturing)
            self._acting.add(threading.get_ident())

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._acting.discard(threading.get_ident())
            self._changed.notify_all()

    @contextmanager
    def capture(self) -> Iterator[None]:
        """Wait for running acts and pushes, and block new ones within this context."""
        if threading.get_ident() in self._acting:
            raise RuntimeError("a CUDA graph cannot be captured within an act; capture it in Agent.initialize")
        with self.pushes:
            try:
                with self._changed:
                    self._capturing = True
                    self._changed.wait_for(lambda: not self._acting)
                yield
            finally:
                with self._changed:
                    self._capturing = False
                    self._changed.notify_all()


CAPTURES = CaptureLock()


class CudaGraph:
    """A function, captured once with inputs of one shape; calls copy their inputs to where the graph reads them.

    It is captured here, and not by `torch.compile`, whose graphs belong to the thread that captured them: a checkpoint
    is loaded on another thread than the one that acts with it.
    """

    replays: ClassVar[int] = 0  # of all graphs of this process

    def __init__(self, function: Callable[..., Any], tensors: Sequence[Any]) -> None:
        """Capture a function of tensors on one GPU without other effects; raises `RuntimeError` if that fails."""
        torch = require("torch")
        self._inputs, device = [tensor.clone() for tensor in tensors], tensors[0].device
        # The stream is named, since torch's own one is on the device of the first capture of the process. The current
        # one is entered again, since `torch.cuda.graph` leaves its own if the capture fails.
        own, current = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        with torch.cuda.device(device), torch.cuda.stream(current):
            own.wait_stream(current)
            with torch.cuda.stream(own):
                for _ in range(_WARM_UP):
                    function(*self._inputs)
            current.wait_stream(own)
            self._graph = torch.cuda.CUDAGraph()
            with CAPTURES.capture(), warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                # Other threads still prepare acts; their calls must not end the capture.
                with torch.cuda.graph(self._graph, stream=own, capture_error_mode="thread_local"):
                    self._result = function(*self._inputs)
        if any(_EMPTY in str(warning.message) for warning in said):
            raise RuntimeError("the CUDA graph is empty: all work ran on another stream, or on another device")

    def __call__(self, *tensors: Any) -> Any:
        for held, tensor in zip(self._inputs, tensors, strict=True):
            held.copy_(tensor, non_blocking=True)
        self._graph.replay()
        CudaGraph.replays += 1
        result = self._result
        return tuple(one.clone() for one in result) if isinstance(result, tuple) else result.clone()


CompileMode = bool | Literal["require"]

# Largest error of a row of a core's result, as a share of the row's norm, by the coarsest type that it computes with:
# compiled sums run in another order, and merged kernels keep float32 where the eager pass rounds between them.
TOLERANCE = {"float32": 1e-3, "float16": 1e-2, "bfloat16": 5e-2}
_SHOWN = 300  # characters of a compiler's error in the log


class CompilationFailed(Exception):
    """A core could not be compiled, or its program computes something else than the eager pass."""


class Compilation:
    """The compiled cores of one policy."""

    backend: ClassVar[str] = "inductor"  # of torch.compile

    def __init__(self, mode: CompileMode) -> None:
        self.mode = mode
        self.sizes: list[int] = []  # batch sizes for which all cores are compiled, ascending
        self.building: int | None = None  # the batch size whose programs are being made
        self.cores: list[Core] = []
        if mode:
            keep_torch_programs()

    def core(self, name: str, function: Callable[..., Any], rows: int | None = None) -> Callable[..., Any]:
        """Return a function's compiled form, or the function itself if nothing is compiled.

        Args:
            name: The core's name in messages.
            function: The core. Its arguments are tensors on the model's device. It must read nothing that changes but
                the model's weights, whose values may change.
            rows: The most rows of a call, if that does not follow from the batch size, such as those of a planner's
                candidates: the core then has one program, for so many rows. None: those of each batch size.
        """
        if not self.mode:
            return function
        self.cores.append(Core(self, name, function, rows))
        return self.cores[-1]

    def add_size(self, size: int, forward: Callable[[], object]) -> None:
        """Compile all cores for a batch size, larger than those before, and compare them twice with the eager pass.

        If that fails, batches of this size use the programs of the next larger size, or run eagerly.

        Args:
            size: The number of rows.
            forward: Runs a forward pass of that many rows, of other values each time.

        Raises:
            ConfigError: A core failed, and the mode is "require".
        """
        began, self.building = time.monotonic(), size
        try:
            forward()  # makes the programs
            forward()  # compares them after all of them were made
        except CompilationFailed as failure:
            for core in self.cores:
                core.drop(size)
            if self.mode == "require":
                raise ConfigError(
                    f"compile: require: {failure}; with `compile: true` it would run without compilation"
                ) from failure
            logger.warning("not compiled for %d rows: %s", size, failure)
            report_uncompiled(f"{size} rows: {failure}")
        else:
            self.sizes.append(size)
            logger.info("compiled for %d rows in %.1f s", size, time.monotonic() - began)
        finally:
            self.building = None


class Core:
    """A core with its programs."""

    def __init__(self, owner: Compilation, name: str, function: Callable[..., Any], rows: int | None) -> None:
        self._owner, self._name, self._function, self._rows = owner, name, function, rows
        self._programs: dict[int, Callable[..., Any]] = {}
        self._shapes: dict[int, list[Any]] = {}  # of a row of each argument, for each program

    def __call__(self, *tensors: Any) -> Any:
        rows, building = len(tensors[0]), self._owner.building
        tensors = tuple(map(_of_one_kind, tensors))
        if building is not None and rows == (self._rows or building):
            return self._compared(tensors)
        sizes = self._owner.sizes if self._rows is None else [self._rows]
        size = next((size for size in sizes if size >= rows and size in self._programs), None)
        if size is None or building is not None or self._shapes[size] != _row_shapes(tensors):
            return self._function(*tensors)
        result = self._programs[size](*(_padded(tensor, size) for tensor in tensors))
        return tuple(one[:rows] for one in result) if isinstance(result, tuple) else result[:rows]

    def drop(self, size: int) -> None:
        """Drop the program for a batch size, and one for a number of rows unless another batch size proved it."""
        self._programs.pop(size if self._rows is None or self._owner.sizes else self._rows, None)

    def _compared(self, tensors: Sequence[Any]) -> Any:
        """Return the eager result, once the program is made and its result is near it."""
        wanted, size = self._function(*tensors), len(tensors[0])
        try:
            if size not in self._programs:
                self._programs[size], self._shapes[size] = self._compiled(tensors), _row_shapes(tensors)
            error = _largest_error(self._programs[size](*tensors), wanted)
        except Exception as failure:  # compilers raise any error
            said = " ".join(str(failure).split())[:_SHOWN]
            raise CompilationFailed(f"{self._name!r}: {type(failure).__name__}: {said}") from failure
        limit = _tolerance([*tensors, *_each(wanted)])
        if not error <= limit:  # also if it is not a number
            raise CompilationFailed(f"{self._name!r}: its results are off by {error:.2g}, want at most {limit:g}")
        return wanted

    def _compiled(self, tensors: Sequence[Any]) -> Callable[..., Any]:
        """Return the program for tensors of these shapes.

        It is made with other values than those of a comparison: a CUDA graph that missed a part of the core returns the
        results of the values with which it was captured.
        """
        function, torch = self._function, require("torch")
        tensors = [torch.zeros_like(tensor) for tensor in tensors]

        def core(*tensors: Any) -> Any:
            return function(*tensors)

        # torch counts the programs of each code object, and gives up after eight of them
        core.__code__ = core.__code__.replace(co_name=f"{self._name}_{len(tensors[0])}".replace(" ", "_"))
        program: Callable[..., Any] = torch.compile(core, fullgraph=True, dynamic=False, backend=self._owner.backend)
        program(*tensors)
        return CudaGraph(program, tensors) if tensors[0].device.type == "cuda" else program


def _of_one_kind(tensor: Any) -> Any:
    """Return the tensor as programs were made for it: contiguous, and an inference tensor in inference mode.

    `torch.compile` makes another program for tensors of another kind.
    """
    return tensor.contiguous() if tensor.is_inference() else tensor.clone().contiguous()


def _padded(tensor: Any, size: int) -> Any:
    missing = size - len(tensor)
    return require("torch").cat([tensor, tensor[-1:].expand(missing, *tensor.shape[1:])]) if missing else tensor


def _row_shapes(tensors: Sequence[Any]) -> list[Any]:
    return [tensor.shape[1:] for tensor in tensors]


def _each(result: Any) -> Sequence[Any]:
    return result if isinstance(result, tuple) else (result,)


def _largest_error(got: Any, wanted: Any) -> float:
    """Return the largest relative error of a row, by its Euclidean norm, among all tensors of the results."""
    errors = []
    for one, other in zip(_each(got), _each(wanted), strict=True):
        off, size = (part.float().reshape(len(part), -1).norm(dim=1) for part in (one - other, other))
        errors.append((off / size.clamp(min=1e-12)).max())
    return float(require("torch").stack(errors).max())  # which is NaN if any of them is


def _tolerance(tensors: Sequence[Any]) -> float:
    """Return the tolerance of the coarsest type among tensors."""
    types = {str(tensor.dtype).removeprefix("torch.") for tensor in tensors}
    return max(TOLERANCE.get(name, 0.0) for name in types) or TOLERANCE["float32"]
