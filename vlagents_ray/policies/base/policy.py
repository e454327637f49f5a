"""The base class of policies that are models.

It handles sessions, histories, chunks and samples; a model family adds the forward pass.
"""

from __future__ import annotations

import abc
import copy
import itertools
import logging
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from operator import attrgetter
from typing import Any, ClassVar, TypeVar

import numpy as np

from vlagents_ray.abilities import ContinuesPlans, ability
from vlagents_ray.chunking.buffer import ENSEMBLE, Chunk, ChunkBuffer
from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    NotReset,
    NotTrainable,
    PolicyFailed,
)
from vlagents_ray.interface import (
    BEHAVIOUR,
    DELAY,
    DISTRIBUTION,
    EXECUTED,
    LEFTOVER,
    Act,
    Agent,
    Obs,
    TrainableAgent,
)
from vlagents_ray.policies.base.accelerator import (
    free_memory,
    gpu_timer,
    is_out_of_memory,
    set_matmul,
)
from vlagents_ray.policies.base.adapter import LoraAdapter
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import weights_of
from vlagents_ray.policies.base.config import AdapterConfig, ModelConfig
from vlagents_ray.policies.base.model_inputs import (
    Row,
    count_in,
    drawn,
    leftover_plan,
    needs_gripper,
    shared_frames,
    state_specs,
    wanted_behaviour,
    wanted_samples,
)
from vlagents_ray.policies.compilation import Compilation, quantize, uses_torch_compile
from vlagents_ray.policies.loading import (
    COMPILED_SIZES,
    LoadingReport,
    current_report,
    report_progress,
    report_variation,
)
from vlagents_ray.policies.outcomes import attempt
from vlagents_ray.validation import check_action

logger = logging.getLogger(__name__)

# A batch is divided into several passes if together they take less than this share of the time of
# one pass. A smaller saving is within the spread of the measurements.
_FASTER = 0.9

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Prediction:
    """A chunk, with the model's uncertainty if the model computes it."""

    actions: np.ndarray  # (H, D) float32, in the units of the contract's action
    mean: np.ndarray | None = None  # mean of the model's distribution, (H, D)
    std: np.ndarray | None = None  # standard deviation, (H, D)
    behaviour: dict[str, Any] = field(default_factory=dict)  # a value for each name of `Row.want`
    info: dict[str, Any] = field(default_factory=dict)  # entries for `Act.info`


@dataclass(slots=True)
class PolicyEpisode:
    """The state of a session's episode."""

    instruction: str
    frames: deque[Any]  # results of `perceive`, oldest first
    rng: np.random.Generator
    draws: np.random.Generator  # generator of samples, so that requesting them changes no action
    plan: ChunkBuffer  # remaining actions, if they are returned one at a time
    memory: dict[str, Any] = field(default_factory=dict)
    # The tokens of the instruction, for families that compute them when the episode begins.
    prompt: Any = None


