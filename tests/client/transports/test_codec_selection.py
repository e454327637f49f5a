"""The link is measured, and the codec is chosen by it: on a simulated link, loopback and shaped ones."""

from __future__ import annotations

import time
from collections.abc import Iterator

import network_links
import numpy as np
import pytest
from camera_images import photograph

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.codec_selection import CodecChoice, CodecName, LinkSpeed, measure
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.errors import MessageTooLarge, TooManyRequests
from vlagents_ray.images.codecs import JPEG, LOSSLESS, RAW, ImageCodec

pytestmark = pytest.mark.alone

OBS = Obs({"front": photograph(seed=1), "wrist": photograph(seed=2)})
SIZE = sum(image.nbytes for image in OBS.cameras.values())


class Simulated:
    """A link of a given speed, with a clock of its own; the first bytes of each message may pass at once."""

    def __init__(self, round_trip_s: float, bandwidth: float, burst: int = 0, limit: float = float("inf")) -> None:
        self._link = LinkSpeed(round_trip_s, bandwidth)
        self._burst = burst
        self._limit = limit
        self.now = 0.0
        self.carried = 0

    def send(self, message: bytes) -> None:
        if len(message) > self._limit:
            raise MessageTooLarge("too large")
        self.carried += len(message)
        self.now += self._link.round_trip_s + max(0, len(message) - self._burst) / self._link.bandwidth


@pytest.mark.parametrize("bandwidth", [1e5, 1.25e6, 12.5e6, 125e6])
@pytest.mark.parametrize("round_trip_s", [2e-4, 5e-3, 0.1])
def test_bandwidth_is_found_in_bounded_time(round_trip_s: float, bandwidth: float) -> None:
    link = Simulated(round_trip_s, bandwidth)
    found = measure(link.send, lambda: link.now)
    assert found is not None
    assert found.round_trip_s == pytest.approx(round_trip_s, rel=0.5)  # a few bytes take their time on a slow link
    assert found.bandwidth == pytest.approx(bandwidth, rel=0.1)
    one_probe_s = 16_384 / bandwidth + round_trip_s
    assert link.now < 0.15 + 12 * round_trip_s + one_probe_s


def test_a_key_whose_rate_is_too_low_to_measure_by_costs_no_request() -> None:
    waited_s: list[float] = []
    for allowed in (0, 7):
        sent: list[bytes] = []

        def send(message: bytes, allowed: int = allowed, sent: list[bytes] = sent) -> None:
            sent.append(message)
            if len(sent) > allowed:
                error = TooManyRequests("too fast")
                error.retry_after_s = 0.01
                raise error

        choice = CodecChoice("auto")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("vlagents_ray.client.transports.codec_selection.time.sleep", waited_s.append)
            assert choice.codec_for(OBS, send) == JPEG
            assert choice.codec_for(OBS, send) == JPEG  # without another probe
        assert len(sent) == allowed + 1
    assert waited_s == [0.01] * 2


def test_a_slow_link_carries_few_bytes() -> None:
    link = Simulated(0.02, 1.25e5)  # 1 Mbit/s
    measure(link.send, lambda: link.now)
    assert link.carried < 40_000


def test_a_burst_that_passes_at_once_does_not_hide_the_bandwidth() -> None:
    link = Simulated(2e-4, 12.5e6, burst=64 * 1024)
    found = measure(link.send, lambda: link.now)
    assert found is not None
    assert found.bandwidth == pytest.approx(12.5e6, rel=0.5)


def test_a_server_that_takes_little_is_measured_with_little() -> None:
    link = Simulated(2e-4, 125e6, limit=100_000)
    found = measure(link.send, lambda: link.now)
    assert found is not None
    assert found.bandwidth == pytest.approx(125e6, rel=0.2)


@pytest.mark.parametrize(
    ("bandwidth", "auto", "exact"), [(12.5e6, JPEG, LOSSLESS), (125e6, JPEG, RAW), (1.25e9, RAW, RAW)]
)
def test_the_codec_goes_by_the_bandwidth(
    bandwidth: float, auto: ImageCodec, exact: ImageCodec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "vlagents_ray.client.transports.codec_selection.measure", lambda *_, **__: LinkSpeed(2e-4, bandwidth)
    )
    assert CodecChoice("auto").codec_for(OBS, lambda _: None) == auto
    assert CodecChoice("exact").codec_for(OBS, lambda _: None) == exact


