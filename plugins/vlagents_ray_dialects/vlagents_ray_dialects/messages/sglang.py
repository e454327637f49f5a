"""The bodies of SGLang's `/v1/actions`: JSON, or msgpack in which arrays are maps as openpi sends
them.

A request is `{"input": {"prompt", "observation", "images", "state"}, "parameters", "runtime"}`, or
the observation alone. SGLang's modules `entrypoints/action/{api,protocol,ws_utils}.py` (commit
0350f48) define the format. The rollout worker of RLinf sends the observations of several
environments in one request: a list of prompts, and arrays whose first axis is the environment.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.protocol.messages import Budget, is_name
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.messages.layouts import libero_state

MSGPACK, JSON = "application/msgpack", "application/json"

_IMAGE_PREFIX = "observation.images."
_BASE64_KEYS = ("b64_json", "base64")  # base64 keys of an image that is a JPEG or PNG file
_VALUE_KEYS = ("values", "data")  # value keys of a map with an array that is written as a list
_DTYPES = {name: np.dtype(name) for name in ("uint8", "int32", "int64", "float32", "float64")}


@dataclass(frozen=True, slots=True)
class AnswerForm:
    """The form in which a client requests its answer.

    Attributes:
        is_raw: Whether the answer contains only the actions, without SGLang's envelope.
        as_arrays: Whether actions are arrays, which only msgpack has, instead of lists.
        with_timings: Whether the answer has the server's times.
    """

    is_raw: bool
    as_arrays: bool
    with_timings: bool


@dataclass(frozen=True, slots=True)
class GenerationRequest:
    """The observations of one or several robots; the answer has a chunk of actions for each robot.

    Attributes:
        observations: The observation of each robot: `images`, `state`, `prompt`, `parameters`, and
            any other fields of the client.
        is_batch: Whether the request has the form of a batch, which may contain only one
            observation.
        session_names: The session of each robot; empty if the client names none.
        begins_episode: Whether the episode of each robot begins with its observation.
        horizon: Number of rows of each chunk that the client requests; None for all rows.
        width: Number of values that the client expects in each row; None for any number.
        request_id: The client's id of the request; None if the request has none.
        form: The form of the answer.
    """

    observations: list[dict[str, Any]]
    is_batch: bool
    session_names: list[str]
    begins_episode: list[bool]
    horizon: int | None
    width: int | None
    request_id: str | None
    form: AnswerForm


def decode(body: bytes, media_type: str, budget: Budget) -> dict[str, Any]:
    """Decode the body of a request.

    Args:
        body: The body.
        media_type: `MSGPACK` or `JSON`.
        budget: The limits of its size and content.

    Raises:
        MalformedMessage: The body is not a map in that format.
        MessageTooLarge: The body exceeds a limit.
    """
    try:
        if media_type == MSGPACK:
            return openpi.decode(body, budget.limits)
        budget.parse(len(body))
        payload = json_numpy.loads(body, budget.limits)
    except MessageTooLarge as error:
        if len(body) > budget.limits.body_bytes:
            raise
        raise MessageTooLarge(
            f"{error}; an image as nested lists may have at most {budget.limits.items} numbers: "
            'send it as {"b64_json": …}, a JPEG or PNG file, or as an array in msgpack'
        ) from error
    if not isinstance(payload, dict):
        raise MalformedMessage(f"body: expected an object, got {type(payload).__name__}")
    return payload


def read_request(payload: Mapping[str, Any], media_type: str, budget: Budget) -> GenerationRequest:
    """Read a request, and decode its images.

    Args:
        payload: The request, as `decode` returns it.
        media_type: The media type of the answer, which determines whether actions are arrays by
            default.
        budget: Counts the decoded images; raises an error beyond its limits.

    Raises:
        MalformedMessage: A part of the request has another form.
        InvalidObservation: The observations of a batch have different lengths, or the request has a
            field that no policy here uses.
        MessageTooLarge: An image exceeds a limit, or there are too many observations.
    """
    parameters = _map(payload, "parameters")
    observation = _observation(payload)
    if "noise" in observation:
        raise InvalidObservation(
            "noise: expected none, as the policy draws its own, got some; leave it out"
        )

    _decode_images(observation, budget)
    if "state" in observation:
        observation["state"] = _plain_array(observation["state"], "state")

    session_names = _session_names(parameters)
    prompt = observation.get("prompt")
    is_batch = isinstance(prompt, list) or len(session_names) > 1
    size = len(prompt) if isinstance(prompt, list) else max(1, len(session_names))
    if session_names and len(session_names) != size:
        raise InvalidObservation(
            f"session_ids: expected one for each of {size} observations, got {len(session_names)}"
        )
    observations = _each(observation, size, budget) if is_batch else [observation]

    used_here = ("session_ids", "reset_mask", "action_horizon", "action_dim")
    others = {name: value for name, value in parameters.items() if name not in used_here}
    for one in observations:
        one["parameters"] = others

    return GenerationRequest(
        observations=observations,
        is_batch=is_batch,
        session_names=session_names,
        begins_episode=_begins_episode(parameters, len(observations)),
        horizon=_size(parameters, observation, "action_horizon"),
        width=_size(parameters, observation, "action_dim"),
        request_id=_request_id(payload),
        form=_form(payload, parameters, observation, media_type),
    )


def require_sizes(request: GenerationRequest, rows: int | None, width: int | None) -> None:
    """Raise `InvalidObservation` if the client requests more than the policy has.

    Args:
        request: The request of the client.
        rows: The number of rows in a chunk of the policy; None if it is not known.
        width: The number of values in a row; None if it is not known.
    """
    if None not in (request.horizon, rows) and request.horizon > rows:  # type: ignore[operator]
        raise InvalidObservation(
            f"action_horizon: expected at most {rows}, the rows of the policy's chunks, got "
            f"{request.horizon}; leave it out for all of them"
        )
    if None not in (request.width, width) and request.width != width:
        raise InvalidObservation(
            f"action_dim: expected {width}, the values in a row of the policy, got "
            f"{request.width}; leave it out"
        )


def trimmed(chunk: np.ndarray, request: GenerationRequest) -> np.ndarray:
    """Return the rows of a chunk, (H, D), that the client requests; raises as `require_sizes`."""
    require_sizes(request, *chunk.shape)
    return chunk[: request.horizon]


def answer(
    chunks: Sequence[np.ndarray],
    request: GenerationRequest,
    request_id: str,
    model: str,
    timings: Mapping[str, float],
) -> dict[str, Any]:
    """Return the answer to a request, for `encode`.

    Args:
        chunks: The actions for each observation, (H, D) float32, all with the same shape.
        request: The request.
        request_id: The id of the request.
        model: The name of the policy.
        timings: The server's times by name, ms.
    """
    form = request.form

    def written(values: np.ndarray) -> np.ndarray | list[Any]:
        """Return actions in the form that the client requests."""
        return values if form.as_arrays else values.tolist()

    body: dict[str, Any]
    if form.is_raw:
        actions = np.stack(chunks) if request.is_batch else chunks[0]
        body = {"request_id": request_id, "actions": written(actions)}
    else:
        # RLinf reads only the first entry, and expects it to contain the actions of all
        # environments: this was SGLang's layout before commit 0350f48.
        is_stacked = request.is_batch and bool(request.session_names)
        entries = [np.stack(chunks)] if is_stacked else list(chunks)
        horizon, width = chunks[0].shape
        body = {
            "id": request_id,
            "object": "action.generation",
            "created": int(time.time()),
            "model": model,
            "data": [_entry(index, values, written) for index, values in enumerate(entries)],
            "usage": {
                "batch_size": len(chunks),
                "action_horizon": horizon,
                "action_dim": width,
                "denoise_steps": None,  # a replica does not know them
                "prefix_cache_hit": False,
            },
        }
    if form.with_timings:
        body["timings"] = dict(timings)
    return body


def encode(value: Mapping[str, Any], media_type: str) -> bytes:
    """Encode an answer, or the metadata."""
    if media_type == MSGPACK:
        return openpi.encode(dict(value))
    return json_numpy.dumps(value).encode()


def _entry(
    index: int, values: np.ndarray, written: Callable[[np.ndarray], np.ndarray | list[Any]]
) -> dict[str, Any]:
    """Return the entry of an envelope with the actions of one observation, or of all
    observations.
    """
    return {
        "index": index,
        "input_index": index,
        "candidate_index": 0,
        "action": {
            "type": "continuous",
            "dtype": "float32",
            "shape": list(values.shape),
            "values": written(values),
        },
    }


def _map(payload: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the map `name` of a request; an empty one if there is none."""
    value = payload.get(name)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise MalformedMessage(f"{name}: expected a map, got {type(value).__name__}")
    return value


