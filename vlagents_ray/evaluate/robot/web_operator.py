"""An operator at a page in the browser, served on this machine alone."""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
import threading
import time
from collections.abc import Callable
from importlib.resources import files as package_files
from typing import TYPE_CHECKING, Any, Literal

import uvicorn
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.robot.operator import Operator, Verdict, VisibleTrial
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct

if TYPE_CHECKING:
    from typing_extensions import Self

_Phase = Literal["scene", "playing", "verdict", "next", "end"]
_CHOICES = {
    "scene": {"ready", "end"},
    "playing": {"stop"},
    "verdict": {"success", "failure", "partial", "repeat"},
    "next": set[str](),
    "end": set[str](),
}
_AWAY_S = 3.0  # without a request of the page; then nobody watches
_LOOK_S = 0.1  # between two live pictures while the scene is set
_BODY = 10_000  # bytes of an answer
_QUALITY = 80
_FILES = {"operator.html": "text/html", "operator.css": "text/css", "operator.js": "text/javascript"}
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cache-control": "no-store",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


class PageOperator(Operator):
    """An operator at a page in the browser. Use as a context manager: the page is served within it.

    The page is on the loopback interface, and its address has a random part, without which there is no answer. A
    running trial is stopped if the page has asked for nothing for 3 s, as when it was closed. At the end of the context
    an open page says whether the evaluation is complete.

    Args:
        say: Prints a line: the page's address.
        port: The port; 0 takes a free one.
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
        self._asked_at = 0.0  # when the page asked last
        self._end_shown = threading.Event()
        self.url = ""
        """The page's address within the context."""

    def __enter__(self) -> Self:
        listening = socket.create_server(("127.0.0.1", self._port))
        token = secrets.token_urlsafe(24)
        self.url = f"http://127.0.0.1:{listening.getsockname()[1]}/{token}/"
        app = Starlette(routes=[Mount(f"/{token}", routes=self._routes())])
        settings = uvicorn.Config(app, log_config=None, access_log=False, lifespan="off", ws="none")
        self._server = uvicorn.Server(settings)
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._server.serve([listening])), name="vlagents-ray-operator", daemon=True
        )
        self._thread.start()
        self._say(f"the operator's page: {self.url}")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._changed:
            self._phase, self._answer = "end", None
            if kind is None:
                self._ending = "The evaluation is complete: close this page"
            elif issubclass(kind, KeyboardInterrupt):
                self._ending = "The evaluation was interrupted: --resume goes on with it, at a new address"
            else:
                self._ending = "The evaluation ended with an error: see the terminal"
        if self._is_watched():
            self._end_shown.wait(_AWAY_S)
        self._server.should_exit = self._server.force_exit = True
        self._thread.join()

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        self._enter("scene", trial)
        while (answer := self._wait(_LOOK_S)) is None:
            if self._is_watched():
                self._obs = observe()
        self._enter("playing" if answer["do"] == "ready" else "next", trial)
        return bool(answer["do"] == "ready")

    def watch(self, obs: Obs) -> None:
        self._obs = obs

    def stops(self) -> bool:
        return self._answer is not None or not self._is_watched()

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        self._enter("verdict", trial, ending)
        while (answer := self._wait(1.0)) is None:
            pass
        self._enter("next", trial)
        return _verdict(answer)

    def _enter(self, phase: _Phase, trial: VisibleTrial, ending: str = "") -> None:
        with self._changed:
            self._phase, self._trial, self._ending, self._answer = phase, trial, ending, None

    def _wait(self, seconds: float) -> dict[str, Any] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._answer is not None, seconds)
            return self._answer

    def _is_watched(self) -> bool:
        return time.monotonic() - self._asked_at < _AWAY_S

    def _routes(self) -> list[Route]:
        return [
            Route("/", self._file),
            Route("/{name:str}", self._file),
            Route("/now/state", self._state),
            Route("/now/camera/{name:path}", self._camera),
            Route("/start/{name:path}", self._start),
            Route("/now/answer", self._take, methods=["POST"]),
        ]

    async def _file(self, http: Request) -> Response:
        name = http.path_params.get("name", "operator.html")
        if name not in _FILES:
            return PlainTextResponse("not found", 404)
        text = (package_files("vlagents_ray.evaluate.robot") / "page" / name).read_text(encoding="utf-8")
        return Response(text, media_type=_FILES[name], headers=_HEADERS)

    async def _state(self, _: Request) -> Response:
        self._asked_at = time.monotonic()
        obs = self._obs
        with self._changed:
            shown = None if self._trial is None else self._trial.to_json()
            state = {"phase": self._phase, "trial": shown, "ending": self._ending, "answered": self._answer is not None}
        cameras = [] if obs is None else sorted(distinct(obs.cameras).values())
        sent = BackgroundTask(self._end_shown.set) if state["phase"] == "end" else None
        return JSONResponse(state | {"cameras": cameras}, background=sent)

    async def _camera(self, http: Request) -> Response:
        obs = self._obs
        names = {} if obs is None else {name: camera for camera, name in distinct(obs.cameras).items()}
        camera = names.get(http.path_params["name"])
        if obs is None or camera is None:
            return PlainTextResponse("not found", 404)
        picture = await run_in_threadpool(encode_jpeg, obs.cameras[camera], _QUALITY)
        return Response(picture, media_type="image/jpeg", headers=_HEADERS)

    async def _start(self, http: Request) -> Response:
        trial = self._trial
        path = None if trial is None else trial.start.get(http.path_params["name"])
        return PlainTextResponse("not found", 404) if path is None else FileResponse(path, headers=_HEADERS)

    async def _take(self, http: Request) -> Response:
        """Take an answer, unless it is for another trial or another question than the present one."""
        if not http.headers.get("content-type", "").startswith("application/json"):
            return PlainTextResponse("want application/json", 415)
        body = b""
        async for part in http.stream():
            body += part
            if len(body) > _BODY:
                return PlainTextResponse(f"want at most {_BODY} bytes", 413)
        try:
            answer = json.loads(body)
            if not isinstance(answer["do"], str):
                raise TypeError
            about = answer["phase"], answer["trial"], answer["attempt"]
            verdict = _verdict(answer) if answer["phase"] == "verdict" else None
        except (ValueError, TypeError, KeyError, RecursionError):
            return PlainTextResponse("want phase, trial, attempt, do, earned, note", 400)
        with self._changed:
            trial = self._trial
            if trial is None or about != (self._phase, trial.number, trial.attempt) or self._answer is not None:
                return PlainTextResponse("the trial has gone on meanwhile", 409)
            if answer["do"] not in _CHOICES[self._phase]:
                return PlainTextResponse(f"do: want one of {sorted(_CHOICES[self._phase])}", 400)
            try:
                if verdict is not None:
                    verdict.score(trial.rubric)
            except ConfigError as error:
                return PlainTextResponse(str(error), 400)
            self._answer = answer
            self._changed.notify_all()
        return JSONResponse({})


def _verdict(answer: dict[str, Any]) -> Verdict:
    return Verdict(answer["do"], tuple(map(str, answer.get("earned", ()))), str(answer.get("note", "")))
