"""The columns of transitions: Arrow arrays with views for numpy and torch.

A row is one step of one environment: the observation, the executed action, and its outcome. Rows of
an episode are in order; a `pyarrow.RecordBatch` of rollouts holds one whole episode. T is the
number of its rows.

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
| `terminated` | (T,) bool | the environment ended the episode with this step: the value of what follows is 0 |
| `truncated` | (T,) bool | a step limit, or the policy (`Act.done`), ended it: bootstrap from the final observation |
| `success` | (T,) bool | whether the task is solved in the state that the action led to |
| `final.COLUMN` | (1, ...) | the observation after the last step, for each column of one; a row an episode |
| `logprob` | (T,) float32 | log-probability of the row, nats, if requested; see below |
| `value`, `entropy` | (T,) float32 | of the policy at this observation, if requested; NaN without a new answer |
| `replay.NAME` | (A, ...) | of the policy's A answers, to compute log-probabilities again, if requested; see below |
| `version` | (T,) int64 | of the weights that chose the action; 0 if the policy names none |
| `source` | (T,) str | source of the action: "policy", or `act.info["source"]` ("human", "expert") |

The log-probabilities of a chunk's rows add up to that of the chunk. If the policy states one for
the whole chunk, the first row has it, and the others have NaN, as in `value` and `entropy`.

With `want=["replay"]` there is a column for each name in `act.info["behaviour"]["replay"]`, such as
`replay.tokens`, (A, H, D) int64, `replay.chain`, (A, K + 1, H, M) float32, and
`replay.noise_level`, (A,). Values are of whole chunks, even if only some rows are executed; their
dtypes are the policy's. In Arrow each is in the first row of its answer's chunk. `answers` returns
the answer of each step.
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
    """Return the columns of transitions as numpy arrays with the shapes that the module lists.

    Numbers and images of a record batch, or of a table of one chunk, are read-only views of its
    memory; several chunks are first copied into one. Text is an array of objects.

    Args:
        transitions: A `pyarrow.RecordBatch` or a `pyarrow.Table` of rollouts.

    Returns:
        The arrays by name of column. They have a row a step, those of `final.` columns a row an
        episode.
    """
    pa: Any = optional("pyarrow")
    if isinstance(transitions, pa.Table):
        transitions = transitions.combine_chunks().to_batches()[0]
    return {name: _view(pa, transitions.column(name)) for name in transitions.schema.names}


def answers(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the policy's answer of each step, (T,) int64 from 0: its row of the columns
    `replay.NAME`.

    Args:
        columns: The columns of whole episodes, with `t` and `act`.
    """
    begun: np.ndarray = (columns["t"] == 0) | (np.diff(columns["act"], prepend=-1) != 0)
    return np.cumsum(begun) - 1


@dataclass(frozen=True, slots=True)
class LogRatio:
    """Differences of a learner's log-probabilities of acts from those that the server stated,
    nats an act.
    """

    mean: float
    std: float
    acts: int  # number of acts compared


def log_ratio(learner: Any, server: Any) -> LogRatio:
    """Compare the log-probabilities of the same acts, under the same weights, of a learner and of
    the server.

    Before the first step of an optimizer the ratio of a policy gradient should be 1. Differences of
    precision, kernels or preprocessing change it, and grow with the number of values of an act.

    Args:
        learner: The learner's log-probabilities, (B, ...), nats: an array or a tensor, on any
            device.
        server: `info["behaviour"]["logprob"]` of the same acts, or their `columns["logprob"]`, of
            the same shape. An act is a row of the first dimension, over which all others are
            summed; rows with NaN are left out.

    Returns:
        Mean and standard deviation of learner - server over the acts.

    Raises:
        InvalidInput: The shapes differ, or no row is left.
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
            'log_ratio: got no act with log-probabilities; request them with want=["logprob"]'
        )
    return LogRatio(float(ratios.mean()), float(ratios.std()), ratios.size)


def _view(pa: Any, column: Any) -> Any:
    if isinstance(column, pa.ListArray):
        return _view(pa, column.flatten())
    if isinstance(column, pa.FixedShapeTensorArray):
        return column.to_numpy_ndarray()
    if isinstance(column, pa.DictionaryArray):
        return np.array(column.dictionary.to_pylist(), object)[column.indices.to_numpy()]
    return column.to_numpy(zero_copy_only=True)


def tensors(pa: Any, values: np.ndarray) -> Any:
    """Return (T,) or (T, ...) values as an Arrow array that shares their memory."""
    if values.dtype == np.bool_:
        # Arrow's own booleans are bits, which allow no view.
        return pa.Bool8Array.from_numpy(values)
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedShapeTensorArray.from_numpy_ndarray(values)


def at_rows(pa: Any, values: np.ndarray, rows: np.ndarray) -> Any:
    """Return a column of lists: the next of (N, ...) `values` at each true row of `rows`, (T,)
    bool, else nothing.
    """
    offsets = np.append(0, np.cumsum(rows)).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), tensors(pa, values))
