"""The columns of transitions: Arrow arrays with views for numpy and torch.

A row is one step of one environment: the observation, the executed action, and its outcome. The rows
of an episode are in order. A `pyarrow.RecordBatch` of rollouts contains one whole episode, and T is
the number of its rows.

| column | numpy view | |
|---|---|---|
| `key` | (T,) str | the key of the episode, as in an evaluation |
| `episode` | (T,) int64 | number of the start state, from 0; the episodes of a group share it |
| `t` | (T,) int32 | steps since the reset |
| `act` | (T,) int32 | number of the policy's answer; the rows of one action chunk share it |
| `instruction` | (T,) str | the task in words; "" if there is none |
| `cameras.NAME` | (T, H, W, 3) uint8 | RGB, upright |
| `state.NAME` | (T, D) float32 | in the unit that the env's contract states |
| `gripper` | (T,) float32 | in [0, 1], 1 = open; only if the env has one |
| `action` | (T, D) float32 | as executed, in the unit of the env's contract |
| `reward` | (T,) float32 | of the environment; without a shaped reward, 1 for a step that ends in success |
| `terminated` | (T,) bool | the environment ended the episode with this step: the value of the next state is 0 |
| `truncated` | (T,) bool | a step limit, or the policy (`Act.done`), ended it: bootstrap from the final observation |
| `success` | (T,) bool | whether the task is solved in the state that the action led to |
| `final.COLUMN` | (1, ...) | the observation after the last step, one row per episode, for each column of observations |
| `logprob` | (T,) float32 | log-probability of the row, nats, if requested; see below |
| `value`, `entropy` | (T,) float32 | of the policy at this observation, if requested; NaN without a new answer |
| `replay.NAME` | (A, ...) | of the policy's A answers, to compute log-probabilities again, if requested; see below |
| `version` | (T,) int64 | of the weights that chose the action; 0 if the policy has no versions |
| `source` | (T,) str | source of the action: "policy", or `act.info["source"]` ("human", "expert") |

The log-probabilities of a chunk's rows add up to the log-probability of the chunk. If the policy
returns one for the whole chunk, the first row has it, and the other rows have NaN, as in `value` and
`entropy`.

With `want=["replay"]` there is a column for each name in `act.info["behaviour"]["replay"]`, such as
`replay.tokens`, (A, H, D) int64, `replay.chain`, (A, K + 1, H, M) float32, and
`replay.noise_level`, (A,). These values belong to whole chunks, even if only some rows are
executed, and have the dtypes of the policy. In Arrow, each value is in the first row of its
answer's chunk. `answers` returns the number of the answer of each step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput
from vlagents_ray.weights.trainable import to_numpy
from vlagents_ray_learn.optional import optional

FINAL = "final."
REPLAY = "replay"


def arrays(transitions: Any) -> dict[str, np.ndarray]:
    """Return the columns of transitions as numpy arrays, with the shapes that the docstring of the
    module lists.

    Numbers and images of a record batch, or of a table with one chunk, are read-only views of
    Arrow's memory. Several chunks are first copied into one chunk. Text becomes an array of
    objects.

    Args:
        transitions: A `pyarrow.RecordBatch` or a `pyarrow.Table` of rollouts.

    Returns:
        The arrays by the names of the columns. An array has one row per step, or one row per
        episode for a `final.` column.
    """
    pa: Any = optional("pyarrow")
    if isinstance(transitions, pa.Table):
        transitions = transitions.combine_chunks().to_batches()[0]
    return {name: _view(pa, transitions.column(name)) for name in transitions.schema.names}


def answers(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the number of the policy's answer at each step.

    Args:
        columns: The columns of whole episodes, with `t` and `act`.

    Returns:
        (T,) int64, from 0. The number is the row of the answer in the columns `replay.NAME`.
    """
    begins_answer: np.ndarray = (columns["t"] == 0) | (np.diff(columns["act"], prepend=-1) != 0)
    return np.cumsum(begins_answer) - 1


@dataclass(frozen=True, slots=True)
class LogRatio:
    """The differences between a learner's and the server's log-probabilities of the same
    answers.
    """

    mean: float  # mean difference, nats per answer
    std: float  # standard deviation, nats per answer
    acts: int  # number of answers compared


def log_ratio(learner: Any, server: Any) -> LogRatio:
    """Compare the log-probabilities of the same answers between a learner and the server.

    Both must have the same weights. Before the first step of an optimizer, the probability ratio of
    a policy gradient should be 1, and the difference of log-probabilities should be 0. Other
    precision, kernels or preprocessing cause a difference, which grows with the number of values of
    an answer.

    Args:
        learner: The learner's log-probabilities, (B, ...), nats: an array or a tensor, on any
            device.
        server: `info["behaviour"]["logprob"]` of the same answers, or their `columns["logprob"]`,
            with the same shape. The first dimension is the answers, and the values of each answer
            are summed. Answers with NaN are excluded.

    Returns:
        The mean and standard deviation of learner minus server over the answers.

    Raises:
        InvalidInput: The shapes differ, or all answers have NaN.
    """
    learned = to_numpy(learner).astype(np.float64)
    served = to_numpy(server).astype(np.float64)
    if learned.shape != served.shape or not learned.ndim:
        raise InvalidInput(
            f"log_ratio: expected one shape (B, ...) of both, got {learned.shape} and "
            f"{served.shape}"
        )
    ratios = (learned - served).reshape(len(learned), -1).sum(1)
    ratios = ratios[~np.isnan(ratios)]
    if not ratios.size:
        raise InvalidInput(
            "log_ratio: expected answers with log-probabilities, got none; request them with "
            'want=["logprob"]'
        )
    return LogRatio(float(ratios.mean()), float(ratios.std()), ratios.size)


def _view(pa: Any, column: Any) -> Any:
    """Return an Arrow array as a numpy array, without a copy if it contains numbers."""
    if isinstance(column, pa.ListArray):
        return _view(pa, column.flatten())
    if isinstance(column, pa.FixedShapeTensorArray):
        return column.to_numpy_ndarray()
    if isinstance(column, pa.DictionaryArray):
        texts = np.array(column.dictionary.to_pylist(), object)
        return texts[column.indices.to_numpy()]
    return column.to_numpy(zero_copy_only=True)


def tensors(pa: Any, values: np.ndarray) -> Any:
    """Return (T,) or (T, ...) values as an Arrow array that shares the values' memory."""
    if values.dtype == np.bool_:
        # Arrow stores booleans as bits by default, and numpy cannot view bits.
        return pa.Bool8Array.from_numpy(values)
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedShapeTensorArray.from_numpy_ndarray(values)


def at_rows(pa: Any, values: np.ndarray, rows: np.ndarray) -> Any:
    """Return a column of lists, (T,), with a value in some rows and empty lists in the others.

    Args:
        pa: The module `pyarrow`.
        values: (N, ...), in the order of their rows.
        rows: Which rows have a value, (T,) bool, of which N are true.
    """
    offsets = np.append(0, np.cumsum(rows)).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), tensors(pa, values))
