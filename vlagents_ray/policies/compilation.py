"""The compilation of a model's cores, which are compared with the eager pass before they are used.

A core is a function of tensors alone. The first dimension of its arguments is the batch, and their
other dimensions are fixed. It returns one tensor, or a tuple of tensors, with the same first
dimension.

On a GPU, a core is captured in a CUDA graph for each of a few batch sizes. The program that
`torch.compile` makes from it, without graph breaks, is captured in a second graph, and the faster
graph is used. On a CPU, only the program of `torch.compile` is made. All programs are made while
the policy loads.

A batch between two sizes is padded with copies of its last row, whose results are dropped. A batch
whose rows have another shape, or that is larger than all sizes, has no program and runs eagerly.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
import warnings
from bisect import insort
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Literal

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.loading import report_uncompiled
from vlagents_ray.registry import require

logger = logging.getLogger(__name__)

_TORCH = "TORCHINDUCTOR_CACHE_DIR"


def keep_torch_programs() -> None:
    """Keep the programs of `torch.compile` in the user's cache, for the next start.

    If the user has set `TORCHINDUCTOR_CACHE_DIR`, nothing is changed. Torch writes its default,
    /tmp/torchinductor_USER, into that variable when it first needs it.
    """
    chosen = Path(os.environ.get(_TORCH, "")).name
    if chosen and not chosen.startswith("torchinductor_"):
        return
    folder = _folder("torch")
    if folder is not None:
        os.environ[_TORCH] = str(folder)


def keep_jax_programs(jax: Any, platform: str) -> None:
    """Keep JAX's programs for a GPU in the user's cache, for the next start.

    If the user has set `JAX_COMPILATION_CACHE_DIR`, nothing is changed.
    """
    if platform == "cpu":
        return
    chosen = getattr(jax.config, "jax_compilation_cache_dir", "an older JAX, without this setting")
    if chosen is not None:
        return
    folder = _folder("jax")
    if folder is not None:
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


Quantization = Literal["int8", "float8", "float8_dynamic"]


def quantize(policy: Any, kind: Quantization) -> None:
    """Replace the weights of all linear layers of a loaded policy's network, in place.

    Args:
        policy: The policy; its `network` names the attribute that is a torch module, on the device
            of its forward pass.
        kind: "int8", with a scale for each output of a layer, or "float8", of four bits of exponent
            and three of mantissa, for the weights alone. "float8_dynamic" also computes products in
            float8, with a scale for each row of the weights and of the activations.

    Raises:
        ConfigError: The policy names no network, or torchao cannot quantize it here.
        MissingDependency: torchao is not installed.
    """
    if policy.network is None:
        raise ConfigError(f"quantization: {type(policy).__name__} does not offer it; leave it out")
    torchao = require("torchao.quantization")
    try:
        if kind == "float8_dynamic":
            per_row = torchao.PerRow()
            config = torchao.Float8DynamicActivationFloat8WeightConfig(granularity=per_row)
        else:
            config = getattr(torchao, f"{kind.capitalize()}WeightOnlyConfig")()
        torchao.quantize_(attrgetter(policy.network)(policy), config)
    except (RuntimeError, AttributeError, NotImplementedError, AssertionError) as error:
        raise ConfigError(
            f"quantization {kind!r}: torchao cannot use it on this machine "
            f"({type(error).__name__}: {error}); try another type, or dtype: bfloat16"
        ) from error


# Priority of the streams of inference calls and their graphs; all other streams have priority 0.
ACT_PRIORITY = -1
_WARM_UP = 3  # number of calls before the capture, in which libraries allocate their own memory
_EMPTY = "CUDA Graph is empty"  # part of torch's warning


class CaptureLock:
    """Blocks forward passes and pushes of weights while this process captures a CUDA graph.

    The lock itself is the context manager of a forward pass. A call that synchronizes a whole
    device aborts any capture on that device, with an error on both threads, whatever the mode of
    the capture. A waiting capture has priority over the next forward pass. While it waits for a
    push, forward passes continue.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._acting: set[int] = set()  # identifiers of the threads in forward passes
        self._capturing = False  # whether a capture runs, or waits for forward passes to end
        # The context of a push. A thread may also run forward passes within it.
        self.pushes = threading.RLock()

    def __enter__(self) -> None:
        """Begin a forward pass, after the end of a running capture.

        No capture begins before the pass ends. A thread may not enter twice.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._capturing)
            self._acting.add(threading.get_ident())

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._acting.discard(threading.get_ident())
            self._changed.notify_all()

    @contextmanager
    def capture(self) -> Iterator[None]:
        """Wait for the end of running forward passes and pushes, and block new ones within this
        context.
        """
        if threading.get_ident() in self._acting:
            raise RuntimeError(
                "a CUDA graph cannot be captured within an act; capture it in Agent.initialize"
            )
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


class GraphMemory:
    """The memory and the stream of all CUDA graphs of a policy on one device.

    A replay may overwrite the results of all other graphs. That is safe, since the replays of a
    policy are serial and on one stream, and a result is copied before the next one.
    """

    def __init__(self, device: Any) -> None:
        torch = require("torch")
        self._device = device
        self.pool = torch.cuda.graph_pool_handle()
        # Torch's own stream for captures belongs to the device of the first capture in the process.
        # The kernels of a graph keep the priority of the stream.
        self.stream = torch.cuda.Stream(device, priority=ACT_PRIORITY)
        self._bytes_before = self._reserved()

    def taken(self) -> int:
        """Return the number of bytes that the process has reserved on the device since the first
        graph.
        """
        return self._reserved() - self._bytes_before

    def _reserved(self) -> int:
        torch = require("torch")
        # Emptying the cache would abort a capture of another thread.
        with CAPTURES.pushes:
            # Only the memory of tensors and graphs remains reserved.
            torch.cuda.empty_cache()
            return int(torch.cuda.memory_reserved(self._device))


class CudaGraph:
    """A function that is captured once with inputs of one shape.

    Each call copies its inputs into the tensors from which the graph reads. The graph is not made
    by `torch.compile`, whose graphs belong to the thread that captured them: one thread loads a
    checkpoint, and another one runs it.
    """

    replays: ClassVar[int] = 0  # number of replays of all graphs of this process

    def __init__(
        self, function: Callable[..., Any], inputs: Sequence[Any], memory: GraphMemory | None = None
    ) -> None:
        """Capture a function.

        Args:
            function: A function of tensors on one GPU, without side effects. The object keeps a
                reference to it, since the graph reads the function's constants.
            inputs: The tensors from which each replay reads, and into which a call copies its
                inputs.
            memory: The memory of the policy's graphs; with None, memory is allocated for this graph
                alone.

        Raises:
            RuntimeError: The capture failed.
        """
        torch = require("torch")
        device = inputs[0].device
        memory = memory or GraphMemory(device)
        self._function, self._inputs = function, inputs

        # Enter the current stream again: if the capture fails, `torch.cuda.graph` leaves its
        # stream as the current one.
        stream, current = memory.stream, torch.cuda.current_stream(device)
        with torch.cuda.device(device), torch.cuda.stream(current):
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):
                    function(*inputs)
            current.wait_stream(stream)

            # A capture begins with a wait for the device, and empties torch's cache. After this
            # synchronization, both take little time, so that inference calls of other policies are
            # blocked only during the capture.
            stream.synchronize()
            with CAPTURES.pushes:
                torch.cuda.empty_cache()

            self._graph = torch.cuda.CUDAGraph()
            with CAPTURES.capture(), warnings.catch_warnings(record=True) as caught_warnings:
                warnings.simplefilter("always")
                # Other threads continue to prepare requests. Their CUDA calls must not abort the
                # capture.
                with torch.cuda.graph(
                    self._graph, memory.pool, stream, capture_error_mode="thread_local"
                ):
                    self._result = function(*inputs)

        if any(_EMPTY in str(warning.message) for warning in caught_warnings):
            raise RuntimeError(
                "the CUDA graph is empty: all work ran on another stream, or on another device"
            )

    def __call__(self, *tensors: Any) -> Any:
        """Return copies of the results for at most as many rows as were captured."""
        rows = len(tensors[0])
        for number, tensor in enumerate(tensors):
            self.hold(number, tensor)

        self._graph.replay()
        CudaGraph.replays += 1
        results = tuple(result[:rows].clone() for result in _each(self._result))
        return results if isinstance(self._result, tuple) else results[0]

    def hold(self, number: int, tensor: Any) -> Any:
        """Copy an argument into the tensor from which the graph reads it, unless it is that tensor.

        Args:
            number: The index of the argument.
            tensor: The argument, with at most as many rows as were captured.

        Returns:
            The first rows of that tensor, as many as the argument has.
        """
        graph_input, rows = self._inputs[number], len(tensor)
        held = graph_input[:rows]
        if held.data_ptr() == tensor.data_ptr():
            return held
        held.copy_(tensor, non_blocking=True)
        if rows < len(graph_input):
            graph_input[rows:].copy_(tensor[-1:], non_blocking=True)
        return held

    def replay_ms(self) -> float:
        """Replay the graph with its last inputs, and return the time on the GPU, milliseconds."""
        torch = require("torch")
        stream = torch.cuda.current_stream(self._inputs[0].device)
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record(stream)
        self._graph.replay()
        end.record(stream)
        end.synchronize()
        return float(begin.elapsed_time(end))


CompileMode = bool | Literal["auto", "graphs", "max", "require"]


def uses_torch_compile(mode: CompileMode) -> bool:
    """Return whether a mode makes programs with `torch.compile`.

    "auto" never resolves to such a mode.
    """
    return mode not in (False, "auto", "graphs")


# With "max", torch measures several kernels for each product and uses the fastest. This mode of
# torch makes no CUDA graphs, since this module captures each core itself.
_MAX = "max-autotune-no-cudagraphs"


# The error of a row in a core's result is measured relative to the row's norm. Compiled programs
# sum in another order, and merged kernels keep float32 values where the eager pass rounds. The
# resulting error depends on the checkpoint. It is therefore compared with the measured error of the
# eager core with smaller batches and other roundings. The errors of torch's programs were half as
# large.
# Largest accepted error of a program, as a multiple of the eager core's measured error.
_ROUNDINGS = 2.0
_LEAST = 1e-3  # error that is always accepted
# The largest error that is ever accepted, for each coarsest type in which a core computes. In
# bfloat16, ten steps of a flow with 3.5 billion parameters differ by 0.067 from the same eager pass
# with fewer rows.
TOLERANCE = {"float32": _LEAST, "float16": 1e-2, "bfloat16": 1e-1}
_SHOWN = 300  # number of characters of a compiler's error in the log
# A compiled program replaces the graph of the eager core if its replay takes at most this share of
# the time: a smaller gain may be noise, and only the graph computes as the eager pass does.
_FASTER = 0.97
_REPLAYS = 5  # replays of each graph, of which the shortest is used

# The tiers: the eager core, and torch's program. On a GPU, both are in graphs.
_GRAPH, _COMPILED = "CUDA graph", "torch.compile"


class Compilation:
    """The compiled cores of one policy."""

    backend: ClassVar[str] = "inductor"  # backend of torch.compile

    def __init__(self, mode: CompileMode) -> None:
        """Set what is compiled.

        Args:
            mode: False compiles nothing. "graphs" captures eager cores in CUDA graphs. True also
                uses `torch.compile`. "max" is like True, and torch chooses the kernels by
                measuring them. "require" is like True, and each failure is an error. "auto" is
                resolved when the policy is loaded.
        """
        self.mode = mode
        # The number of rows of the core whose regions run their own compiled programs now,
        # otherwise None.
        self.rows_of_regions: int | None = None
        self.sizes: list[int] = []  # batch sizes for which a core is compiled, ascending
        self.building: int | None = None  # the batch size whose programs are being made
        # The tier of the parts that a core calls; None outside of the context `parts`.
        self.tier_of_parts: str | None = None
        self.cores: list[Core] = []
        self.memories: dict[Any, GraphMemory] = {}  # device -> memory of its graphs
        self.graph_bytes = 0  # memory of the CUDA graphs on all devices
        if uses_torch_compile(mode):
            keep_torch_programs()

    def core(
        self,
        name: str,
        function: Callable[..., Any],
        rows: int | None = None,
        parts: Sequence[Any] = (),
        *,
        by_regions: bool = False,
    ) -> Callable[..., Any]:
        """Return a function's compiled form, or the function itself if nothing is compiled.

        Args:
            name: The core's name in messages.
            function: The core. Its arguments are tensors on the model's device. Apart from its
                arguments, the only changing values that it may read are the model's weights.
            rows: The largest number of rows of a call, if that number does not follow from the
                batch size, as for the candidates of a planner. The core then has one program, for
                that number of rows. None makes a program for each batch size.
            parts: The cores that the function calls. It becomes one CUDA graph with all of them. On
                a CPU, only the parts are compiled.
            by_regions: Whether `torch.compile` makes a program of each region that the function
                calls (see `region`), instead of one program of the whole function.
        """
        if not self.mode:
            return function
        self.cores.append(Core(self, name, function, rows, parts, by_regions=by_regions))
        return self.cores[-1]

    def region(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that is compiled separately in cores with `by_regions`.

        A region is a part of a core that it calls many times with other weights, such as a layer of
        a model. All calls with the same shapes share one program. Compiling a region takes much
        less time than compiling the whole core.

        Args:
            function: The function, which has no side effects. Its arguments are tensors, None, and
                torch modules of the same structure.
        """
        return Region(self, function) if self.mode else function

    @contextmanager
    def regions(self, rows: int) -> Iterator[None]:
        """Let regions run their compiled programs within the context, for cores with this many
        rows.
        """
        self.rows_of_regions = rows
        try:
            yield
        finally:
            self.rows_of_regions = None

    def compiled(self, name: str, function: Callable[..., Any], device: Any) -> Callable[..., Any]:
        """Return the program of `torch.compile` for a function. Torch makes it in the first call.

        Args:
            name: Identifies the function and its number of rows. Torch makes at most eight programs
                for a code object, so each name gets a separate code object.
            function: The function.
            device: The device of its arguments.
        """
        torch = require("torch")

        def core(*args: Any, **kwargs: Any) -> Any:
            return function(*args, **kwargs)

        core.__code__ = core.__code__.replace(co_name=name.replace(" ", "_"))
        options: dict[str, Any] = {}
        if self.mode == "max" and self.backend == "inductor":
            options |= torch._inductor.list_mode_options(_MAX)
        # Torch before 2.8 cannot omit guards. A CUDA graph of the program has no guards.
        has_filter = hasattr(torch.compiler, "skip_guard_on_globals_unsafe")
        if has_filter and device.type != "cuda":
            options["guard_filter_fn"] = _without_state_of_the_process
        program: Callable[..., Any] = torch.compile(
            core, fullgraph=True, dynamic=False, backend=self.backend, options=options or None
        )
        return program

    def add_size(self, size: int, forward: Callable[[], object]) -> None:
        """Make the programs of all cores for a batch size.

        The results of each program are compared twice with the results of the eager pass. Sizes are
        added from the largest to the smallest, so that the graphs of smaller sizes fit into the
        memory of larger ones. A core whose programs all fail uses the program of the next larger
        size, or runs eagerly.

        Args:
            size: The number of rows.
            forward: Runs a forward pass with that many rows, with different values in each call.

        Raises:
            ConfigError: A program failed, and the mode is "require".
        """
        began = time.monotonic()
        self.building = size
        try:
            forward()  # The first pass makes the programs.
            forward()  # The second pass compares them after all of them were made.
        finally:
            self.building = None

        failures: list[str] = []
        for core in self.cores:
            failures += core.settle(size)
        if failures and self.mode == "require":
            raise ConfigError(
                f"compile: require: {'; '.join(failures)}; with `compile: true` these parts run "
                "uncompiled"
            )
        if failures:
            report_uncompiled(f"{size} rows: {'; '.join(failures)}")

        tiers = {core.name: core.tier(size) for core in self.cores}
        compiled = {name: tier for name, tier in tiers.items() if tier is not None}
        if compiled:
            if size not in self.sizes:
                insort(self.sizes, size)
            seconds = time.monotonic() - began
            logger.info("compiled for %d rows in %.1f s: %s", size, seconds, compiled)
        self.graph_bytes = sum(memory.taken() for memory in self.memories.values())

    @contextmanager
    def parts(self, tier: str) -> Iterator[None]:
        """Let cores call a tier of their parts within the context.

        Args:
            tier: `_GRAPH` for eager functions, or `_COMPILED` for torch's programs.
        """
        self.tier_of_parts = tier
        try:
            yield
        finally:
            self.tier_of_parts = None

    def drop_graphs(self) -> None:
        """Free all CUDA graphs, which read weights at fixed addresses.

        `add_size` makes them again.
        """
        if not self.memories:
            return
        self.sizes.clear()
        self.memories.clear()
        self.graph_bytes = 0
        for core in self.cores:
            core.drop_graphs()