@pytest.mark.parametrize("requested", ["auto", "exact"])
def test_a_message_over_the_limit_is_never_chosen(requested: CodecName, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlagents_ray.client.transports.codec_selection.measure", lambda *_, **__: LinkSpeed(2e-4, 1e9))
    compressed = JPEG if requested == "auto" else LOSSLESS
    assert CodecChoice(requested).codec_for(OBS, lambda _: None, most_bytes=SIZE - 1) == compressed
    strict = Simulated(2e-4, 1e9, limit=SIZE - 1)  # a proxy's
    assert CodecChoice(requested).codec_for(OBS, strict.send) == compressed


def test_a_request_over_a_long_way_is_not_late_because_the_way_was_measured() -> None:
    link = Simulated(0.16, 2.5e6)
    assert measure(link.send, lambda: link.now, within_s=0.5) is None
    assert link.now == pytest.approx(2 * 0.16, rel=0.01)
    sent: list[bytes] = []

    def slowly(message: bytes) -> None:
        sent.append(message)
        time.sleep(0.03)

    for requested, chosen in (("auto", JPEG), ("exact", LOSSLESS)):
        choice = CodecChoice(requested)  # type: ignore[arg-type]
        sent.clear()
        assert choice.codec_for(OBS, slowly, timeout_s=1.0) == chosen
        assert choice.codec_for(OBS, slowly, timeout_s=1.0) == chosen
        assert (choice.link, len(sent)) == (None, 2)


def test_a_new_connection_is_measured_again_only_where_that_takes_no_time() -> None:
    sent: list[bytes] = []
    for chosen, again in ((JPEG, False), (LOSSLESS, False), (RAW, True)):
        choice = CodecChoice("auto")
        choice.codec_for(OBS, sent.append)
        choice.codec = chosen
        sent.clear()
        choice.connected(near=False)
        assert (choice.codec is None) == again
        choice.codec_for(OBS, sent.append)
        assert bool(sent) == again
        choice.connected(near=True)  # another replica, on this machine
        assert choice.codec is None


def test_the_choice_stands_until_raw_images_grow_or_the_connection_is_new() -> None:
    sent: list[bytes] = []
    choice = CodecChoice("auto")
    choice.connected(near=True)
    assert choice.codec_for(OBS, sent.append) == RAW
    for obs in (OBS, Obs({"front": OBS.cameras["front"][:, :160]}), Obs(state={"joints": np.zeros(7)}), None):
        choice.codec_for(obs, sent.append)
    assert [len(message) for message in sent] == [SIZE]
    choice.codec_for(Obs({"front": photograph(480, 640)}), sent.append)
    assert [len(message) for message in sent] == [SIZE, 480 * 640 * 3]
    choice.forget()
    assert (choice.link, choice.codec) == (None, None)


@pytest.mark.parametrize(("part", "chosen"), [(2, RAW), (0.5, JPEG)])
def test_within_a_machine_pixels_stay_raw_without_a_measurement_unless_they_are_too_many(
    part: float, chosen: ImageCodec
) -> None:
    limit = part * SIZE

    def refuse(message: bytes) -> None:
        if len(message) > limit:
            raise MessageTooLarge("too large")

    choice = CodecChoice("auto")
    choice.connected(near=True)
    assert choice.codec_for(OBS, refuse) == chosen
    assert choice.link is None


@pytest.fixture(scope="module")
def near() -> Iterator[str]:
    with network_links.loopback() as url:
        yield url


@pytest.mark.parametrize("transport", ["websocket", "http"])
def test_loopback_gets_raw_pixels(near: str, transport: TransportName) -> None:
    with RemoteAgent(near, transport=transport) as agent:
        assert agent.codec is None
        agent.reset(OBS, "look")
        assert agent.codec == RAW
        assert agent.link is None  # not measured, as it is within this machine
        agent.act(OBS)


@pytest.mark.parametrize("transport", ["websocket", "http"])
@pytest.mark.parametrize("rate", ["1gbit", "100mbit"])
def test_a_network_gets_jpeg_unless_pixels_must_arrive_as_they_are(rate: str, transport: TransportName) -> None:
    bits = {"1gbit": 1e9, "100mbit": 1e8}[rate]
    with network_links.shaped(rate) as url:
        with RemoteAgent(url, transport=transport) as agent:

            def is_right() -> bool:  # a busy machine does not fill a fast link
                return agent.link is not None and 0.3 < agent.link.bandwidth * 8 / bits < 1.5 and agent.codec == JPEG

            assert network_links.measure_until(agent, OBS, is_right), agent.link
        with RemoteAgent(url, transport=transport, codec="exact") as agent:
            right = LOSSLESS if rate == "100mbit" else RAW
            assert network_links.measure_until(agent, OBS, lambda: agent.codec == right), agent.link


def test_the_choice_is_the_fastest_of_all_over_a_true_link() -> None:
    with network_links.shaped("100mbit") as url, RemoteAgent(url, transport="websocket") as chooser:
        codecs = {"raw": RAW, "lossless": LOSSLESS, "jpeg": JPEG}
        taken: dict[str, list[float]] = {name: [] for name in codecs}
        agents = {codec: RemoteAgent(url, transport="websocket", codec=codec) for codec in taken}
        for agent in agents.values():
            agent.reset(OBS, "look")
        for _ in range(9):
            for codec, agent in agents.items():
                begun = time.perf_counter()
                agent.act(OBS)
                taken[codec].append(time.perf_counter() - begun)
        for agent in agents.values():
            agent.close()
        best = min(taken, key=lambda codec: np.median(taken[codec]))
        assert network_links.measure_until(chooser, OBS, lambda: chooser.codec == codecs[best]), chooser.link