class ModelPolicy(TrainableAgent, abc.ABC):
    """The base class of the model families.

    A family defines `load`, `perceive`, `predict` and its contract. The model computes one row for
    each observation, and all sessions of a batch in one forward pass of at most `config.rows` rows.
    Each session draws its noise from a generator that is seeded with the seeds of the config and
    of the episode.
    """

    shared: ClassVar[tuple[str, ...]] = ("config", "model", "compilation", "adapter", "report")
    # The name of the attribute with the torch module into which `adapter` is merged, and whose
    # linear layers `quantization` may keep in 8 bits.
    network: ClassVar[str | None] = None

    def __init__(self, config: Any) -> None:
        self.config: ModelConfig = config
        self.model: Any = None
        # `load` passes the model's cores to it.
        self.compilation = Compilation(self.config.compile)
        # The adapter that the settings name, before `load` is called.
        self.adapter: LoraAdapter | None = None
        # Replaced with the server's report when the model is loaded.
        self.report = LoadingReport(lambda _: None, COMPILED_SIZES)
        self.episode: PolicyEpisode | None = None

    def loaded(self) -> Any:
        """Return `self.model`; raises `PolicyFailed` before `initialize`."""
        if self.model is None:
            raise PolicyFailed(
                f"{type(self).__name__}: act was called before initialize; the checkpoint is not "
                "loaded"
            )
        return self.model

    @property
    def history(self) -> int:
        """The largest number of observations of each session that `predict` uses."""
        return 1

    @property
    def most_rows(self) -> int:
        """The largest number of rows of a forward pass.

        This is the limit of the config, or a smaller one for some time after a pass did not fit
        into memory.
        """
        return min(self.config.rows, self.report.row_limit.rows or self.config.rows)

    @property
    def batched(self) -> bool:
        """Whether `predict` computes the rows of a pass together, once the model is loaded."""
        return True

    @property
    def variation(self) -> str | None:
        """Why the bits of a row's result may depend on the other rows of a pass of a fixed size;
        None if they do not.

        A family overrides this if the shapes of a pass depend on its rows, as with prompts that are
        padded to the longest one. Everything else is measured with `batch: {invariant: true}` when
        the model is loaded.
        """
        return None

    @property
    def state_dim(self) -> int | None:
        """The length of the model's state vector, once the model is loaded.

        The warm-up needs it if parts of the state may have any length.
        """
        return None

    def offered(self, names: tuple[str, ...]) -> tuple[str, ...] | None:
        """Return the names for the contract's `behaviour`.

        Returns:
            The names; None if the model offers none, or if an answer is not a whole chunk.
        """
        return names if names and self.config.actions == "chunk" else None

    def chunk(self, horizon: int) -> int:
        """Return the number of rows in an answer, for the contract, from the number of rows of
        the model's chunk.
        """
        if self.config.actions != "chunk":
            return 1
        return min(self.config.execute or horizon, horizon)

    def make_contract(
        self, cameras: Mapping[str, str], parts: Sequence[str], horizon: int | None, **facts: Any
    ) -> Contract:
        """Return the contract of a model.

        Args:
            cameras: The model's name of each camera -> the name in observations.
            parts: The parts of the state vector, in order.
            horizon: The number of rows of a chunk; None if it is not yet known.
            facts: Further fields of the contract, which replace the default values.
        """
        usual: dict[str, Any] = {
            # Images may have any size, since the families resize them.
            "cameras": {ours: CameraSpec() for ours in cameras.values()},
            "state": state_specs(parts, self.state_dim),
            "gripper": needs_gripper(parts),
            "instruction": True,
            "chunk": None if horizon is None else self.chunk(horizon),
            "history": self.history,
        }
        return Contract(**usual | facts)

    @abc.abstractmethod
    def load(self) -> Any:
        """Read the checkpoint; the result becomes `self.model`, which all sessions share."""

    @abc.abstractmethod
    def perceive(self, obs: Obs) -> Any:
        """Convert and resize an observation for the history.

        The rules of `Prepares.prepare` apply. `self` is the copy of a session that is in an
        episode. An error is the result of that session's request alone.
        """

    @abc.abstractmethod
    def predict(self, rows: Sequence[Row]) -> Sequence[Prediction | Exception]:
        """Compute a chunk for each row in one forward pass.

        The result of a row must not depend on the other rows.
        """

    def merge_products(self) -> None:
        """Merge products of the loaded network that have the same input; the default merges none.

        Their weights become views of one tensor. The method is called for a network on an
        accelerator, where pushed weights are copied into the memory of the old weights. It is not
        called if the network is quantized, which changes single layers.
        """

    def initialize(self) -> None:
        """Load the checkpoint, and warm up.

        With `batch_sizes`, each size runs once, or the model's cores are compiled for it. Without
        `batch_sizes`, one row and a full batch run on an accelerator, so that a missing kernel or a
        lack of memory is an error before a robot moves.
        """
        with current_report() as self.report:
            if self._adapter_source is None:
                self.model = self.load()
            else:
                self._load_with_adapter(self._adapter_source)
        for device in self.report.devices:
            set_matmul(self.config.matmul, device)
        self._decide_on_compiling()
        if self.config.quantization:
            quantize(self, self.config.quantization)
            if self.report.accelerated and not uses_torch_compile(self.compilation.mode):
                logger.warning(
                    "quantization %r without compile: true: each product first writes its weights "
                    "in 16 or 32 bits, which takes longer than without quantization; set compile: "
                    "true, or leave quantization out",
                    self.config.quantization,
                )
        elif self.report.accelerated:
            self.merge_products()
        self._warm_up()
        if self.report.invariant:
            report_variation(self.variation or self._measure_variation())

    def _warm_up(self) -> None:
        """Run or compile each batch size."""
        sizes = self.config.batch_sizes or []
        self.report.pads = bool(sizes)
        if not sizes and self.report.accelerated:
            sizes = sorted({1, self.config.rows})
        seeds = itertools.count()
        cores = self.compilation.mode and self.compilation.cores
        activity = "compiling" if self.config.compile else "running"
        for number, size in enumerate(reversed(sizes) if cores else sizes, 1):
            report_progress(f"{activity} {size} rows ({number} of {len(sizes)})")
            if cores:
                run_examples = partial(self._run_examples, size, seeds)
                self.compilation.add_size(size, run_examples)
            else:
                self._run_examples(size, seeds)
        if self.config.batch_sizes:
            self._measure_passes(seeds)

        if sizes:
            free_memory()  # frees the memory of the full batch, which smaller batches do not need
        for device in self.report.devices:
            if device["kind"] == "cuda" and cores:
                device["graphs_mib"] = round(self.compilation.graph_bytes / 2**20, 1)
        self.report.timer = gpu_timer(self.report)

    def _measure_passes(self, seeds: Iterator[int]) -> None:
        """Measure a forward pass of each batch size on an accelerator, so that later batches are
        split into the fastest passes.

        The durations of earlier passes do not count, as they include the loading of kernels.
        """
        is_compiled = self.compilation.mode and self.compilation.cores
        if not (self.report.accelerated or is_compiled):
            return
        pass_s = self.report.pass_s
        pass_s.clear()
        self.report.splits_by_time = False
        for size in self.config.batch_sizes or ():
            self._run_rows(size, seeds)

        # A pass that seems slower than several smaller ones may have been delayed by another
        # process.
        for size in tuple(pass_s):
            if len(fastest_split(size, tuple(pass_s.items()))) > 1:
                self._run_rows(size, seeds)
        self.report.splits_by_time = self.report.accelerated

    def _measure_variation(self) -> str | None:
        """Compute the same rows at other places of a pass, and beside other rows.

        The kernels of a library may differ between the places of a batch, for instance at the end
        of a thread's share of the rows.

        Returns:
            A sentence about the rows whose bits differ; None if all are equal.
        """
        sizes = self.config.batch_sizes
        if sizes == [1]:
            return None
        [size] = self.report.batch_sizes
        if sizes != [size]:
            return f"its batch_sizes are {sizes}, and batch.max_size is {size}"
        rows = self._rows_of_each_kind(size)
        expected = self._bits(rows)

        # Neighbouring places together cover all places.
        for shift in sorted({1, size // 2} - {0, size}):
            order = [*range(shift, size), *range(shift)]
            bits = self._bits([rows[i] for i in order])
            places = [place for place, i in enumerate(order) if bits[place] != expected[i]]
            if places:
                return (
                    f"in a pass of {size} rows, the bits of a row depend on its place: they differ "
                    f"at {len(places)} of {size} places"
                )
        for i in range(min(size, len(self._kinds_of_rows()))):
            if self._bits(rows[i : i + 1]) != expected[i : i + 1]:
                return f"in a pass of {size} rows, the bits of a row depend on the other rows"
        return None

    def _rows_of_each_kind(self, number: int) -> list[Row]:
        """Return random rows, of each kind in turn."""
        kinds = self._kinds_of_rows()
        rows = []
        for seed in range(number):
            kind = kinds[seed % len(kinds)]
            rows.append(replace(self._example(seed), **kind))
        return rows

    def _kinds_of_rows(self) -> list[dict[str, Any]]:
        """Return the fields of each kind of row: an ordinary one, and, if the policy supports it,
        one that continues a plan and one whose outputs are requested.
        """
        contract = self.contract or Contract()
        kinds: list[dict[str, Any]] = [{}]
        plans = ability(self, ContinuesPlans)
        dim = contract.action.dim
        if plans is not None and plans.continues_plans and dim and contract.chunk:
            leftover = np.zeros((max(1, contract.chunk - 1), dim), np.float32)
            kinds.append({"leftover": leftover, "delay": 1})
        if contract.behaviour:
            kinds.append({"want": tuple(contract.behaviour), "sample": True})
        return kinds

    def _bits(self, rows: Sequence[Row]) -> list[list[bytes]]:
        """Compute rows in forward passes, and return the bytes of the arrays of each result."""
        copies = [
            replace(row, rng=copy.deepcopy(row.rng), memory=copy.deepcopy(row.memory))
            for row in rows
        ]
        bits = []
        for prediction in self._forward(copies):
            if isinstance(prediction, Exception):
                raise prediction
            arrays = (prediction.actions, prediction.mean, prediction.std)
            bits.append([np.asarray(array).tobytes() for array in arrays if array is not None])
        return bits

    def _decide_on_compiling(self) -> None:
        """Resolve the setting `compile` for the loaded model and its device."""
        device_kinds = [device["kind"] for device in self.report.devices]
        kind = next((kind for kind in device_kinds if kind != "cpu"), "cpu")
        mode = self.config.compile_on(kind)
        if self.config.compile == "auto":
            mode = mode if self.compilation.cores else False
            logger.info(
                "compile: auto: %s, on %r, with %d cores",
                mode,
                kind,
                len(self.compilation.cores),
            )
        elif mode == "graphs" and kind != "cuda":
            raise ConfigError(
                f"compile: graphs: expected a model on 'cuda', got one on {kind!r}; leave it out"
            )
        self.compilation.mode = mode
        self.config = self.config.model_copy(update={"compile": mode})
        if mode or self.report.invariant:
            # Rows that are computed one by one need no padding.
            is_alone = self.report.invariant and not self.batched
            self.config = self.config.with_sizes([1] if is_alone else self.report.batch_sizes)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode; the option `seed` is an int (default 0)."""
        contract = self.contract
        if contract is not None and contract.instruction and not instruction:
            raise InvalidObservation(
                "instruction: expected the robot's task in words, got an empty text; give one at "
                "the reset"
            )
        self._begin(instruction or "", int(kwargs.get("seed") or 0))
        self.notice(obs)
        return {}

    def notice(self, obs: Obs) -> None:
        """Update the session's memory from an observation.

        This is called for each observation, even if no chunk is requested.
        """

    def observe(self, obs: Obs) -> None:
        self.notice(obs)
        self._current_episode().frames.append(self.perceive(obs))

    def prepare(self, obs: Obs) -> Any:
        """Return the result of `perceive` for the observation.

        Returns:
            The result; None if actions of an earlier chunk may be left, which need no observation.
        """
        if self.config.actions == "queue" and self.history == 1:
            return None
        return self.perceive(obs)

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Return a chunk (H, D), or one action (D,), for each session.

        All sessions that need a forward pass share one.
        """
        rows_by_session = []
        for session_obs, session in zip(obs, sessions, strict=True):
            rows_by_session.append(attempt(self._rows, session_obs, session))

        rows: list[Row] = []
        for session_rows in rows_by_session:
            if not isinstance(session_rows, Exception):
                rows += session_rows
        predictions = iter(self._forward(rows))

        answers: list[Act | Exception] = []
        for session_rows, session in zip(rows_by_session, sessions, strict=True):
            if isinstance(session_rows, Exception):
                answers.append(session_rows)
                continue
            session_predictions = list(itertools.islice(predictions, len(session_rows)))
            answers.append(self._act(session, session_predictions))  # type: ignore[arg-type]
        return answers

    def sleep(self) -> None:
        """Free the captured graphs."""
        self.compilation.drop_graphs()

    def wake(self) -> None:
        """Capture the graphs again."""
        if self.compilation.mode and not self.compilation.sizes:
            self._warm_up()

    def close(self) -> None:
        """Drop the model and its compiled programs, so that their memory is freed."""
        self.model = None
        self.compilation = Compilation(self.config.compile)

    def _trainable(self) -> Any:
        quantization = self.config.quantization
        if quantization is not None:
            raise NotTrainable(
                f"quantization {quantization!r}: a learner cannot push to 8-bit weights; leave it "
                "out"
            )
        return super()._trainable()

    @property
    def _adapter_source(self) -> str | None:
        """The adapter that the settings name; None if the family accepts none."""
        config = self.config
        return config.adapter if isinstance(config, AdapterConfig) else None

    def _load_with_adapter(self, source: str) -> None:
        """Load the checkpoint, and merge the adapter at `source` into its weights."""
        if self.network is None:
            raise ConfigError(
                f"{type(self).__name__}.network: expected the name of the torch module into which "
                "an adapter is merged, got None; set it, or use ModelConfig as Config"
            )
        with used_checkpoints():  # the adapter is not one of the files of the base
            self.adapter = LoraAdapter.find(source)
        with used_checkpoints() as base:
            self.model = self.load()

        self.adapter.require_base(self.config.checkpoint, base)
        self.adapter.merge_into(attrgetter(self.network)(self))
        self.weights_id = weights_of([*base, self.adapter.folder]) if base else None

    def _begin(self, instruction: str, seed: int) -> None:
        """Begin an episode in this session."""
        # Numpy accepts no negative seed. Modulo 2**64, distinct int64 values remain distinct.
        seeds = [self.config.seed, seed % 2**64]
        contract = self.contract
        action = None if contract is None else contract.action
        self.episode = PolicyEpisode(
            instruction,
            deque(maxlen=self.history),
            np.random.default_rng(seeds),
            np.random.default_rng([*seeds, 1]),
            ChunkBuffer(ENSEMBLE, self.config.ensemble_m, action),
        )

    def _current_episode(self) -> PolicyEpisode:
        """Return the episode of this session; raises `NotReset` if there is none."""
        if self.episode is None:
            raise NotReset(
                f"{type(self).__name__}: act was called before reset; call reset(obs, instruction) "
                "first"
            )
        return self.episode

    def _rows(self, obs: Obs, session: ModelPolicy) -> list[Row]:
        """Return the rows to compute for a session.

        Returns:
            The row of the chunk, followed by the rows of the samples; empty while actions of an
            earlier chunk are left.
        """
        episode = session._current_episode()
        samples = wanted_samples(obs, self.config)
        want = wanted_behaviour(obs)
        session.notice(obs)

        if EXECUTED in obs.info:  # The robot executed other actions than those of the plan.
            episode.plan.drop()
        rows_left = self.config.actions == "queue" and episode.plan.next is not None
        if rows_left and self.history == 1:
            return []

        episode.frames.append(session.perceive(obs) if obs.prepared is None else obs.prepared)
        if rows_left:
            return []

        chunk_row = Row(
            frames=tuple(episode.frames),
            instruction=episode.instruction,
            rng=episode.rng,
            leftover=None if obs.info.get(LEFTOVER) is None else leftover_plan(obs, self.contract),
            delay=count_in(obs, DELAY),
            info=obs.info,
            memory=episode.memory,
            want=want,
            sample=bool(want),
        )
        if not samples:
            return [chunk_row]

        # Each sample has its own seed, since the samples may be computed in several passes.
        seeds = episode.draws.integers(2**63, size=samples)
        return [chunk_row, *(drawn(chunk_row, np.random.default_rng(seed)) for seed in seeds)]

    def _act(
        self, session: ModelPolicy, predictions: list[Prediction | Exception]
    ) -> Act | Exception:
        """Return the answer to a session.

        Args:
            session: The session.
            predictions: The predictions of the chunk and of its samples. If empty, the answer is
                the next action of the session's plan.
        """
        episode = session._current_episode()
        if not predictions:
            return Act(episode.plan.take().action)

        computed: list[Prediction] = []
        for prediction in predictions:
            if isinstance(prediction, Exception):
                return prediction
            computed.append(prediction)

        chunk_prediction, *samples = computed
        chunk = self._executed_rows(chunk_prediction.actions)
        info = dict(chunk_prediction.info)
        if chunk_prediction.behaviour:
            info[BEHAVIOUR] = chunk_prediction.behaviour
        if samples:
            info[DISTRIBUTION] = self._distribution(chunk_prediction, samples)
        if self.config.actions == "chunk":
            return Act(chunk, info=info)

        # Check the chunk before it is stored for later ticks.
        try:
            check_action(chunk, self.contract)
        except InvalidAction as error:
            return error
        episode.plan.add(Chunk(0, episode.plan.executed, chunk))
        return Act(episode.plan.take().action, info=info)

    def _executed_rows(self, actions: np.ndarray) -> np.ndarray:
        """Return the first `execute` rows of a chunk, float32."""
        return np.ascontiguousarray(actions[: self.config.execute], dtype=np.float32)

    def _distribution(self, prediction: Prediction, samples: list[Prediction]) -> dict[str, Any]:
        """Return the samples, and the mean and the standard deviation of the model or of the
        samples.
        """
        chunks = np.stack([self._executed_rows(sample.actions) for sample in samples])
        mean = chunks.mean(0) if prediction.mean is None else self._executed_rows(prediction.mean)
        std = chunks.std(0) if prediction.std is None else self._executed_rows(prediction.std)
        return {
            "mean": mean,
            "std": std,
            "samples": chunks,
            **_stacked([sample.behaviour for sample in samples]),
        }

    def _forward(self, rows: list[Row]) -> list[Prediction | Exception]:
        """Compute all rows.

        If the memory of an accelerator is exhausted, this batch and later ones use smaller forward
        passes, whose size increases again after some time.
        """
        if self.report.row_limit.recover(self.config.rows, self.config.batch_sizes or ()):
            logger.info("forward passes of up to %d rows are tried again", self.most_rows)
        while True:
            states_before = [row.rng.bit_generator.state for row in rows]
            try:
                return self._passes(rows)
            except Exception as error:
                if not is_out_of_memory(error) or not self._lower_rows(len(rows), error):
                    raise

            # Free memory after the handler, in which the traceback still refers to the tensors of
            # the pass.
            free_memory()
            # Restore the generators, so that the next attempt draws the same noise.
            for row, state in zip(rows, states_before, strict=True):
                row.rng.bit_generator.state = state

    def _lower_rows(self, rows: int, error: Exception) -> bool:
        """Halve the largest size of a forward pass after a pass did not fit into memory.

        Args:
            rows: The number of rows of the batch.
            error: The error of the pass.

        Returns:
            Whether a smaller pass is possible.
        """
        self.report.on_out_of_memory()
        tried = min(self.most_rows, self._size(rows))
        half = tried // 2
        smaller_sizes = [size for size in self.config.batch_sizes or (half,) if 0 < size <= half]
        if smaller_sizes:
            self.report.row_limit.lower(smaller_sizes[-1])
            consequence = f"of at most {smaller_sizes[-1]} rows from now on"
        else:
            consequence = "no smaller one is possible"

        logger.error(
            "out of memory in a forward pass of %d rows: %s. Lower batch.max_size, max_rows or "
            "batch_sizes, or free memory of the device (%s)",
            tried,
            consequence,
            error,
        )
        return bool(smaller_sizes)

    def _size(self, rows: int) -> int:
        """Return the number of rows after padding of a pass with `rows` rows."""
        return next((size for size in self.config.batch_sizes or () if size >= rows), rows)

    def padded(self, items: list[T]) -> list[T]:
        """Return the items of a batch, with the last item repeated up to the next batch size."""
        return items + items[-1:] * (self._size(len(items)) - len(items))

    def with_fillers(self, rows: list[Row]) -> list[Row]:
        """Return the rows of a pass, padded to the next batch size.

        The rows that pad the pass are copies, so that they draw no noise from the session's
        generator.
        """
        fillers = self.padded(rows)[len(rows) :]
        copies = [copy.deepcopy(row, {id(row.frames): row.frames}) for row in fillers]
        padded_rows = [*rows, *copies]
        if self.report.invariant:
            # No row shares its observations, so that they are also encoded in one size.
            padded_rows = [replace(row, frames=(*row.frames,)) for row in padded_rows]
        return padded_rows

    def _passes(self, rows: list[Row]) -> list[Prediction | Exception]:
        """Compute all rows, in the forward passes that `_split` returns."""
        predictions: list[Prediction | Exception] = []
        for size in self._split(len(rows)):
            pass_rows = rows[len(predictions) : len(predictions) + size]
            padded_rows = self.with_fillers(pass_rows)

            began = time.perf_counter()
            with self.report.timer():
                results = self.predict(padded_rows)
            took = time.perf_counter() - began
            if len(results) != len(padded_rows):
                raise PolicyFailed(
                    f"predict: expected {len(padded_rows)} chunks, one for each row, got "
                    f"{len(results)}"
                )

            shortest = self.report.pass_s
            shortest[len(padded_rows)] = min(took, shortest.get(len(padded_rows), took))
            predictions += results[: len(pass_rows)]
        return predictions

    def _split(self, rows: int) -> list[int]:
        """Return the number of rows of each forward pass for a batch.

        There are several passes if the batch is too large for one, or if several are faster. With
        `batch_sizes`, 9 rows may take longer in a pass of 16 than in a pass of 8 and a pass of 1.
        On a CPU, where the time of a pass depends on other processes, the smallest number of passes
        is used.
        """
        full_passes, remaining = divmod(rows, self.most_rows)
        split = [self.most_rows] * full_passes
        if not remaining:
            return split

        sizes = [size for size in self.config.batch_sizes or () if size <= self.most_rows]
        pass_s = {size: self.report.pass_s.get(size) for size in sizes}
        if self.report.splits_by_time and pass_s and None not in pass_s.values():
            return split + fastest_split(remaining, tuple(pass_s.items()))
        return [*split, remaining]

    def _run_examples(self, size: int, seeds: Iterator[int]) -> None:
        """Run a forward pass with `size` random rows, and raise its first error."""
        rows = self._run_rows(size, seeds)
        if any("jax" in device for device in self.report.devices) and size <= self.most_rows:
            # JAX compiles a separate program for each number of rows and each smaller number of
            # observations.
            for observations in self.config.batch_sizes or ():
                if observations >= size:
                    continue
                samples = [drawn(rows[0], row.rng) for row in rows[observations:]]
                # `_forward` is not called, since it would record the durations of these passes.
                self.predict([*rows[:observations], *samples])

    def _run_rows(self, size: int, seeds: Iterator[int]) -> list[Row]:
        """Run a forward pass with `size` random rows, which are returned, and raise its first
        error.
        """
        rows = [self._example(next(seeds)) for _ in range(size)]
        for prediction in self._forward(rows):
            if isinstance(prediction, Exception):
                raise prediction
        return rows

    def observations_of(self, rows: Sequence[Row]) -> tuple[list[int], list[int]]:
        """Return which rows to encode.

        If each row has its own observations, the results are 0, 1, …, so that the encoded
        observations need no gather operation.

        Returns:
            The indices of the rows to encode, padded to one of `batch_sizes`; and for each row the
            position of its observations in this list.
        """
        firsts, owners = shared_frames(rows)
        firsts = self.padded(firsts)
        if len(firsts) == len(rows):
            every_row = list(range(len(rows)))
            return every_row, every_row
        return firsts, owners

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        """Return a row for the warm-up, whose observation fits the contract.

        Images are random, and the state is random near zero.
        """
        rng = np.random.default_rng(seed)
        contract = self.contract or Contract()
        state_specs = contract.state or {}
        lengths = {name: spec.dim or 1 for name, spec in state_specs.items()}
        open_lengths = [name for name, spec in state_specs.items() if spec.dim is None]
        if open_lengths and self.state_dim is not None:
            lengths[open_lengths[0]] += self.state_dim - len(open_lengths) - bool(contract.gripper)

        images = {}
        for name, camera in (contract.cameras or {}).items():
            shape = (camera.height or 224, camera.width or 224, 3)
            images[name] = rng.integers(0, 256, shape, np.uint8)
        gripper = float(rng.random())
        state = {}
        for name, length in lengths.items():
            state[name] = rng.uniform(-0.1, 0.1, length).astype(np.float32)
        obs = Obs(cameras=images, gripper=gripper, state=state)

        session = copy.copy(self)
        session._begin(instruction, seed)
        frames = (session.perceive(obs),) * self.history
        return Row(frames, instruction, rng)


def _stacked(mappings: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack mappings with the same names into one.

    Arrays get a new first dimension. Nested mappings are stacked in the same way.
    """
    stacked: dict[str, Any] = {}
    for name, first in mappings[0].items():
        values = [mapping[name] for mapping in mappings]
        stacked[name] = _stacked(values) if isinstance(first, Mapping) else np.stack(values)
    return stacked


@lru_cache(maxsize=256)
def fastest_split(rows: int, pass_s: tuple[tuple[int, float], ...]) -> list[int]:
    """Return the number of rows of each forward pass, so that their total time is the shortest.

    Args:
        rows: The total number of rows, at most the largest size.
        pass_s: The sizes of passes, in ascending order, and the duration of each pass, s. Smaller
            passes are padded to the next size.
    """
    # The shortest time for 0, 1, … rows, and the passes with that total time.
    best: list[tuple[float, list[int]]] = [(0.0, [])]
    for count in range(1, rows + 1):
        splits = []
        for size, took in pass_s:
            earlier_s, earlier_passes = best[max(0, count - size)]
            splits.append((took + earlier_s, [*earlier_passes, min(size, count)]))
        best.append(min(splits))

    shortest_s, passes = best[rows]
    single_pass_s = next(took for size, took in pass_s if size >= rows)
    return passes if shortest_s < _FASTER * single_pass_s else [rows]
