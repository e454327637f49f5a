"""LeRobot's remote inference over Zenoh (`lerobot-rollout --inference.type=remote`): one instance
serves many robots, each in a separate session; LeRobot's own server serves one robot at a time.

The keys of a deployment D, an instance I and a session S:

    lerobot/inference/v1/deployments/D/describe                 query: what the deployment offers
    …/D/instances/I/open                                        query: begin a session
    …/D/instances/I/alive                                       liveliness of the server
    …/D/instances/I/sessions/S/control                          query: reset, invalidate, close
    …/D/instances/I/sessions/S/obs, …/S/act                     observations and their actions
    …/D/instances/I/sessions/S/language/request                 rejected: no policy answers text
    …/D/instances/I/sessions/S/alive                            liveliness of the robot

Zenoh's messages have no field for an API key. If the network is open to anyone but trusted robots,
connect both the server and the robots to a Zenoh router, which has TLS and access rules.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import queue
import socket
import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
    shown,
)
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.registry import require
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import KeylessPortConfig, MappingSetting
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.ports import LOOPBACK
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray_dialects.gateway_sessions import GatewayClient, GatewayClients, internal_error
from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import (
    IDENTITY,
    MERGES,
    Envelope,
    IncompatibleRequest,
    StaleMessage,
    UnsupportedRequest,
)

logger = logging.getLogger(__name__)

_PREFIX = f"lerobot/inference/v{messages.PROTOCOL_VERSION}/deployments"
_WAITING = 8  # maximum number of waiting messages of a robot; further messages are dropped
_OPENINGS = 32  # number of openings whose answers are repeated for a repeated query
_CHECK_S = 0.5  # the period of the check for robots that have disconnected
_END_S = 3.0  # the time limit for the end of a robot's thread
# LeRobot's names for the modes in which a robot executes chunks: one chunk after another, or
# real-time chunking with a policy that is either guided to the plan or trained to begin with the
# first rows of the plan.
_CHUNK, _GUIDED, _TRAINED = "chunk", "rtc_guided", "rtc_trained"
# Deadlines that a client adds to its own time limits, s; the defaults of LeRobot.
_ACTION_DEADLINE_S, _LANGUAGE_DEADLINE_S = 5.0, 60.0


class Feature(BaseModel, extra="forbid"):
    """One named value of an observation, or the action, as the client's robot describes it."""

    name: str = Field(description="name of the value")
    shape: list[int] = Field(description="its shape")
    dtype: str = Field(default="float32", description="its dtype")
    kind: str = Field(default="tensor", description="tensor, or rgb for an image (H, W, 3) uint8")
    names: list[str] = Field(default_factory=list, description="names of the numbers of a vector")
    semantics: str = Field(description="convention in words, which must equal the client's")

    def to_wire(self) -> dict[str, Any]:
        """Return the feature as LeRobot's `FeatureSpec` has it."""
        return {
            "name": self.name,
            "shape": self.shape,
            "dtype": self.dtype,
            "kind": self.kind,
            "names": self.names,
            "semantics": self.semantics,
        }


class LeRobotRemoteDialectConfig(KeylessPortConfig):
    """The settings of LeRobot's remote inference. LeRobot's client compares each of them with the
    settings of its robot, so use the values of LeRobot's own deployment file.
    """

    mapping: MappingSetting = "lerobot"
    port: int = Field(default=7447, ge=1, le=65535)
    deployment: str = Field(
        default="vlagents_ray",
        description="name of the deployment, which clients give as `--inference.deployment`",
    )
    semantics: str = Field(description="convention of the deployment in words")
    features: list[Feature] = Field(min_length=1, description="values of an observation, in order")
    action: Feature = Field(description="the action of one step, a float32 vector")
    fps: float | None = Field(
        default=None, gt=0, description="rate of the actions, Hz; default: the contract's"
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        description="rows of a chunk that are sent in mode `chunk`; default: the contract's",
    )
    router: str | None = Field(
        default=None,
        description="endpoint of a Zenoh router, such as tls/router:7447, to connect to instead "
        "of listening",
    )
    zenoh_config: Path | None = Field(
        default=None, description="Zenoh's own configuration, with TLS certificates for the router"
    )


