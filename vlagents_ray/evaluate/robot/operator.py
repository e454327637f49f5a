"""The interface to the operator at the robot, who answers questions at a terminal or on a page in
the browser.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import select
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from typing_extensions import Self

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.images.jpeg_png import decode, encode_jpeg
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct
from vlagents_ray.page_protocol import BACKLOG, PageListener, PageProtocol

Outcome = Literal["success", "failure", "partial", "repeat"]
SCENES = "scenes"
_START_QUALITY = 92  # JPEG quality of the start pictures
_OUTCOMES: dict[str, Outcome] = {"s": "success", "f": "failure", "p": "partial", "r": "repeat"}
_Phase = Literal["scene", "playing", "verdict", "next", "end"]
_CHOICES: dict[str, set[str]] = {
    "scene": {"ready", "end"},
    "playing": {"stop"},
    "verdict": {*_OUTCOMES.values()},
}
_AWAY_S = 3.0  # s; the page counts as closed after this time without a request
_LOOK_S = 0.1  # period of live pictures while the operator sets the scene, s
_BODY = 10_000  # maximum size of an answer, bytes
_PAGE_QUALITY = 80  # JPEG quality of live pictures
_FILES = {
    "operator.html": "text/html",
    "operator.css": "text/css",
    "operator.js": "text/javascript",
}
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cache-control": "no-store",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


@dataclass(frozen=True, slots=True)
class VisibleTrial:
    """The part of a trial that the operator may see; it does not depend on the policy."""

    number: int  # from 1
    total: int  # number of planned trials
    task: str
    scene: int  # from 1
    attempt: int  # from 1; higher after a repetition
    instruction: str
    setup: str  # instructions for setting the scene
    seconds: float  # time limit of the trial
    rubric: Mapping[str, float]  # points by part of the task
    # The JPEG of each camera when this scene was first started.
    start: Mapping[str, Path] = field(default_factory=dict)
    message: str = ""  # how the last attempt ended, if it has no verdict; otherwise empty

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON, with the names of the cameras instead of the start
        pictures.
        """
        return asdict(self) | {"rubric": dict(self.rubric), "start": sorted(self.start)}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The operator's judgement of a trial."""

    outcome: Outcome
    earned: tuple[str, ...] = ()  # for a partial success, the parts of the rubric that were reached
    note: str = ""  # any text; for "repeat", the required reason

    def score(self, rubric: Mapping[str, float]) -> float:
        """Return the share of the rubric's points that were earned: 1 for a success, 0 for a
        failure.

        Args:
            rubric: The points by part of the task.

        Raises:
            ConfigError: A partial success has a part that is not in the rubric, or there is no
                rubric, or a repetition has no reason.
        """
        if self.outcome == "repeat" and not self.note.strip():
            raise ConfigError(
                "verdict: expected a reason for the repetition, got none; write a reason"
            )
        if self.outcome != "partial":
            return float(self.outcome == "success")

        unknown_parts = sorted(set(self.earned) - rubric.keys())
        if not rubric or unknown_parts:
            actual = f"the parts {unknown_parts}" if rubric else "a partial success"
            raise ConfigError(
                f"verdict: expected only the rubric's marks {sorted(rubric)}, got {actual}; see "
                "`robot.tasks`"
            )
        points = sum(rubric[name] for name in set(self.earned))
        return points / sum(rubric.values())


class Operator(Protocol):
    """The interface to the operator. All methods are called on one thread, in this order."""

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        """Wait until the operator has set the scene. The robot stays still.

        Args:
            trial: The next trial.
            observe: Reads the robot's sensors, for live pictures.

        Returns:
            True to begin the trial, False to end the evaluation; it can be resumed.
        """

    def watch(self, obs: Obs) -> None:
        """Show an observation of the running trial. This is called at each control tick, so it must
        return immediately.
        """

    def stops(self) -> bool:
        """Return whether to stop the running trial, for example because the operator's page was
        closed.
        """

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        """Ask the operator for the verdict. The robot stays still.

        Args:
            trial: The trial that has ended.
            ending: The end of the trial, in words.

        Returns:
            The verdict. If the trial must be repeated, the verdict's note is the reason.

        Raises:
            KeyboardInterrupt: The operator has left. The trial will be repeated.
        """


