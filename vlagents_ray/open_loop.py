"""Datasets as episodes, and their replay to a policy, with several sessions at once, so that it computes in batches."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.dataset_contract import INFO, DatasetContract, divided_state, state_parts
from vlagents_ray.errors import ConfigError, PolicyFailed, VLAgentsError
from vlagents_ray.evaluate.artifacts.storage import storing, whole
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.mp4 import rgb_converter
from vlagents_ray.interface import CAPTURED, Agent, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget
from vlagents_ray.protocol.values import from_text
from vlagents_ray.registry import require
from vlagents_ray.robot.episode import ACTION, ENVIRONMENT, IMAGES, INTERVENTION_COLUMN, SAFE_COLUMN, STATE
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import own_settings, policy_application
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.serve.models.checkpoints import CHOICE, STEP
from vlagents_ray.serve.observers.episodes import CHUNK, ROWS, SESSION, TRACE
from vlagents_ray.serve.weights import OPTION

_PICTURES = ("video", "image")  # dtypes


@dataclass(frozen=True, slots=True)
class Names:
    """The policy's names for the cameras and state of a dataset without a contract of ours."""

    cameras: Mapping[str, str] = field(default_factory=dict)  # policy's camera -> camera or feature of the dataset
    state: Sequence[str] | None = None  # concatenated parts of `observation.state`; "gripper" is `Obs.gripper`


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """A frame of an episode."""

    frame: int
    obs: Obs
    expected: np.ndarray  # (H, D): the recorded answer, or the actions from here to the end of the episode
    intervention: bool = False  # whether the recorded action is an operator's


@dataclass(frozen=True, slots=True)
class RecordedEpisode:
    """An episode of a dataset."""

    dataset: RecordedDataset
    index: int
    length: int
    instruction: str
    places: Mapping[str, Any]  # its row in `meta/episodes`


@dataclass(frozen=True, slots=True)
class RecordedSession:
    """The episodes of one session in order; in a public dataset, a single episode."""

    parts: tuple[RecordedEpisode, ...]
    options: Mapping[str, Any]  # of the reset