def _observation(payload: Mapping[str, Any]) -> dict[str, Any]:
    """Return the observation of a request, after replacing SGLang's alternative names:
    `observation.images.NAME`, `observation.state`, `task`.
    """
    if "input" in payload:
        request_input = _map(payload, "input")
        observation = dict(_map(request_input, "observation"))
        for name, value in request_input.items():
            if name != "observation":
                observation[name] = value
    else:
        observation = dict(payload)

    images = dict(_map(observation, "images"))
    renamed: dict[str, Any] = {}
    for name, value in observation.items():
        if isinstance(name, str) and name.startswith(_IMAGE_PREFIX):
            images[name.removeprefix(_IMAGE_PREFIX)] = value
        elif name == "observation.state":
            renamed.setdefault("state", value)
        elif name == "observation.noise":
            renamed["noise"] = value
        elif name == "task":
            renamed["prompt"] = value
        elif value is not None and name != "images":
            renamed[name] = value
    if images:
        renamed["images"] = images
    return renamed


def _decode_images(observation: dict[str, Any], budget: Budget) -> None:
    """Replace the images of an observation by arrays."""
    images = observation.get("images", {})
    if len(images) > budget.limits.cameras:
        raise MessageTooLarge(
            f"images: expected at most {budget.limits.cameras}, got {len(images)}"
        )

    files: dict[str, bytes] = {}
    for name, value in images.items():
        key = next((key for key in _BASE64_KEYS if isinstance(value, dict) and key in value), None)
        if key is not None:
            text = value[key]
            if isinstance(text, str) and text.startswith("data:"):
                text = text.partition(",")[2]
            files[name] = json_numpy.decode_base64(text, f"images/{_short(name)}")
        else:
            images[name] = _plain_array(value, f"images/{_short(name)}", pixels=True)
    decoded = decode_files(list(files.values()), budget, list(files))
    images.update(zip(files, decoded, strict=True))


