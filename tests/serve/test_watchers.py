"""Several watchers of one engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.responses import Done, Watcher
from vlagents_ray.serve.watchers import unwatch, watch


@dataclass
class Engine:
    live: Watcher | None = None


@dataclass(eq=False)
class Noting:
    """Notes requests and replies."""

    seen: list[object] = field(default_factory=list)

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        self.seen += items

        def answer(replies: list[Reply]) -> None:
            done(replies)
            self.seen += replies

        return answer


def test_each_watcher_sees_messages_and_answers_until_it_ends() -> None:
    engine, one, other = Engine(), Noting(), Noting()
    sent: list[Reply] = []

    def message() -> tuple[Request, Reply]:
        request, reply = Request("close"), Reply()
        assert engine.live is not None
        engine.live.note(["a"], [request], {}, sent.extend)([reply])
        return request, reply

    watch(engine, one)
    assert engine.live is one, "a message that one looks at makes no detour"
    first = message()
    watch(engine, other)
    second = message()
    unwatch(engine, one)
    third = message()
    unwatch(engine, one)
    unwatch(engine, other)
    assert engine.live is None
    assert one.seen == [*first, *second]
    assert other.seen == [*second, *third]
    assert sent == [first[1], second[1], third[1]]