class RecordedDataset:
    """A dataset that is only read."""

    def __init__(self, root: Path) -> None:
        """Open a dataset; raises `ConfigError` if it cannot be read."""
        self.root = root
        self._pq: Any = require("pyarrow.parquet")
        self._av: Any = require("av")
        self.info: dict[str, Any] = json.loads((root / "meta/info.json").read_text())
        self.version = str(self.info.get("codebase_version"))
        if not self.version.startswith(("v3.", "v2.")):
            raise ConfigError(f"{root}: got a LeRobotDataset {self.version}, want v3.0, v2.1 or v2.0; convert it")
        self.features: dict[str, Any] = self.info["features"]
        if ACTION not in self.features:
            raise ConfigError(f"{root}: got features {sorted(self.features)}, want {ACTION!r} among them")
        about = self.info.get(INFO)
        self.contract = None if about is None else DatasetContract.from_json(about)
        self.traced = TRACE in self.info and CHUNK in self.features

    @property
    def joints(self) -> list[str]:
        """The names of the numbers of an action."""
        names = self.features[ACTION].get("names")
        if isinstance(names, Mapping):  # {"motors": [...]}
            names = [name for group in names.values() for name in group]
        [dim] = self.features[ACTION]["shape"]
        return [str(name) for name in names] if names and len(names) == dim else [f"{ACTION}_{i}" for i in range(dim)]

    def plays(self, chosen: Sequence[int] | None = None) -> list[RecordedSession]:
        """Return the sessions of the dataset, of all its episodes or of those chosen; raises `ConfigError`."""
        parts = self._parts()
        if chosen is not None:
            if missing := sorted(set(chosen) - {part.index for part in parts}):
                raise ConfigError(f"{self.root}: has {len(parts)} episodes, got {missing} among those to replay")
            parts = [part for part in parts if part.index in set(chosen)]
        if not self.traced:
            return [RecordedSession((part,), {}) for part in parts]
        sessions: dict[int, tuple[list[RecordedEpisode], str]] = {}  # with the options of the first reset
        for part in parts:
            columns = self._rows(part, [SESSION, "reset"])
            sessions.setdefault(columns[SESSION][0], ([], columns["reset"][0]))[0].append(part)
        return [RecordedSession(tuple(found), _values(reset)) for found, reset in sessions.values()]

    def gaps(self, part: RecordedEpisode) -> int:
        """Return the number of missing acts within a traced episode."""
        ticks = np.array(self._rows(part, ["tick"])["tick"]) if self.traced else np.zeros(0, np.int64)
        return int((np.diff(ticks) - 1).clip(0).sum())

    def steps(self, part: RecordedEpisode, names: Names, policy: Contract | None) -> Iterator[RecordedStep]:
        """Yield the frames of an episode, with the input names of a policy with that contract."""
        pictures = [name for name, one in self.features.items() if one["dtype"] in _PICTURES]
        images = [name for name in pictures if self.features[name]["dtype"] == "image"]
        traced = [CHUNK, ROWS, "request", "captured_at"] if self.traced else []
        columns = (ACTION, STATE, ENVIRONMENT, INTERVENTION_COLUMN, SAFE_COLUMN)
        numbers = [name for name in columns if name in self.features]
        rows = self._rows(part, [*numbers, *images, *traced])
        actions = np.array(rows[ACTION], np.float32).reshape(part.length, -1)
        cameras = self._cameras(pictures, names)
        states = self._states(names, policy)
        videos = {name: self._video(part, name) for name in cameras if name not in images}
        for i in range(part.length):
            shown = {}
            for name, camera in cameras.items():
                if name in videos:
                    image = next(videos[name])
                elif data := rows[name][i].get("bytes"):
                    image = jpeg_png.decode(data, DEFAULT_LIMITS.pixels)
                else:
                    path = rows[name][i].get("path")
                    raise ConfigError(f"a picture is at {path!r}, want its bytes in the table; LeRobot embeds them")
                spec = None if self.contract is None else (self.contract.contract.cameras or {}).get(camera)
                if spec is not None and spec.height is not None and spec.width is not None:
                    # Without the row and the column that were added to make the size of its video even.
                    image = np.ascontiguousarray(image[: spec.height, : spec.width])
                shown[camera] = image
            state, gripper = divided_state(
                {name: np.atleast_1d(np.array(rows[name][i], np.float32)) for name in states}, states
            )
            info = {}
            expected = actions[i:]
            if traced:
                info = {CAPTURED: rows["captured_at"][i], **_values(rows["request"][i])}
                expected = np.array(rows[CHUNK][i], np.float32).reshape(-1, actions.shape[1])[: rows[ROWS][i]]
            led = INTERVENTION_COLUMN in rows and bool(rows[INTERVENTION_COLUMN][i])
            # Datasets of earlier releases also mark an operator's action that the guard refused.
            led = led and not (SAFE_COLUMN in rows and rows[SAFE_COLUMN][i])
            yield RecordedStep(i, Obs(shown, gripper, state, info), expected, led)

    def _parts(self) -> list[RecordedEpisode]:
        if self.version.startswith("v2."):
            lines = (self.root / "meta/episodes.jsonl").read_text().splitlines()
            rows = [json.loads(line) for line in lines if line.strip()]
        else:
            rows = []
            for path in sorted(self.root.glob("meta/episodes/*/*.parquet")):
                with self._pq.ParquetFile(path) as file:
                    kept = [name for name in file.schema_arrow.names if not name.startswith("stats/")]
                    rows += file.read(kept).to_pylist()
        rows.sort(key=lambda row: row["episode_index"])
        return [
            RecordedEpisode(self, row["episode_index"], row["length"], str(next(iter(row.get("tasks") or ()), "")), row)
            for row in rows
        ]

    def _rows(self, part: RecordedEpisode, columns: Sequence[str]) -> dict[str, list[Any]]:
        file = self.root / self.info["data_path"].format(**self._place(part, "data"))
        filters = [("episode_index", "=", part.index)]
        rows: dict[str, list[Any]] = self._pq.read_table(file, columns=list(columns), filters=filters).to_pydict()
        if any(len(values) != part.length for values in rows.values()):
            raise ConfigError(f"{file}: has not the {part.length} frames of episode {part.index}; is it complete?")
        return rows

    def _place(self, part: RecordedEpisode, kind: str) -> dict[str, int]:
        if self.version.startswith("v2."):
            return {"episode_index": part.index, "episode_chunk": part.index // int(self.info["chunks_size"])}
        return {name: part.places[f"{kind}/{name}"] for name in ("chunk_index", "file_index")}

    def _video(self, part: RecordedEpisode, feature: str) -> Iterator[np.ndarray]:
        """Yield the images of an episode, (H, W, 3) uint8 RGB."""
        place = self._place(part, f"videos/{feature}")
        file = self.root / self.info["video_path"].format(video_key=feature, **place)
        start_s = float(part.places.get(f"videos/{feature}/from_timestamp") or 0)
        convert = rgb_converter()
        with self._av.open(str(file)) as container:
            [stream, *_] = container.streams.video
            if start_s:
                container.seek(int(start_s / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= start_s - 0.5 / self.info["fps"]:
                    yield convert(frame)
        raise ConfigError(f"{file}: has fewer than the {part.length} frames of episode {part.index}")

    def _cameras(self, pictures: Sequence[str], names: Names) -> dict[str, str]:
        """Return the policy's name of each feature that contains images."""
        known = {} if self.contract is None else self.contract.cameras
        own = {feature: known.get(feature, feature.removeprefix(IMAGES)) for feature in pictures}
        if not names.cameras:
            return own
        found = {camera: feature for feature, camera in own.items()} | {feature: feature for feature in pictures}
        if unknown := [name for name in names.cameras.values() if name not in found]:
            raise ConfigError(
                f"--camera-map: {self.root} has no {unknown[0]!r}, want some of {sorted(own.values())}"
                f"{did_you_mean(unknown[0], found)}"
            )
        return {found[name]: camera for camera, name in names.cameras.items()}

    def _states(self, names: Names, policy: Contract | None) -> dict[str, list[tuple[str, int]]]:
        """Return the parts, and their widths, of each state feature."""
        widths = {name: int(self.features[name]["shape"][0]) for name in (STATE, ENVIRONMENT) if name in self.features}
        about = self.contract
        if about is not None and names.state is None:
            specs = about.contract.state or {}
            order = {STATE: about.state, ENVIRONMENT: about.environment}
            return {
                name: [(part, int(specs[part].dim or 0) if part in specs else 1) for part in order[name]]
                for name in widths
            }
        found: dict[str, list[tuple[str, int]]] = {}
        if ENVIRONMENT in widths:
            found[ENVIRONMENT] = [(ENVIRONMENT.rpartition(".")[2], widths[ENVIRONMENT])]
        if STATE in widths:
            found[STATE] = state_parts(widths[STATE], policy, names.state, option="--state joints,gripper")
        return found


def _values(text: str) -> dict[str, Any]:
    return dict(from_text(text, Budget(DEFAULT_LIMITS))) if text else {}


Sessions = Callable[[], Agent]  # opens a session; the caller closes it

FILE = "open_loop.json"
_WORST = 10


@contextmanager
def candidate(source: str) -> Iterator[Sessions]:
    """Load a policy for the duration of the context.

    Yields:
        A function that opens sessions, which share the policy's batches.
    """
    if "://" in source:
        yield partial(RemoteAgent, source, rank="simulation", codec="exact")
        return
    application = policy_application(source)
    with LocalPolicy(ServerArgs(**application.args), own_settings(application), threaded=True) as policy:
        policy.initialize()
        yield lambda: policy.sessions(1)[0]


@dataclass
class ErrorTable:
    """Sums over the frames so far, for each step of the horizon (H) and each number of an action (D)."""

    joints: list[str]  # the names of these numbers
    absolute: np.ndarray = field(init=False)  # (H, D), of the absolute errors
    square: np.ndarray = field(init=False)  # (H, D), of the squared errors
    largest: np.ndarray = field(init=False)  # (H, D), largest absolute error
    frames: np.ndarray = field(init=False)  # (H,)

    def __post_init__(self) -> None:
        self.absolute, self.square, self.largest = (np.zeros((0, len(self.joints))) for _ in range(3))
        self.frames = np.zeros(0, np.int64)

    def add(self, expected: np.ndarray, got: np.ndarray) -> float:
        """Add a frame's chunks, (H, D) each, and return their mean absolute error."""
        if (rows := len(expected)) > len(self.frames):
            more = ((0, rows - len(self.frames)), (0, 0))
            self.absolute, self.square, self.largest = (
                np.pad(one, more) for one in (self.absolute, self.square, self.largest)
            )
            self.frames = np.pad(self.frames, more[0])
        error = np.abs(got.astype(np.float64) - expected.astype(np.float64))
        self.absolute[:rows] += error
        self.square[:rows] += error**2
        self.largest[:rows] = np.maximum(self.largest[:rows], error)
        self.frames[:rows] += 1
        return float(error.mean())

    def to_json(self) -> dict[str, Any]:
        """Return the errors overall, by joint, by step, and by both, in the units of the actions."""
        total = max(1, int(self.frames.sum()))
        mae, rms = self.absolute.sum(0) / total, np.sqrt(self.square.sum(0) / total)
        largest = self.largest.max(0, initial=0)
        means, squares = (sums / self.frames[:, np.newaxis] for sums in (self.absolute, self.square))
        by_step = zip(self.frames, means.mean(1), np.sqrt(squares.mean(1)), strict=True)
        return {
            "mae": float(mae.mean()),
            "rmse": float(np.sqrt((rms**2).mean())),
            "max": float(largest.max(initial=0)),
            "by_joint": [
                {"joint": name, "mae": float(mae[i]), "rmse": float(rms[i]), "max": float(largest[i])}
                for i, name in enumerate(self.joints)
            ],
            "by_step": [
                {"step": step, "frames": int(frames), "mae": float(mean), "rmse": float(root)}
                for step, (frames, mean, root) in enumerate(by_step)
            ],
            "mae_by_step_and_joint": means.tolist(),
        }


@dataclass(frozen=True, slots=True)
class ReplayPlan:
    """The settings of a replay."""

    episodes: Sequence[int] | None = None  # of each dataset; None: all
    horizon: int | None = None  # largest number of compared rows of a chunk; None: all rows that both have
    every: int = 1  # stride of the queried frames in a dataset without recorded answers
    at_once: int = 8  # number of concurrent sessions
    names: Names = field(default_factory=Names)


@dataclass
class OpenLoopResult:
    """The errors of one policy on some datasets."""

    datasets: list[str]
    against: str  # "answers" recorded by a server, or "actions" of the dataset
    table: ErrorTable
    sessions: int = 0
    missing: int = 0  # acts that the recording lacks, so that a policy with a history received less
    frames: list[dict[str, Any]] = field(default_factory=list)  # dataset, episode, frame, and its chunk's "mae"

    def to_json(self) -> dict[str, Any]:
        by_episode: dict[tuple[str, int], list[float]] = {}
        for one in self.frames:
            by_episode.setdefault((one["dataset"], one["episode"]), []).append(one["mae"])
        return {
            "datasets": self.datasets,
            "against": self.against,
            "sessions": self.sessions,
            "frames": len(self.frames),
            "missing_acts": self.missing,
            **self.table.to_json(),
            "by_episode": [
                {"dataset": dataset, "episode": episode, "frames": len(errors), "mae": float(np.mean(errors))}
                for (dataset, episode), errors in sorted(by_episode.items())
            ],
            "worst": sorted(self.frames, key=lambda one: -one["mae"])[:_WORST],
        }


def replay(folder: Path, sessions: Sessions, plan: ReplayPlan) -> OpenLoopResult:
    """Query a policy at each frame, and compare its actions with the dataset's.

    A session is reset with its first recorded observation, its instruction and its options, and then receives each of
    its observations in order, whatever its answers are.

    Raises:
        ConfigError: There is no dataset, its actions do not fit the policy's, or a name is unknown.
        PolicyFailed: The policy raised an error, or refused an observation.
    """
    found = [path for pattern in ("", "*/") for path in sorted(folder.glob(f"{pattern}meta/info.json"))]
    if not (datasets := [RecordedDataset(path.parents[1]) for path in found]):
        raise ConfigError(f"{folder}: is no LeRobotDataset, and has none in it (meta/info.json)")
    first = datasets[0]
    for other in datasets[1:]:
        if len(other.joints) != len(first.joints) or other.traced != first.traced:
            raise ConfigError(f"{other.root}: has other actions than {first.root}; replay them one by one")
    plays = [play for dataset in datasets for play in dataset.plays(plan.episodes)]
    against = "answers" if first.traced else "actions"
    result = OpenLoopResult([str(one.root) for one in datasets], against, ErrorTable(first.joints))
    result.missing = sum(part.dataset.gaps(part) for play in plays for part in play.parts)
    lock = threading.Lock()

    def one(play: RecordedSession) -> None:
        agent = sessions()
        try:
            for part, step, got in _answers(play, agent, plan):
                expected = step.expected
                if got.shape[1] != expected.shape[1]:
                    raise ConfigError(
                        f"{part.dataset.root}: its actions have {expected.shape[1]} numbers, those of the policy "
                        f"{got.shape[1]}; want a policy of the same robot and control mode"
                    )
                rows = min(len(expected), len(got), plan.horizon or len(got))
                with lock:
                    mae = result.table.add(expected[:rows], got[:rows])
                    place = {"dataset": part.dataset.root.name, "episode": part.index, "frame": step.frame}
                    result.frames.append({**place, "mae": mae})
        finally:
            agent.close()
        with lock:
            result.sessions += 1

    with ThreadPoolExecutor(plan.at_once, "open-loop") as threads:
        futures = [threads.submit(one, play) for play in plays]
        try:
            for future in futures:
                future.result()
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return result


def _answers(
    play: RecordedSession, agent: Agent, plan: ReplayPlan
) -> Iterator[tuple[RecordedEpisode, RecordedStep, np.ndarray]]:
    """Yield the frames of a session, each with the policy's action, (H, D)."""
    begun = False
    for part in play.parts:
        every = 1 if part.dataset.traced else plan.every
        for step in islice(part.dataset.steps(part, plan.names, agent.contract), 0, None, every):
            try:
                if not begun:
                    chosen = CHOICE, STEP, OPTION  # options that choose its weights
                    options = {name: one for name, one in play.options.items() if name not in chosen}
                    agent.reset(step.obs, part.instruction, **options)
                    begun = True
                got = agent.act(step.obs).rows()
            except VLAgentsError as error:
                where = f"{part.dataset.root}, episode {part.index}, frame {step.frame}"
                raise PolicyFailed(f"{where}: {error}") from error
            yield part, step, got


def write_result(result: OpenLoopResult, policy: str, folder: Path) -> Path:
    """Write `open_loop.json` into a folder, which is created if needed; return its path."""
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with whole(folder / FILE) as part:
            part.write_text(json.dumps({"policy": policy, **result.to_json()}, indent=2, ensure_ascii=False), "utf-8")
    return folder / FILE