class LeRobotRemoteDialect(PortDialect):
    """LeRobot's remote inference: in mode `chunk`, with appended and aligned chunks, and, where the
    policy can, in one of the modes `rtc_guided` and `rtc_trained`.
    """

    Config = LeRobotRemoteDialectConfig
    clients = "LeRobot's remote inference"
    summary = (
        "A session is what `open` has begun; an episode begins with `reset` and each new task. "
        "Many robots share one instance. Mode `chunk`, and `rtc_guided` or `rtc_trained` if the "
        "policy continues plans."
    )
    scheme = "zenoh"
    requires = ("zenoh", "msgpack")
    config: LeRobotRemoteDialectConfig

    def __init__(
        self, name: str, config: LeRobotRemoteDialectConfig, context: GatewayContext
    ) -> None:
        super().__init__(name, config, context)
        self.offer = Offer(config, context)
        self.offer.require_fit(self.mapping)
        self._robots: GatewayClients[str, RobotSession] = GatewayClients(context)
        # The answer to each query, by the query's id.
        self._openings: OrderedDict[str, bytes] = OrderedDict()
        self._opening = threading.Lock()
        self._zenoh: Any = None
        self._declared: list[Any] = []
        self._checks: threading.Thread | None = None
        self._closing = threading.Event()

    def serve(self, listener: socket.socket) -> None:
        """Open Zenoh's session, which listens at the port or is a client of the router."""
        zenoh = require("zenoh")
        host = self.config.host or LOOPBACK
        listener.close()  # Zenoh binds the port itself
        settings: dict[str, Any] = {
            "mode": "peer" if self.config.router is None else "client",
            "connect/endpoints": [] if self.config.router is None else [self.config.router],
            "listen/endpoints": [f"tcp/{host}:{self.config.port}"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
        }
        if self.config.router is not None:
            settings["listen/endpoints"] = []
        path = self.config.zenoh_config
        config = zenoh.Config() if path is None else zenoh.Config.from_file(str(path))
        for setting, value in settings.items():
            config.insert_json5(setting, json.dumps(value))
        self._zenoh = zenoh.open(config)

        key = self.offer.instance_key
        declare = self._zenoh.declare_queryable
        self._declared = [
            declare(f"{self.offer.key}/describe", self._direct(self._describe), complete=True),
            declare(f"{key}/open", self._direct(self._open), complete=True),
            self._zenoh.liveliness().declare_token(f"{key}/alive"),
        ]
        self._checks = threading.Thread(target=self._check, name=self.name, daemon=True)
        self._checks.start()

    def alive(self) -> bool:
        return self._checks is not None and self._checks.is_alive()

    def close(self) -> None:
        """Begin no more sessions, end all of them after their current actions, and disconnect."""
        self._closing.set()
        for robot in self._robots.end_all():
            robot.join()
        if self._checks is not None:
            self._checks.join()
        if self._zenoh is not None:
            self._zenoh.close()

    @staticmethod
    def _direct(function: Callable[[Any], None]) -> Any:
        """Return a handler that Zenoh calls on its own thread, without a queue."""
        return require("zenoh").handlers.Callback(function, indirect=False)

    def _check(self) -> None:
        """End the sessions of disconnected robots, until the dialect is closed."""
        while not self._closing.wait(_CHECK_S):
            self._robots.forget_quiet()

    def _describe(self, query: Any) -> None:
        """Answer a query with the descriptor of the deployment."""
        request = self._read(query)
        if request is not None:
            answer = Envelope(
                "descriptor",
                self.offer.instance_id,
                request_id=request.request_id,
                body=self.offer.descriptor(),
            )
            _reply(query, messages.encode(answer))

    def _open(self, query: Any) -> None:
        """Begin a session on a separate thread, since declaring its keys must not block Zenoh's
        thread.
        """
        request = self._read(query)
        if request is not None:
            threading.Thread(
                target=self._begin, args=(query, request), name=f"{self.name}-open", daemon=True
            ).start()

    def _read(self, query: Any) -> Envelope | None:
        """Return the message in a query; None if the message was unreadable, in which case the
        query has been answered with an error.
        """
        data = b"" if query.payload is None else query.payload.to_bytes()
        try:
            return messages.decode(data, self.context.limits)
        except VLAgentsError as error:
            answer = Envelope("error", body=messages.error_body(error))
            _reply(query, messages.encode(answer))
            return None

    def _begin(self, query: Any, request: Envelope) -> None:
        """Begin the session that a client requests, and answer with its id."""
        with self._opening:
            answer = self._openings.get(request.request_id)
            if answer is None:
                answer = messages.encode(self._accepted(request))
                self._openings[request.request_id] = answer
                while len(self._openings) > _OPENINGS:
                    self._openings.popitem(last=False)
        _reply(query, answer)

    def _accepted(self, request: Envelope) -> Envelope:
        """Return the answer to a request for a session."""
        try:
            if self._closing.is_set():
                raise StaleMessage("open: the server is stopping; connect again")
            if request.instance_id != self.offer.instance_id:
                raise StaleMessage(
                    f"instance_id: expected {self.offer.instance_id!r}, got "
                    f"{request.instance_id!r}; the server was started again: connect again"
                )
            terms = self.offer.accept(request.body)
            session_id = uuid.uuid4().hex
            make = partial(RobotSession, self, session_id, self._zenoh, terms)
            robot = self._robots.add(session_id, make)
            robot.declare(lambda: self._robots.remove(session_id))
        except VLAgentsError as error:
            return request.reply("error", messages.error_body(error))
        except Exception:  # noqa: BLE001 - logged, and answered
            internal = VLAgentsError(internal_error(self.name))
            return request.reply("error", messages.error_body(internal))
        body = {**self.offer.descriptor(), **terms}
        return Envelope("accepted", self.offer.instance_id, session_id, 0, request.request_id, body)


class Offer:
    """The descriptor of a deployment in LeRobot's format: what the deployment offers to each robot.

    Args:
        config: The settings of the dialect.
        context: The context of the gateway, with the policy's contract.

    Raises:
        ConfigError: The settings and the contract lack a value, or contradict each other.
    """

    def __init__(self, config: LeRobotRemoteDialectConfig, context: GatewayContext) -> None:
        if not messages.is_segment(config.deployment):
            raise ConfigError(
                "deployment: expected 1 to 128 letters, digits, '_', '.' and '-', got "
                f"{config.deployment!r}"
            )
        contract = context.contract
        chunk = None if contract is None else contract.chunk
        steps = config.steps or chunk
        hz = config.fps
        if hz is None and contract is not None:
            hz = contract.control_hz
        if steps is None or hz is None:
            missing = "steps" if steps is None else "fps"
            raise ConfigError(f"{missing}: expected a value, as the policy's contract has none")
        if chunk is not None and steps > chunk:
            raise ConfigError(
                f"steps: expected at most {chunk}, the rows of the policy's chunks, got {steps}"
            )
        dim = None if contract is None else contract.action.dim
        if config.action.dtype != "float32" or config.action.shape != [
            dim or config.action.shape[0]
        ]:
            raise ConfigError(
                f"action: expected a float32 vector of {dim} numbers, as the policy returns, got "
                f"{config.action.dtype} {config.action.shape}"
            )

        self._config = config
        self._context = context
        self.execution_steps = int(steps)  # rows of an answer in mode `chunk`
        self.prediction_steps = int(chunk or steps)  # rows of an answer in the other modes
        self.width = config.action.shape[0]
        self.longest_prefix = context.longest_prefix
        self.modes = [_CHUNK]
        if context.continues_plans:
            self.modes.append(_TRAINED if self.longest_prefix else _GUIDED)
        self._interval_s = 1 / float(hz)
        self.instance_id = uuid.uuid4().hex
        self.key = f"{_PREFIX}/{config.deployment}"
        self.instance_key = f"{self.key}/instances/{self.instance_id}"
        # LeRobot's clients end their rollout if this identity changes, so it stays the same when
        # weights are pushed.
        self.artifact = config.deployment

    def require_fit(self, mapping: KeyMapping) -> None:
        """Raise `ConfigError` if the mapping cannot read an observation of these features."""
        context = self._context
        features: dict[str, Any] = {"task": "a task"}
        for feature in self._config.features:
            features[feature.name] = np.zeros(feature.shape, feature.dtype)
        try:
            obs, _ = mapping.obs(features, context.limits, context.contract)
        except VLAgentsError as error:
            raise ConfigError(f"features: the mapping cannot read them: {error}") from error
        needed = context.contract
        for kind, names, values in (
            ("camera", needed and needed.cameras, obs.cameras),
            ("state", needed and needed.state, obs.state),
        ):
            missing = [name for name in names or () if name not in values]
            if missing:
                raise ConfigError(
                    f"features: expected the {kind} {missing}, which the policy needs, got "
                    f"{sorted(values)}; add the feature, or change the mapping"
                )

    def descriptor(self) -> dict[str, Any]:
        """Return the body of the message `descriptor`."""
        config = self._config
        return {
            "deployment": config.deployment,
            "instance_id": self.instance_id,
            "artifact_identity": self.artifact,
            "software": {"name": "vlagents-ray"},
            "semantics": config.semantics,
            "capabilities": {
                "modes": self.modes,
                "prediction_steps": self.prediction_steps,
                "execution_steps": self.execution_steps,
                "action_interval": self._interval_s,
                "features": [feature.to_wire() for feature in config.features],
                "action_feature": config.action.to_wire(),
                "language": False,
                "training_max_delay": self.longest_prefix if _TRAINED in self.modes else 0,
                # The policy reads the whole plan, and decides itself how strongly each row guides
                # it.
                "rtc_horizon": self.prediction_steps if len(self.modes) > 1 else 0,
                "current_observation_only": True,
                "retains_session_state": True,
                "action_representation": "canonical",
            },
            "execution_contracts": list(MERGES),
            # The robot blends the rows of chunks, and its user chooses the components; clients with
            # `chunk_blending_v1` read this list.
            "blendable_components": config.action.names,
            "ready": True,
            "available": True,
            "failure": None,
            "session": {},
            "session_status": "idle",
            "limits": {
                "action_deadline_s": _ACTION_DEADLINE_S,
                "language_deadline_s": _LANGUAGE_DEADLINE_S,
                "idle_timeout_s": self._context.idle_s,
                "max_input_chars": 4096,
                "max_output_chars": 8192,
                "codec": {},
                "inflight_inference": 1,
            },
        }

    def accept(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is added to the descriptor in the answer to a request for a session.

        Args:
            body: The body of the request.

        Raises:
            IncompatibleRequest: The client's robot differs from the robot of the deployment.
            UnsupportedRequest: The client requests something that the deployment does not offer.
        """
        descriptor = self.descriptor()
        capabilities = descriptor["capabilities"]
        for name, expected in (
            ("expected_artifact", self.artifact),
            ("features", capabilities["features"]),
            ("action_feature", capabilities["action_feature"]),
            ("semantics", self._config.semantics),
        ):
            if body.get(name) != expected:
                raise IncompatibleRequest(
                    f"{name}: expected {shown(expected, 400)}, got {shown(body.get(name), 400)}"
                )
        interval = body.get("action_interval")
        if not isinstance(interval, float) or not math.isclose(
            interval, self._interval_s, rel_tol=1e-6
        ):
            raise IncompatibleRequest(
                f"action_interval: expected {self._interval_s:g} s, got {shown(interval)}"
            )
        mode, encoding = body.get("mode"), body.get("encoding")
        if mode not in self.modes:
            raise UnsupportedRequest(
                f"mode: expected one of {self.modes}, which the policy can, got {shown(mode)}"
            )
        if encoding not in ("raw", "jpeg"):
            raise UnsupportedRequest(f"encoding: expected raw or jpeg, got {shown(encoding)}")
        return {"mode": mode, **self._merging(body)}

    def _merging(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return the accepted settings for merging chunks in a request for a session."""
        required = body.get("required_capabilities", [])
        if not isinstance(required, list) or not set(map(str, required)) <= set(MERGES):
            raise UnsupportedRequest(
                f"required_capabilities: expected only {list(MERGES)}, got {shown(required)}"
            )
        settings = body.get("chunk_settings", {})
        if not isinstance(settings, dict):
            raise MalformedMessage(f"chunk_settings: expected a map, got {shown(settings)}")
        is_aligned = settings.get("chunk_merge") == "aligned"
        if is_aligned != bool(required):
            raise IncompatibleRequest(
                "chunk_settings: expected chunk_merge 'aligned' together with its name in "
                f"required_capabilities, got {shown(settings)} with {shown(required)}"
            )
        if is_aligned and body.get("mode") != _CHUNK:
            raise IncompatibleRequest(
                "chunk_settings: expected chunk_merge 'append' in the modes of real-time "
                "chunking, got 'aligned'"
            )
        return {"chunk_settings": settings} if settings else {}


class RobotSession(GatewayClient):
    """One robot, whose messages are answered in their order on a separate thread.

    Args:
        dialect: The dialect.
        session_id: The id of the session in the protocol.
        session: Zenoh's session.
        terms: The settings of the session, as `Offer.accept` returns them.
    """

    def __init__(
        self,
        dialect: LeRobotRemoteDialect,
        session_id: str,
        session: Any,
        terms: Mapping[str, Any],
    ) -> None:
        super().__init__(dialect.context)
        # The protocol has no key, which the deployment has accepted.
        self.sessions.show(NoKey.OPEN, None)
        self._dialect = dialect
        self._session_id = session_id
        self._zenoh = session
        self._mode: str = terms["mode"]
        self._is_aligned = terms.get("chunk_settings", {}).get("chunk_merge") == "aligned"
        self._key = f"{dialect.offer.instance_key}/sessions/{session_id}"
        self._generation = 0
        self._last_sequence = -1
        self._is_ready = False  # whether the client has reset the session
        # Whether the robot's liveliness token is present; None if this is not known yet.
        self._is_present: bool | None = None
        self._absent_since = time.monotonic()
        self._inbox: queue.Queue[tuple[str, Any] | None] = queue.Queue(_WAITING)
        self._declared: list[Any] = []
        self._forget: Callable[[], None] = lambda: None
        self._ended = threading.Event()
        self._sending = threading.Lock()  # guards the two following values
        self._asked: Envelope | None = None  # the observation that is being answered
        self._is_silent = False  # whether no more answers are sent
        self._thread = threading.Thread(target=self._run, name=f"{dialect.name}-robot", daemon=True)

    def declare(self, forget: Callable[[], None]) -> None:
        """Declare the keys of the session, and begin to answer.

        Args:
            forget: Removes the session from the dialect; called when the client has closed it.
        """
        self._forget = forget
        direct = self._dialect._direct
        session = self._zenoh
        self._declared = [
            session.declare_queryable(
                f"{self._key}/control", direct(partial(self._arrive, "control")), complete=True
            ),
            session.declare_subscriber(f"{self._key}/obs", direct(partial(self._arrive, "obs"))),
            session.declare_subscriber(
                f"{self._key}/language/request", direct(partial(self._arrive, "language"))
            ),
            session.liveliness().declare_subscriber(
                f"{self._key}/alive", direct(self._see), history=True
            ),
        ]
        self._thread.start()

    def quiet_s(self, now: float) -> float:
        """Return the time for which the robot has been disconnected, s; a connected robot may be
        silent.
        """
        return 0.0 if self._is_present else now - self._absent_since

    def end(self) -> None:
        """End the session after the current action."""
        self._ended.set()
        with contextlib.suppress(queue.Full):  # the thread checks `_ended` after each message
            self._inbox.put_nowait(None)

    def join(self) -> None:
        """Wait until the session has ended; if an action takes too long, send an error to the
        robot.
        """
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_END_S)
        with self._sending:
            if self._asked is not None and not self._is_silent:
                stopping = PolicyUnavailable("the server is stopping; connect again")
                answer = self._asked.reply("error", messages.error_body(stopping))
                self._put("act", messages.encode(answer))
            self._is_silent = True

    def _see(self, sample: Any) -> None:
        """Record whether the robot is connected."""
        zenoh = require("zenoh")
        self._is_present = sample.kind == zenoh.SampleKind.PUT
        self._absent_since = time.monotonic()

    def _arrive(self, kind: str, message: Any) -> None:
        """Queue a message on Zenoh's thread; if the queue is full, drop it, as Zenoh does under
        load.
        """
        try:
            self._inbox.put_nowait((kind, message))
        except queue.Full:
            logger.warning("lerobot_remote: a robot sends faster than it is answered")

    def _run(self) -> None:
        """Answer the messages of the robot until its session ends."""
        try:
            while not self._ended.is_set():
                item = self._inbox.get()
                if item is None:
                    break
                kind, message = item
                self._unanswered += 1
                try:
                    self._answer(kind, message)
                finally:
                    self._unanswered -= 1
                    self._used = time.monotonic()
        except Exception:
            logger.exception("lerobot_remote: a session failed")
        finally:
            self._forget()
            for declared in self._declared:
                declared.undeclare()
            self.sessions.close()

    def _answer(self, kind: str, message: Any) -> None:
        """Answer one message: a query, or a sample of an observation."""
        payload = b"" if message.payload is None else message.payload.to_bytes()
        handle = {"control": self._control, "obs": self._act, "language": self._refuse_language}
        request: Envelope | None = None
        charge = self.sessions.account.charge()
        admission = MessageAdmission(
            self._context.admission,
            self._context.limits,
            charge,
            robot=self._dialect.config.priority == "robot",
            inline=False,
            share=self._session_id,
        )
        try:
            admission.receive(len(payload))
            admission.begin_message()
            request = messages.decode(payload, self._context.limits)
            self._require_current(request)
            answer = handle[kind](request, admission)
        except VLAgentsError as error:
            answer = (request or Envelope("error")).reply("error", messages.error_body(error))
        except Exception:  # noqa: BLE001 - logged, and answered
            internal = VLAgentsError(internal_error(self._dialect.name))
            answer = (request or Envelope("error")).reply("error", messages.error_body(internal))
        finally:
            admission.release()

        data = messages.encode(answer)
        if kind == "control":
            _reply(message, data)
            return
        with self._sending:
            self._asked = None
            if not self._is_silent:
                self._put("act" if kind == "obs" else "language/result", data)

    def _put(self, suffix: str, data: bytes) -> None:
        """Publish a message at a key of the session."""
        zenoh = require("zenoh")
        self._zenoh.put(
            f"{self._key}/{suffix}", data, congestion_control=zenoh.CongestionControl.DROP
        )

    def _require_current(self, request: Envelope) -> None:
        """Raise `StaleMessage` if a message belongs to another instance or session."""
        expected = self._dialect.offer.instance_id, self._session_id
        if (request.instance_id, request.session_id) != expected:
            raise StaleMessage(
                f"instance and session: expected {expected}, got "
                f"{(request.instance_id, request.session_id)}; open a session again"
            )

    def _control(self, request: Envelope, _admission: MessageAdmission) -> Envelope:
        """Reset, invalidate or close the session."""
        operation = request.body.get("operation")
        if operation not in ("reset", "invalidate", "close", "status"):
            raise MalformedMessage(
                "operation: expected reset, invalidate, close or status, got "
                f"{shown(operation, 40)}"
            )
        if operation != "close" and request.generation < self._generation:
            raise StaleMessage(
                f"generation: expected at least {self._generation}, got {request.generation}"
            )
        if operation in ("reset", "invalidate"):
            self._generation = request.generation
        if operation == "reset":
            self._is_ready = True
            self.sessions.restart()
        if operation == "close":
            self._ended.set()
        body: dict[str, Any] = {"operation": operation, "applied_generation": request.generation}
        if operation == "status":
            body["session"] = {"owner": self._session_id, "client_present": self._is_present}
        return request.reply("ack", body)

    def _act(self, request: Envelope, admission: MessageAdmission) -> Envelope:
        """Answer an observation with a chunk of actions."""
        body = request.body
        if request.message_type != "observation":
            raise MalformedMessage(
                f"message_type: expected observation, got {request.message_type}"
            )
        if not self._is_ready:
            raise StaleMessage(
                "observation: expected a reset of the session before it, got none; send `reset`"
            )
        if request.generation != self._generation:
            raise StaleMessage(
                f"generation: expected {self._generation}, that of the last reset or "
                f"invalidation, got {request.generation}"
            )
        sequence = body.get("sequence")
        if type(sequence) is not int or sequence <= self._last_sequence:
            raise StaleMessage(
                f"sequence: expected more than {self._last_sequence}, got {shown(sequence)}"
            )
        if body.get("artifact_identity") != self._dialect.offer.artifact:
            raise IncompatibleRequest(
                f"artifact_identity: expected {self._dialect.offer.artifact!r}, got "
                f"{shown(body.get('artifact_identity'))}"
            )
        plan = self._plan(body)
        if self._is_aligned:
            _require_cursors(body)

        admission.begin("act")
        observation = self._observation(body, admission)
        obs, instruction = self._dialect.mapping.obs(
            observation, self._context.limits, self._context.contract
        )
        if not self.sessions.begun:
            self._dialect.mapping.warn_of_unread_cameras(observation, self._dialect.name)
        self._last_sequence = sequence
        with self._sending:
            self._asked = request
        begun = time.perf_counter()
        obs = replace(obs, info={**obs.info, **plan})
        act = self.sessions.act(admission.charge, obs, instruction)

        offer, contract = self._dialect.offer, self._context.contract
        is_chunk = self._mode == _CHUNK
        steps = offer.execution_steps if is_chunk else offer.prediction_steps
        rows = np.atleast_2d(np.asarray(act.action, np.float32))
        if len(rows) < steps or rows.shape[1] != offer.width:
            raise PolicyFailed(
                f"action: expected ({steps}, {offer.width}), as the deployment offers, got "
                f"{rows.shape}"
            )
        rows = rows[:steps]
        spec = None if contract is None else contract.action
        echoed = [*IDENTITY, "observation_cursor", "cursor"]
        answer = {name: body[name] for name in echoed if name in body}
        answer |= {
            "canonical_actions": self._dialect.mapping.rows(rows, spec),
            # The client keeps these rows for the next request without reading them. They are in
            # the units of the policy, in which the policy reads a plan.
            "model_actions": None if is_chunk else rows,
            "execution_steps": steps,
            "server_durations": {"act_s": time.perf_counter() - begun},
        }
        return request.reply("action", answer)

    def _plan(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return the plan that the robot executes as `Obs.info`; empty in mode `chunk`.

        Raises:
            MalformedMessage: The plan has another shape, or the delay another value than the
                deployment offers.
        """
        if self._mode == _CHUNK:
            return {}
        offer = self._dialect.offer
        plan = _continuation(body, "model_continuation", offer)
        canonical = _continuation(body, "canonical_continuation", offer)
        if plan is not None and canonical is not None and len(plan) != len(canonical):
            raise MalformedMessage(
                f"canonical_continuation: expected {len(plan)} rows, as model_continuation has, "
                f"got {len(canonical)}"
            )
        longest = offer.prediction_steps
        if plan is None:
            longest = 0
        elif self._mode == _TRAINED:
            longest = min(offer.longest_prefix, len(plan))
        delay = body.get("delay")
        if type(delay) is not int or not 0 <= delay <= longest:
            raise MalformedMessage(
                f"delay: expected 0 to {longest} ticks in mode {self._mode} with a plan of "
                f"{0 if plan is None else len(plan)} rows, got {shown(delay)}"
            )
        return {} if plan is None else {LEFTOVER: plan, DELAY: min(delay, len(plan))}

    def _observation(self, body: Mapping[str, Any], admission: MessageAdmission) -> dict[str, Any]:
        """Return the features of an observation, decoded and checked, with its task."""
        features = body.get("features")
        if not isinstance(features, dict):
            raise MalformedMessage(f"features: expected a map, got {type(features).__name__}")
        expected = self._dialect.config.features
        if features.keys() != {feature.name for feature in expected}:
            raise IncompatibleRequest(
                f"features: expected {[feature.name for feature in expected]}, got "
                f"{shown(sorted(features))}"
            )
        decoded = messages.decode_images(features, admission)
        for feature in expected:
            _require_feature(feature, decoded[feature.name])
        task = body.get("task")
        if not isinstance(task, str):
            raise MalformedMessage(f"task: expected a text, got {shown(task)}")
        return {**decoded, "task": task}

    @staticmethod
    def _refuse_language(_request: Envelope, _admission: MessageAdmission) -> Envelope:
        """Reject a request for text, since no policy here answers in text."""
        raise UnsupportedRequest("language: this deployment answers with actions only")


def _reply(query: Any, data: bytes) -> None:
    """Answer a query, and end it; until the end, the client waits for further replies."""
    query.reply(str(query.key_expr), data)
    query.drop()


def _continuation(body: Mapping[str, Any], name: str, offer: Offer) -> np.ndarray | None:
    """Return a plan in an observation, (H, D) float32, with at most as many rows as a chunk; None
    if the robot has no plan.
    """
    plan = body.get(name)
    if plan is None:
        return None
    if (
        not isinstance(plan, np.ndarray)
        or plan.dtype.name != "float32"
        or plan.ndim != 2
        or plan.shape[1] != offer.width
        or len(plan) > offer.prediction_steps
    ):
        raise MalformedMessage(
            f"{name}: expected (up to {offer.prediction_steps}, {offer.width}) float32, got "
            f"{shown(plan)}"
        )
    return plan


def _require_cursors(body: Mapping[str, Any]) -> None:
    """Raise `MalformedMessage` if an observation has no valid position at which its chunk is
    merged.
    """
    observed, requested = body.get("observation_cursor"), body.get("cursor")
    if (
        type(observed) is not int
        or type(requested) is not int
        or not 0 <= observed <= requested < 2**63
    ):
        raise MalformedMessage(
            "observation_cursor, cursor: expected two numbers of executed actions, the first not "
            f"above the second, got {shown(observed)} and {shown(requested)}"
        )


def _require_feature(feature: Feature, value: Any) -> None:
    """Raise `IncompatibleRequest` if the shape or type of a feature differs from the
    deployment's.
    """
    shape: Sequence[int] | None = getattr(value, "shape", None)
    if shape is None or list(shape) != feature.shape or value.dtype.name != feature.dtype:
        raise IncompatibleRequest(
            f"{feature.name}: expected {feature.dtype} {feature.shape}, got {shown(value)}"
        )