def _plain_array(value: Any, name: str, *, pixels: bool = False) -> Any:
    """Return an array that is written as a list, or as a map with a list; return any other value
    unchanged.

    Args:
        value: The value.
        name: The name of the value in errors.
        pixels: Whether integers are pixels, which are returned as uint8.
    """
    dtype, shape = None, None
    if isinstance(value, dict):
        key = next((key for key in _VALUE_KEYS if key in value), None)
        if key is None:
            raise MalformedMessage(f"{name}: expected an array, got a map with {shown(value)}")
        dtype, shape = value.get("dtype"), value.get("shape")
        value = value[key]
    if not isinstance(value, list):
        return value

    array = json_numpy.rows(value)
    if pixels and dtype is None and array.dtype.kind in "iu":
        if array.size and not (array.min() >= 0 and array.max() <= 255):
            raise InvalidObservation(
                f"{name}: expected pixels from 0 to 255, got {array.min()} to {array.max()}"
            )
        dtype = "uint8"
    try:
        if dtype is not None:
            array = array.astype(_DTYPES[dtype])
        if shape is not None:
            array = array.reshape(shape)
    except (KeyError, TypeError, ValueError) as error:
        raise MalformedMessage(f"{name}: no array of {shown(dtype)} {shown(shape)}") from error
    return array


def _each(observation: Mapping[str, Any], size: int, budget: Budget) -> list[dict[str, Any]]:
    """Return the observations of a batch, whose arrays and lists have one row for each observation.

    Args:
        observation: All observations together.
        size: The number of observations.
        budget: Limits the number of observations.
    """
    if not 1 <= size <= budget.limits.requests:
        raise MessageTooLarge(
            f"request: expected 1 to {budget.limits.requests} observations, got {size}"
        )
    return [_one(observation, index, size, "") for index in range(size)]


def _one(node: Mapping[Any, Any], index: int, size: int, path: str) -> dict[str, Any]:
    """Return the values of one robot from a map with the values of all robots."""
    one: dict[str, Any] = {}
    for key, value in node.items():
        name = f"{path}{_short(key)}"
        if isinstance(value, Mapping):
            one[key] = _one(value, index, size, f"{name}/")
        elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim):
            if len(value) != size:
                raise InvalidObservation(
                    f"{name}: expected one value for each robot, {size} in all, got {len(value)}"
                )
            one[key] = value[index]
        else:
            one[key] = value
    return one