def start_pictures(out: Path, scene: str) -> dict[str, Path]:
    """Return the JPEG of each camera from the first start of a scene; {} if the scene has not been
    started.
    """
    return {path.stem: path for path in sorted((out / SCENES / scene).glob("*.jpg"))}


def save_start(out: Path, scene: str, obs: Obs) -> None:
    """Save the pictures of a scene at its start, and replace earlier pictures."""
    for camera, name in distinct(obs.cameras).items():
        with whole(out / SCENES / scene / f"{name}.jpg") as unfinished_path:
            unfinished_path.write_bytes(encode_jpeg(obs.cameras[camera], _START_QUALITY))


def save_overlay(start: Path, now: np.ndarray) -> Path:
    """Save the mean of a camera's start picture and present picture, next to the folder of the
    start picture.

    Returns:
        The new JPEG, with the size of `now`. If the sizes differ, it shows only `now`.
    """
    start_picture = decode(start.read_bytes())
    if start_picture.shape == now.shape:
        mean = ((start_picture.astype(np.uint16) + now) // 2).astype(np.uint8)
    else:
        mean = now

    path = start.parent.with_name(f"overlay-{start.name}")
    with whole(path) as unfinished_path:
        unfinished_path.write_bytes(encode_jpeg(mean, _START_QUALITY))
    return path


class TerminalOperator(Operator):
    """An operator at a terminal. Enter stops a running trial.

    Args:
        ask: Prints a question and returns the typed line, as `input` does; raises `EOFError` at the
            end of the input.
        say: Prints a line.
        stopping: Returns whether to stop the running trial; by default, whether Enter was pressed.
    """

    def __init__(
        self,
        ask: Callable[[str], str] = input,
        say: Callable[[str], None] = print,
        stopping: Callable[[], bool] | None = None,
    ) -> None:
        self._ask = ask
        self._say = say
        self._stopping = _enter_pressed if stopping is None else stopping

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        """Print the trial and the instructions for its scene, and wait for Enter. The input "q", or
        the end of the input, ends the evaluation.
        """
        self._say(f"\ntrial {trial.number} of {trial.total}: {trial.task}, scene {trial.scene}")
        pictures = (f"set it as in {picture}" for picture in trial.start.values())
        for line in filter(None, (trial.message, trial.instruction, trial.setup, *pictures)):
            self._say(f"  {line}")

        while True:
            try:
                typed = self._ask(
                    "Enter when the scene is ready, l to look at it over the start picture, q to "
                    "end: "
                )
            except EOFError:
                return False
            if typed.strip().lower() in ("", "q"):
                return not typed.strip()
            if typed.strip().lower() == "l":
                self._look(trial, observe())

    def watch(self, obs: Obs) -> None:
        """Show nothing, as the operator sees the robot."""

    def stops(self) -> bool:
        return self._stopping()

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        """Ask for the outcome, for the reached parts of the rubric in a partial success, and for a
        note.

        Repeat the questions until the verdict is valid.
        """
        self._say(f"trial {trial.number} has ended: {ending}")
        partial = "p partial, " if trial.rubric else ""
        choices = f"s success, f failure, {partial}r repeat"
        while True:
            try:
                outcome = _OUTCOMES.get(self._ask(f"verdict ({choices}): ").strip().lower())
                if outcome is None:
                    continue

                earned = self._earned_parts(trial.rubric) if outcome == "partial" else ()
                note = self._ask("why: " if outcome == "repeat" else "note: ").strip()
                verdict = Verdict(outcome, earned, note)
            except EOFError:
                raise KeyboardInterrupt from None

            try:
                verdict.score(trial.rubric)
            except ConfigError as error:
                self._say(str(error))
            else:
                return verdict

    def _earned_parts(self, rubric: Mapping[str, float]) -> tuple[str, ...]:
        """Ask, for each part of the rubric, whether it was reached."""
        earned = []
        for name, points in rubric.items():
            answer = self._ask(f"  {name} ({points:g} points), reached? y/n: ")
            if answer.strip().lower().startswith("y"):
                earned.append(name)
        return tuple(earned)

    def _look(self, trial: VisibleTrial, obs: Obs) -> None:
        if not trial.start:
            self._say("  this scene has no start picture yet: it is taken when you begin")
        for camera, name in distinct(obs.cameras).items():
            if name in trial.start:
                self._say(f"  {save_overlay(trial.start[name], obs.cameras[camera])}")


def _enter_pressed() -> bool:
    """Return whether a line was typed at the terminal; False if the input is not a terminal, since
    its lines are then answers to later questions.
    """
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    sys.stdin.readline()
    return True


class PageOperator(Operator):
    """An operator who uses a page in the browser, which is served within the context of this
    object.

    The server of the page listens on the loopback interface, and the address has a random part. A
    running trial is stopped if the page has sent no request for 3 s, for example because it was
    closed. When the context ends, an open page shows whether the evaluation is complete.

    Args:
        say: Prints a line with the page's address.
        port: The port; 0 selects a free port.
    """

    def __init__(self, say: Callable[[str], None] = print, port: int = 0) -> None:
        self._say = say
        self._port = port
        self._changed = threading.Condition()
        self._phase: _Phase = "next"
        self._trial: VisibleTrial | None = None
        self._ending = ""
        self._answer: dict[str, Any] | None = None
        self._obs: Obs | None = None
        self._asked_at = 0.0  # time of the page's last request
        self._end_shown = threading.Event()
        self.url = ""
        """The page's address within the context."""

    def __enter__(self) -> Self:
        listening = PageListener.bound("127.0.0.1", self._port)
        token = secrets.token_urlsafe(24)
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}/{token}/"

        routes = [
            Route("/", self._file),
            Route("/{name:str}", self._file),
            Route("/now/state", self._state),
            Route("/now/camera/{name:path}", self._camera),
            Route("/start/{name:path}", self._start),
            Route("/now/answer", self._take, methods=["POST"]),
        ]
        app = Starlette(routes=[Mount(f"/{token}", routes=routes)])
        settings = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            http=PageProtocol,
            ws="none",
            backlog=BACKLOG,
        )

        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._server.serve([listening])),
            name="vlagents-ray-operator",
            daemon=True,
        )
        self._thread.start()
        self._say(f"the operator's page: {self.url}")
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        with self._changed:
            self._phase, self._answer = "end", None
            if error_type is None:
                self._ending = "The evaluation is complete: close this page"
            elif issubclass(error_type, KeyboardInterrupt):
                self._ending = (
                    "The evaluation was interrupted: --resume continues it, at a new address"
                )
            else:
                self._ending = "The evaluation ended with an error: see the terminal"

        if self._is_watched():
            self._end_shown.wait(_AWAY_S)
        self._server.should_exit = self._server.force_exit = True
        self._thread.join()

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        """Show the instructions for the scene and live pictures, until the page sends an answer."""
        self._enter("scene", trial)
        answer = self._wait(_LOOK_S)
        while answer is None:
            if self._is_watched():
                self._obs = observe()
            answer = self._wait(_LOOK_S)

        self._enter("playing" if answer["do"] == "ready" else "next", trial)
        return bool(answer["do"] == "ready")

    def watch(self, obs: Obs) -> None:
        self._obs = obs

    def stops(self) -> bool:
        return self._answer is not None or not self._is_watched()

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        """Show the form for the verdict, until the page sends the verdict."""
        self._enter("verdict", trial, ending)
        answer = self._wait(1.0)
        while answer is None:
            answer = self._wait(1.0)

        self._enter("next", trial)
        return _verdict(answer)

    def _enter(self, phase: _Phase, trial: VisibleTrial, ending: str = "") -> None:
        with self._changed:
            self._phase = phase
            self._trial = trial
            self._ending = ending
            self._answer = None

    def _wait(self, seconds: float) -> dict[str, Any] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._answer is not None, seconds)
            return self._answer

    def _is_watched(self) -> bool:
        return time.monotonic() - self._asked_at < _AWAY_S

    async def _file(self, http: Request) -> Response:
        name = http.path_params.get("name", "operator.html")
        if name not in _FILES:
            return PlainTextResponse("not found", 404)
        file = package_files("vlagents_ray.evaluate.robot") / "page" / name
        text = file.read_text(encoding="utf-8")
        return Response(text, media_type=_FILES[name], headers=_HEADERS)

    async def _state(self, _: Request) -> Response:
        self._asked_at = time.monotonic()
        obs = self._obs
        with self._changed:
            shown = None if self._trial is None else self._trial.to_json()
            state = {
                "phase": self._phase,
                "trial": shown,
                "ending": self._ending,
                "answered": self._answer is not None,
            }

        cameras = [] if obs is None else sorted(distinct(obs.cameras).values())
        sent = BackgroundTask(self._end_shown.set) if state["phase"] == "end" else None
        return JSONResponse(state | {"cameras": cameras}, background=sent)

    async def _camera(self, http: Request) -> Response:
        obs = self._obs
        if obs is None:
            return PlainTextResponse("not found", 404)
        cameras_by_name = {name: camera for camera, name in distinct(obs.cameras).items()}
        camera = cameras_by_name.get(http.path_params["name"])
        if camera is None:
            return PlainTextResponse("not found", 404)

        picture = await run_in_threadpool(encode_jpeg, obs.cameras[camera], _PAGE_QUALITY)
        return Response(picture, media_type="image/jpeg", headers=_HEADERS)

    async def _start(self, http: Request) -> Response:
        trial = self._trial
        path = None if trial is None else trial.start.get(http.path_params["name"])
        if path is None:
            return PlainTextResponse("not found", 404)
        return FileResponse(path, headers=_HEADERS)

    async def _take(self, http: Request) -> Response:
        """Accept an answer from the page if it belongs to the present trial and question."""
        if not http.headers.get("content-type", "").startswith("application/json"):
            return PlainTextResponse("expected application/json", 415)

        body = b""
        async for data in http.stream():
            body += data
            if len(body) > _BODY:
                return PlainTextResponse(f"expected at most {_BODY} bytes", 413)

        try:
            answer = json.loads(body)
            if not isinstance(answer["do"], str):
                raise TypeError
            question = answer["phase"], answer["trial"], answer["attempt"]
            verdict = _verdict(answer) if answer["phase"] == "verdict" else None
        except (ValueError, TypeError, KeyError, RecursionError):
            return PlainTextResponse("expected phase, trial, attempt, do, earned and note", 400)

        with self._changed:
            trial = self._trial
            if (
                trial is None
                or question != (self._phase, trial.number, trial.attempt)
                or self._answer is not None
            ):
                return PlainTextResponse("this question is no longer open", 409)

            choices = _CHOICES.get(self._phase, set())
            if answer["do"] not in choices:
                return PlainTextResponse(f"do: expected one of {sorted(choices)}", 400)
            try:
                if verdict is not None:
                    verdict.score(trial.rubric)
            except ConfigError as error:
                return PlainTextResponse(str(error), 400)

            self._answer = answer
            self._changed.notify_all()
        return JSONResponse({})


def _verdict(answer: dict[str, Any]) -> Verdict:
    earned = tuple(map(str, answer.get("earned", ())))
    return Verdict(answer["do"], earned, str(answer.get("note", "")))