class Core:
    """A core and its programs."""

    def __init__(
        self,
        owner: Compilation,
        name: str,
        function: Callable[..., Any],
        rows: int | None,
        parts: Sequence[Core],
        *,
        by_regions: bool = False,
    ) -> None:
        self.name, self._by_regions = name, by_regions
        self._owner, self._function, self._rows, self._parts = owner, function, rows, parts
        # Number of rows -> tier -> program; only one tier remains after `settle`.
        self._programs: dict[int, dict[str, Any]] = {}
        # Number of rows -> shapes and types of the rows of each argument.
        self._kinds: dict[int, list[Any]] = {}
        self._compiled: dict[int, Callable[..., Any]] = {}  # number of rows -> torch's program
        # Inputs of the graph with the most rows; other graphs read their first rows.
        self._graph_inputs: list[Any] = []
        # The failures at the batch size whose programs are being made.
        self._failures: list[str] = []

    def __call__(self, *tensors: Any) -> Any:
        rows, owner = len(tensors[0]), self._owner
        if not owner.mode or (self._parts and tensors[0].device.type != "cuda"):
            return self._function(*tensors)

        # The program of another core, which calls this core as a part, is being made.
        if owner.tier_of_parts is not None:
            if owner.tier_of_parts == _COMPILED:
                return self._compiled[rows](*map(_of_one_kind, tensors))
            return self._function(*tensors)

        # The programs of a batch size are being made.
        if owner.building is not None:
            if rows == (self._rows or owner.building):
                return self._compared(list(map(_of_one_kind, tensors)))
            return self._function(*tensors)

        size = self._size_for(rows)
        if size is None or self._kinds[size] != _row_kinds(tensors):
            return self._function(*tensors)

        [program] = self._programs[size].values()
        if isinstance(program, CudaGraph):
            return program(*tensors)
        result = program(*(_padded(_of_one_kind(tensor), size) for tensor in tensors))
        results = tuple(tensor[:rows] for tensor in _each(result))
        return results if isinstance(result, tuple) else results[0]

    def hold(self, number: int, tensor: Any) -> Any:
        """Return a large argument of later calls as a tensor from which the CUDA graph reads
        directly.

        These calls do not copy the argument, and the caller may change its values between them.

        Args:
            number: The index of the argument.
            tensor: The argument.

        Returns:
            A tensor with the same values, which the caller passes instead of the argument; without
            a graph, the argument itself.
        """
        size = self._size_for(len(tensor)) if self._owner.mode else None
        if size is None or self._owner.building is not None:
            return tensor
        [program] = self._programs[size].values()
        if not isinstance(program, CudaGraph):
            return tensor
        if self._kinds[size][number] != _row_kinds([tensor])[0]:
            return tensor
        return program.hold(number, tensor)

    def _size_for(self, rows: int) -> int | None:
        """Return the size whose program computes a number of rows; None if the core runs
        eagerly.
        """
        sizes = self._owner.sizes if self._rows is None else [self._rows]
        return next((size for size in sizes if size >= rows and size in self._programs), None)

    def tier(self, size: int) -> str | None:
        """Return the tier of the program for a batch size; None if there is no program."""
        return next(iter(self._programs.get(self._rows or size, ())), None)

    def drop_graphs(self) -> None:
        """Free the graphs and their inputs.

        Torch's programs are kept, since they do not read fixed addresses.
        """
        self._programs.clear()
        self._kinds.clear()
        self._graph_inputs.clear()

    def settle(self, size: int) -> list[str]:
        """Keep the fastest program for a batch size, and return the reasons why other programs
        failed.
        """
        size = self._rows or size
        failures, self._failures = self._failures, []
        programs = self._programs.get(size, {})
        if len(programs) > 1:
            # Both programs are graphs. Their replays alternate, so that other work on the GPU slows
            # both equally.
            graph, compiled = programs.values()
            graph_ms = compiled_ms = math.inf
            for _ in range(_REPLAYS):
                graph_ms = min(graph_ms, graph.replay_ms())
                compiled_ms = min(compiled_ms, compiled.replay_ms())
            logger.info(
                "%r, %d rows: %.3f ms eager, %.3f ms compiled",
                self.name,
                size,
                graph_ms,
                compiled_ms,
            )
            del programs[_GRAPH if compiled_ms <= _FASTER * graph_ms else _COMPILED]
        if not programs:
            self._programs.pop(size, None)
        return failures

    def _compared(self, tensors: Sequence[Any]) -> Any:
        """Make the programs, keep the ones with correct results, and return the eager result."""
        eager_result, size = self._function(*tensors), len(tensors[0])
        is_first = size not in self._programs
        if is_first:
            self._programs[size], self._kinds[size] = {}, _row_kinds(tensors)
            tiers = self._tiers(size, tensors[0].device)
        else:
            tiers = list(self._programs[size])

        programs = self._programs[size]
        for tier in tiers:
            try:
                program = self._made(tier, tensors) if is_first else programs[tier]
                error = _largest_error(program(*tensors), eager_result)
                limit = _LEAST if error <= _LEAST else self._limit(tensors, eager_result)
            except Exception as failure:  # noqa: BLE001 - compilers raise any error
                reason = f"{type(failure).__name__}: {' '.join(str(failure).split())[:_SHOWN]}"
            else:
                programs[tier] = program
                if error <= limit:
                    continue
                # The error is above the limit, or NaN.
                reason = (
                    f"expected results within {limit:g} of the uncompiled ones, got a difference "
                    f"of {error:.2g}"
                )
            programs.pop(tier, None)
            self._failures.append(f"{self.name!r} by {tier}: {reason}")
        return eager_result

    def _tiers(self, size: int, device: Any) -> list[str]:
        """Return the tiers for which programs of a batch size are made."""
        tiers = [_GRAPH] if device.type == "cuda" else []
        are_parts_compiled = all(_COMPILED in core._programs.get(size, ()) for core in self._parts)
        if self._owner.mode != "graphs" and are_parts_compiled:
            tiers.append(_COMPILED)
        return tiers

    def _limit(self, tensors: Sequence[Any], eager_result: Any) -> float:
        """Return the largest error that a correct program may have on these inputs.

        It is measured with the eager core, which runs with each half of the batch and with other
        roundings. Smaller batches alone often change nothing, since the same kernels compute each
        row in the same way.
        """
        from vlagents_ray.policies.rounding import OtherRounding

        rounding, rows = OtherRounding(), len(tensors[0])
        sizes = [size for size in (rows // 2, rows - rows // 2) if size]
        inputs_of_halves = zip(*(tensor.split(sizes) for tensor in tensors), strict=True)
        with self._owner.parts(_GRAPH):
            halves = [_each(rounding.run(self._function, *inputs)) for inputs in inputs_of_halves]
        results = tuple(map(require("torch").cat, zip(*halves, strict=True)))

        types = rounding.types | {_type(tensor) for tensor in tensors}
        tolerance = max(TOLERANCE.get(name, 0.0) for name in types) or TOLERANCE["float32"]
        measured = _ROUNDINGS * _largest_error(results, _each(eager_result))
        return min(tolerance, max(_LEAST, measured))

    def _made(self, tier: str, tensors: Sequence[Any]) -> Any:
        """Return a tier's program for tensors of these shapes.

        The program is made with values that differ from the values of the comparison. Otherwise, a
        CUDA graph that missed some of the core's work would pass the comparison, since it would
        return the results of its capture.
        """
        function, owner = self._function, self._owner
        size, device = len(tensors[0]), tensors[0].device
        inputs = self._inputs(tensors)
        if tier == _COMPILED and not self._parts:
            function = self._compiled[size] = self._compiled.get(size) or self._program(inputs)
        if device.type != "cuda":
            return function
        if tier == _GRAPH:
            from vlagents_ray.policies.capturable import Capturable

            function = Capturable(function)
        if device not in owner.memories:
            owner.memories[device] = GraphMemory(device)
        with owner.parts(tier):
            return CudaGraph(function, inputs, owner.memories[device])

    def _inputs(self, tensors: Sequence[Any]) -> list[Any]:
        """Return zeros of these shapes.

        The zeros use the memory of the inputs of larger graphs, if the rows of these inputs have
        the same shape and type.
        """
        size = len(tensors[0])
        fits = (
            bool(self._graph_inputs)
            and len(self._graph_inputs[0]) >= size
            and _row_kinds(self._graph_inputs) == _row_kinds(tensors)
        )
        if not fits:
            self._graph_inputs = [require("torch").zeros_like(tensor) for tensor in tensors]
        return [graph_input[:size].zero_() for graph_input in self._graph_inputs]

    def _program(self, tensors: Sequence[Any]) -> Callable[..., Any]:
        """Return the program of `torch.compile` for tensors of these shapes."""
        owner, size, device = self._owner, len(tensors[0]), tensors[0].device
        if self._by_regions:

            def program(*tensors: Any) -> Any:
                with owner.regions(size):
                    return self._function(*tensors)

        else:
            program = owner.compiled(f"{self.name}_{size}", self._function, device)
        program(*tensors)
        return program


class Region:
    """A part of cores that is compiled once for all calls with the same shapes."""

    def __init__(self, owner: Compilation, function: Callable[..., Any]) -> None:
        self._owner, self._function = owner, function
        self._programs: dict[int, Callable[..., Any]] = {}  # number of rows of the core -> program

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        rows = self._owner.rows_of_regions
        if rows is None:
            return self._function(*args, **kwargs)
        if rows not in self._programs:
            tensors = [arg for arg in args if hasattr(arg, "device")]
            name = f"{self._function.__name__}_{rows}"
            self._programs[rows] = self._owner.compiled(name, self._function, tensors[0].device)
        return self._programs[rows](*args, **kwargs)


def held(core: Callable[..., Any], number: int, tensor: Any) -> Any:
    """Return an argument of later calls of a core, see `Core.hold`.

    Args:
        core: The result of `Compilation.core`.
        number: The index of the argument.
        tensor: The argument.
    """
    return core.hold(number, tensor) if isinstance(core, Core) else tensor


def _without_state_of_the_process(guards: Sequence[Any]) -> list[bool]:
    """Return which of a program's guards are kept: all except the guard of the process's state.

    While transformers builds a model, it sets torch's default dtype for all threads. With this
    guard, an inference call at that time would compile its program again, which takes seconds, and
    would fail if the dtype changed back before the end of the compilation.
    """
    return [guard.guard_type != "GLOBAL_STATE" for guard in guards]


def _of_one_kind(tensor: Any) -> Any:
    """Return a tensor of the kind for which programs are made.

    It is contiguous, and it is an inference tensor only if the argument is one. For tensors of
    another kind, `torch.compile` would make another program.
    """
    return tensor.contiguous() if tensor.is_inference() else tensor.clone().contiguous()


def _padded(tensor: Any, size: int) -> Any:
    """Return a tensor whose last row is repeated, so that it has `size` rows."""
    missing = size - len(tensor)
    if not missing:
        return tensor
    return require("torch").cat([tensor, tensor[-1:].expand(missing, *tensor.shape[1:])])


def _row_kinds(tensors: Sequence[Any]) -> list[Any]:
    """Return the shape of a row and the type of each tensor."""
    return [(tensor.shape[1:], tensor.dtype) for tensor in tensors]


def _each(result: Any) -> Sequence[Any]:
    """Return the tensors of a core's result, which is a tensor or a tuple of tensors."""
    return result if isinstance(result, tuple) else (result,)


def _largest_error(actual: Any, expected: Any) -> float:
    """Return the largest relative error of a row in the results of a core.

    The error is the Euclidean norm of the difference, divided by the norm of the expected row. It
    is NaN if a value is NaN.
    """
    errors = []
    for actual_rows, expected_rows in zip(_each(actual), _each(expected), strict=True):
        differences = _row_norms(actual_rows - expected_rows)
        norms = _row_norms(expected_rows)
        errors.append((differences / norms.clamp(min=1e-12)).max())
    return float(require("torch").stack(errors).max())


def _row_norms(tensor: Any) -> Any:
    return tensor.float().reshape(len(tensor), -1).norm(dim=1)


def _type(tensor: Any) -> str:
    return str(tensor.dtype).removeprefix("torch.")