def _short(key: object) -> str:
    """Return a key of a client's map for an error, cut to 40 characters."""
    return key[:40] if isinstance(key, str) else shown(key, 40)


def _session_names(parameters: Mapping[str, Any]) -> list[str]:
    """Return the names of the sessions in a request; an empty list if the request has none."""
    names = parameters.get("session_ids")
    if names is None:
        return []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise MalformedMessage(f"session_ids: expected a list of texts, got {shown(names)}")
    for name in names:
        if not name or not is_name(name):
            raise MalformedMessage(
                f"session_ids: expected 1 to 128 visible ASCII characters each, got {shown(name)}"
            )
    if len(set(names)) != len(names):
        raise MalformedMessage(f"session_ids: expected each id only once, got {shown(names)}")
    return names


def _begins_episode(parameters: Mapping[str, Any], size: int) -> list[bool]:
    """Return whether the episode of each robot begins with its observation."""
    mask = parameters.get("reset_mask")
    if mask is None:
        return [False] * size
    if isinstance(mask, np.ndarray):
        mask = mask.tolist()
    if (
        not isinstance(mask, list)
        or len(mask) != size
        or not all(isinstance(value, bool) for value in mask)
    ):
        raise MalformedMessage(f"reset_mask: expected {size} booleans, got {shown(mask)}")
    return mask


def _size(parameters: Mapping[str, Any], observation: Mapping[str, Any], name: str) -> int | None:
    """Return a number of rows or values that the client requests; None if the request has none."""
    size = parameters.get(name, observation.get(name))
    if size is None:
        return None
    if type(size) is not int or size < 1:
        raise MalformedMessage(f"{name}: expected a whole number above 0, got {shown(size)}")
    return size


def _request_id(payload: Mapping[str, Any]) -> str | None:
    """Return the client's id of the request; None if it has none, or one that must not be
    logged.
    """
    for key in ("request_id", "id"):
        name = payload.get(key)
        if isinstance(name, str) and name and is_name(name):
            return name
    return None


def _form(
    payload: Mapping[str, Any],
    parameters: Mapping[str, Any],
    observation: Mapping[str, Any],
    media_type: str,
) -> AnswerForm:
    """Return the form in which a client requests its answer."""
    runtime = _map(payload, "runtime")
    response_format = runtime.get("response_format", "envelope")
    if not isinstance(response_format, str) or response_format not in ("envelope", "raw"):
        raise MalformedMessage(
            f"runtime.response_format: expected 'envelope' or 'raw', got {shown(response_format)}"
        )

    by_default = "numpy" if media_type == MSGPACK else "list"
    output_format = by_default
    for place in (runtime, parameters, observation):
        if "output_format" in place:
            output_format = place["output_format"]
            break
    if not isinstance(output_format, str) or output_format not in ("list", "numpy"):
        raise MalformedMessage(
            f"output_format: expected 'list' or 'numpy', got {shown(output_format)}"
        )

    with_timings = runtime.get("return_timing", payload.get("return_timing", True))
    if not isinstance(with_timings, bool):
        raise MalformedMessage(f"return_timing: expected a boolean, got {shown(with_timings)}")
    return AnswerForm(
        is_raw=response_format == "raw",
        as_arrays=output_format == "numpy" and media_type == MSGPACK,
        with_timings=with_timings,
    )


# Mappings of clients of `/v1/actions`.

PRESETS: dict[str, dict[str, Any]] = {
    # SGLang's own names: the client's names of cameras and state are used unchanged.
    "sglang": {
        "cameras": {"*": {"key": "images/*", "layout": "any"}},
        "state": {"state": {"key": "state", "optional": True}},
        "instruction": "prompt",
    },
    # RLinf, rlinf/envs/libero/libero_env.py, through `vlagents_ray_dialects.rlinf`.
    "rlinf-libero": {
        "cameras": {
            "front": "main_images",
            "wrist": {"key": "wrist_images", "optional": True},
        },
        **libero_state("states"),
        "instruction": "prompt",
        "action_gripper": {"index": 6, "open": -1.0, "closed": 1.0},
    },
}
