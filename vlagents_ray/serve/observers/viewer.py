"""Shows the episodes of a replica's sessions in Rerun, from what the live observer keeps."""

from __future__ import annotations

import logging
import threading
import time
from collections import defaultdict
from dataclasses import dataclass

from vlagents_ray.naming import plain
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.observers.live import SHOWN_OPS, Answer, KeptObservation, LiveObserver
from vlagents_ray.serve.observers.worker import be_nice
from vlagents_ray.serve.sessions import SessionTable
from vlagents_ray.viewers import RerunEpisode, RerunRecordings, ViewerFrame, dated_name

logger = logging.getLogger(__name__)

_PERIOD_S = 0.05
_SHARE = 0.1  # of a core, at most
_CLOSING_S = 5.0
_NAME = 8  # characters of a session's id in the name of a file: a list of the folder does not state it


@dataclass(slots=True)
class _SessionEpisode:
    writer: RerunEpisode | None  # None after an error
    shown: int  # number of the last observation that was shown
    acts: int = 0

    def frame(self, answer: Answer, kept: KeptObservation | None) -> ViewerFrame:
        """Return what an answer shows, with the observation if it is a new one; count them."""
        if kept is not None and kept.number <= self.shown:
            kept = None
        rows = answer.action
        frame = ViewerFrame(
            tick=self.acts,
            time=time.time(),
            files={} if kept is None else kept.pictures(),
            state={} if kept is None else kept.state,
            planned=None if rows is None else rows[0],
            chunk=rows,
            numbers=dict(answer.timing),
            note=f"{answer.error}: {answer.detail}" if answer.error else "",
        )
        self.acts += rows is not None
        self.shown = self.shown if kept is None else kept.number
        return frame


class SessionViewer:
    """Writes an episode for each `reset` of a session, until the next one or the session's end.

    One thread reads the live observer twenty times a second, and writes every answer with its times and its chunk (as
    far as that is kept, `ROWS` x `VALUES`), ten of them a second with the states and pictures that they answer. It
    takes at most a tenth of a core; where that is too little, older answers are left out.
    """

    def __init__(self, sessions: SessionTable[LoadedModel], live: LiveObserver, target: str) -> None:
        """Begin to show the sessions at `target`, a folder or an address; raises the errors of `RerunRecordings`."""
        self._sessions = sessions
        self._live = live
        self._recordings = RerunRecordings(target)
        self._episodes: dict[str, _SessionEpisode] = {}  # by session
        self._since = 0  # number of the last answer that was read
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-viewer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Finish all episodes."""
        self._stop.set()
        self._thread.join(_CLOSING_S)  # a live viewer that is gone may hold it up

    def _poll(self) -> None:
        """Write what happened since the last call."""
        self._live.renew()
        answers: dict[str, list[Answer]] = defaultdict(list)
        for answer in self._live.answers(self._since):
            self._since = answer.number
            if answer.op in SHOWN_OPS:
                answers[answer.session].append(answer)
        sessions = {session.id: session.instruction for session in self._sessions.all()}
        for name, [*earlier, last] in answers.items():
            for answer in earlier:
                self._write(name, sessions.get(name), answer, None)
            self._write(name, sessions.get(name), last, self._live.observation(name))
        self._live.forget_others(sessions)  # not before: a session may have ended since its last answer
        for name in self._episodes.keys() - sessions.keys():
            self._end(name)

    def _write(self, name: str, instruction: str | None, answer: Answer, kept: KeptObservation | None) -> None:
        episode = self._episodes.get(name)
        if episode is None and answer.error:  # there is no such session, maybe
            return
        if episode is None or (answer.op == "reset" and not answer.error):
            shown = 0 if episode is None else episode.shown
            self._end(name)
            episode = self._episodes[name] = _SessionEpisode(self._begun(name, instruction), shown)
        frame = episode.frame(answer, kept)
        if episode.writer is None:
            return
        try:
            episode.writer.write(frame)
        except Exception as error:  # noqa: BLE001 - the server goes on without this episode
            logger.warning("session %s: the rest of its episode is not recorded: %s", name, error)
            episode.writer = None

    def _begun(self, name: str, instruction: str | None) -> RerunEpisode | None:
        file = f"{dated_name()}_{plain(name)[:_NAME]}"
        try:
            return self._recordings.begin(file, instruction or "")
        except Exception as error:  # noqa: BLE001 - likewise
            logger.warning("session %s: its episode is not recorded: %s", name, error)
            return None

    def _end(self, name: str) -> None:
        episode = self._episodes.pop(name, None)
        if episode is None or episode.writer is None:
            return
        try:
            episode.writer.close()
        except Exception as error:  # noqa: BLE001 - likewise
            logger.warning("session %s: the recording of its episode is not whole: %s", name, error)

    def _run(self) -> None:
        be_nice()
        pause_s = _PERIOD_S
        while not self._stop.wait(pause_s):
            begun = time.thread_time()
            self._poll()
            pause_s = max(_PERIOD_S, (time.thread_time() - begun) / _SHARE)
        self._poll()
        for name in list(self._episodes):
            self._end(name)
