from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml
from eval_fakes import LINE
from hypothesis import given
from hypothesis import strategies as st
from recorded_results import HOSTILE, better_later, record, runs

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.report import success
from vlagents_ray.evaluate.report.charts import (
    MINUS,
    difference_glyph,
    difference_labels,
    difference_limit,
)
from vlagents_ray.evaluate.report.episodes import Gallery
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.store import Store


class Read(HTMLParser):
    """The elements of a page, and its text; an unclosed tag is an error."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.sections: dict[str, list[str]] = {}  # the texts of sections, by heading
        self._open: list[str] = []
        self.feed(path.read_text())
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self._open):
            self.text.append(data)
            if "h2" in self._open:
                self.sections[data] = []
            elif self.sections:
                self.sections[next(reversed(self.sections))].append(data)

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.elements if tag == name]

    def section(self, heading: str) -> str:
        """Return the words from a heading to the next one."""
        return " ".join(" ".join(self.sections[heading]).split())

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def page_of(results: Results) -> Read:
    return Read(write_report(results, results.out / "report.html"))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return record(runs(tmp_path_factory.mktemp("results")), videos=True, troubles=True)


@pytest.fixture(scope="module")
def page(results: Results) -> Read:
    return page_of(results)


def test_nothing_is_fetched_from_anywhere(page: Read) -> None:
    addresses = [
        value
        for _, attributes in page.elements
        for key in ("src", "href", "poster")
        if (value := attributes.get(key))
    ]
    assert addresses
    assert all(re.match(r"(#|data:|videos/)", address) for address in addresses)
    assert page.all("link") == []


def test_what_policies_and_simulators_say_is_text(page: Read) -> None:
    assert len(page.all("script")) == 1
    assert all("onerror" not in attributes for attributes in page.all("img"))
    # In the instruction, the policy error, the failure and the protocol.
    assert page.words.count(" ".join(HOSTILE.split())) >= 4


def test_names_are_text_wherever_they_are_shown(page: Read, tmp_path: Path) -> None:
    given = runs(tmp_path).model_dump()
    for one in (*given["policies"], *given["suites"]):
        one["name"] += HOSTILE
    hostile = record(EvalConfig.model_validate(given), videos=True, troubles=True)
    read = page_of(hostile)
    tags = [tag for tag, _ in read.elements]
    assert tags == [tag for tag, _ in page.elements]
    assert not any(name.startswith("on") for _, attributes in read.elements for name in attributes)
    for shown in (read.all("figure"), read.all("div")):  # attributes are checked, too
        assert any(HOSTILE in str(value) for attributes in shown for value in attributes.values())


def test_rates_stand_with_their_intervals(page: Read) -> None:
    assert re.search(
        r"all base \d+ .*? learner@1000 35/36 \(22\) 25\.0 to 27\.8 25\.7 11\.5 to 48\.9",
        page.words,
    )


def test_workers_are_counted_where_they_ran_by_transport_and_renderer(page: Read) -> None:
    assert re.search(
        r"gpu-box base handle llvmpipe .* 2 gpu-box learner handle llvmpipe .* 2 ", page.words
    )


def test_every_part_is_there(page: Read) -> None:
    headings = ["Success", "Comparison", "Learning curve", "Latency", "Failures", "Episodes"]
    headings += ["Errors", "Protocol", "Configuration", "To repeat"]
    links = [
        attributes["href"]
        for attributes in page.all("a")
        if (attributes["href"] or "").startswith("#")
    ]
    assert links == [f"#{attributes['id']}" for attributes in page.all("h2")]
    for heading in headings:
        assert heading in page.words
    for word in ("Traceback … line 7", "settle steps", "vlagents-ray report", "inference", "base"):
        assert word in page.words


def test_tables_and_charts_are_named_for_those_who_cannot_see_them(page: Read) -> None:
    assert all(attributes.get("scope") for attributes in page.all("th"))
    regions = [attributes for attributes in page.all("div") if attributes.get("class") == "scroll"]
    assert all(
        attributes.get("aria-label") and attributes.get("tabindex") == "0" for attributes in regions
    )
    charts = [attributes for attributes in page.all("svg") if attributes.get("class") == "chart"]
    assert charts
    assert all(attributes.get("role") == "img" for attributes in charts)
    assert len(page.all("title")) > len(charts)
    assert all(attributes.get("aria-label") for attributes in page.all("video"))


def test_the_settings_it_shows_give_the_same_again(page: Read, results: Results) -> None:
    text = "".join(page.text)
    shown = (
        text[text.index("Save this as again.yaml:") :]
        .partition(":")[2]
        .partition("vlagents-ray eval again.yaml")[0]
    )
    again = EvalConfig.model_validate(yaml.safe_load(shown) | {"out": results.out})
    assert again == EvalConfig.model_validate(results.runs[-1].config)


def test_a_policy_that_was_served_is_served_again(tmp_path: Path) -> None:
    policies = [{"name": "noop", "source": "noop", "url": "serve://noop"}]
    config = EvalConfig.model_validate(
        {"policies": policies, "suites": [{"envs": [LINE]}], "out": tmp_path}
    )
    words = page_of(record(config)).words
    again = words[words.index("Save this as") :]
    assert "source: noop" in again
    assert "serve://" not in again


def test_videos_are_linked_from_where_the_page_is(results: Results, tmp_path: Path) -> None:
    path = results.out / "pages" / "report.html"
    for video in Read(write_report(results, path)).all("video"):
        assert (path.parent / unquote(str(video["src"]))).is_file()


def test_videos_are_in_the_page_up_to_a_budget(results: Results) -> None:
    videos = [video for case in results.cases for one in case.episodes for video in one.videos]
    size = (results.out / videos[0]).stat().st_size
    gallery = Gallery(results, results.out / "report.html", inline=True, budget=size)
    players = [gallery.player(video, "a label") for video in videos[:2]]
    inside, beside = (str(player.source) for player in players if player is not None)
    assert inside.startswith("data:video/mp4;base64,")
    assert beside.startswith("videos/")
    assert (gallery.inlined, gallery.linked) == (1, 1)


def test_a_video_that_is_gone_or_broken_leaves_the_rest(tmp_path: Path) -> None:
    results = record(runs(tmp_path, episodes=2), lambda _case, _seed: None, videos=True)
    first, second, *others = sorted(tmp_path.glob("videos/**/*.mp4"))
    first.unlink()
    second.write_bytes(b"not a video")
    page = page_of(results)
    assert sum(1 for video in page.all("video") if video.get("poster")) == len(others)
    assert str(first.relative_to(tmp_path)) not in [video["src"] for video in page.all("video")]


def test_one_policy_that_solved_everything_has_no_failures_and_nothing_to_compare(
    tmp_path: Path,
) -> None:
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": "a", "url": "http://localhost:1"}],
            "suites": [{"envs": [LINE]}],
            "out": tmp_path,
        }
    )
    page = page_of(record(config, lambda _case, _seed: 7))
    headings = {attributes["id"] for attributes in page.all("h2")}
    assert not headings & {"failures", "errors", "comparison", "learning-curve"}
    assert "100.0 % solved" in page.words


@pytest.mark.parametrize(("better", "verdict"), [(4, ", not significant"), (20, "")])
def test_the_headline_of_two_policies_is_their_difference(
    better: int, verdict: str, tmp_path: Path
) -> None:
    """The rate of the better policy would be selected for its size, and says nothing about the
    other.
    """
    policies = [
        {"name": name, "url": f"http://localhost:{port}"} for port, name in enumerate("ab", 1)
    ]
    config = EvalConfig.model_validate(
        {"policies": policies, "suites": [{"envs": [LINE], "episodes": 40}], "out": tmp_path}
    )
    page = page_of(
        record(config, lambda case, seed: 7 if case.policy_id == "b" or seed >= better else None)
    )
    assert f"+{100 * better / 40:.1f} points b less a{verdict} 95 % [" in page.words
    assert "solved by the best" not in page.words


def test_a_run_without_an_episode_has_a_page(tmp_path: Path) -> None:
    config = runs(tmp_path)
    with Store(resolve(config)) as store:
        store.begin_run({"vlagents-ray": "0"})
        store.end_run("interrupted")
    page = page_of(Results.load(tmp_path))
    assert "Not complete: interrupted" in page.words


def test_of_very_many_checkpoints_only_the_pairs_that_are_asked_for_most_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(success, "MOST_COMPARED", 20)
    results = record(runs(tmp_path, steps=list(range(200, 2001, 200)), episodes=6), better_later)
    words = page_of(results).section("Comparison")
    assert "45 pairs of so many checkpoints are left out" in words  # there are 55 pairs
    assert "further pairs" not in words
    for step in range(200, 2000, 200):
        assert f"learner@{step + 200} learner@{step}" in words
    assert "learner@2000 base" in words


def test_all_episodes_are_in_a_table_with_their_videos(tmp_path: Path) -> None:
    results = record(runs(tmp_path, episodes=6, video="all"), videos=True, troubles=True)
    page = page_of(results)
    played = [one for case in results.cases for one in case.episodes]
    assert page.text.count("solved") + page.text.count("not solved") == len(played) - 2
    assert (page.text.count("policy error"), page.text.count("lost")) == (1, 1)
    links = {unquote(str(one["href"])) for one in page.all("a") if one.get("class") == "video"}
    assert links == {video for one in played for video in one.videos}
    assert len(links) == len(played) - 2
    words = page.section("Episodes")
    assert f"one {LINE} base solved video 1" in words
    assert f"one {LINE} learner@1000 not solved video 1" in words


def test_solved_episodes_have_players_too(tmp_path: Path) -> None:
    results = record(runs(tmp_path, episodes=6, video="all"), lambda _case, _seed: 9, videos=True)
    page = page_of(results)
    assert len(page.all("video")) == 12
    assert "Solved: 12 videos" in page.words


def test_an_episode_that_does_not_count_is_marked(tmp_path: Path) -> None:
    record(runs(tmp_path, episodes=6), lambda _case, _seed: 9)
    fewer = runs(tmp_path, episodes=4, resume=True, accept_changes=True)
    with Store(resolve(fewer)) as store:
        store.begin_run({})
        page = page_of(Results.load(tmp_path))
    assert page.text.count("(solved)") == 3 * 3 * 2  # policy ids, tasks, episodes
    assert "In brackets: the episode is beyond the point" in page.words


def test_baselines_stand_before_checkpoints_and_are_a_level_line_in_the_learning_curve(
    tmp_path: Path,
) -> None:
    results = record(runs(tmp_path, steps=[3000, 1000, 2000]), better_later)
    assert results.policy_ids == ["base", "learner@1000", "learner@2000", "learner@3000"]
    page = page_of(results)
    places = [page.section("Success").index(f"{name} 12") for name in results.policy_ids]
    assert places == sorted(places)
    words = page.section("Learning curve")
    assert "base (no steps)" in words
    assert "training step" in words
    assert "version of the weights" not in words
    # In the table of numbers, where it has no step.
    assert re.search(r"base \(no steps\) \N{EN DASH} \d", words)
    words = page.section("Comparison")
    first = [
        words.index(pair) for pair in ("learner@2000 learner@1000", "learner@3000 learner@2000")
    ]
    others = [
        words.index(pair)
        for pair in ("learner@3000 base", "learner@2000 base", "learner@3000 learner@1000")
    ]
    assert first == sorted(first), "consecutive checkpoints come first, with the later one as A"
    assert max(first) < min(others)
    assert others[0] == min(others), "then the best checkpoint against the baseline"


def test_with_an_expert_the_checkpoints_before_and_after_are_not_folded_away(
    tmp_path: Path,
) -> None:
    config = runs(tmp_path, steps=list(range(200, 2001, 200)), episodes=6)
    expert = record(config, lambda case, seed: 5 if case.step is None else better_later(case, seed))
    words = page_of(expert).section("Comparison")
    unfolded = words[: words.index("further pairs")]
    for step in range(200, 2000, 200):
        assert f"learner@{step + 200} learner@{step}" in unfolded
    # once in total, and once by suite
    assert len(re.findall(r"learner@\d+ base", unfolded)) == 1 + 1


def test_cases_that_stopped_early_have_intervals_of_another_name(tmp_path: Path) -> None:
    config = runs(tmp_path, steps=[], episodes=60, stop={"width": 0.5, "at_least": 10})
    results = record(config, lambda _case, seed: 5 if seed % 2 else None)
    assert any(case.stopped_at is not None for case in results.cases)
    words = page_of(results).words
    assert "the intervals that this affects are confidence sequences" in words
    assert "Wilson interval" not in words
    assert "Wilson's method" not in words


def test_an_env_of_two_suites_is_named_with_its_suite_in_errors_and_protocol(
    tmp_path: Path,
) -> None:
    suites = [
        {"name": name, "envs": [LINE], "episodes": 4, "env_options": {"folder": name}}
        for name in ("one", "two")
    ]
    page = write_report(
        record(runs(tmp_path, suites=suites), troubles=True), tmp_path / "report.html"
    ).read_text()
    errors, _, rest = page.partition('id="errors"')[2].partition("</section>")
    assert f"one {LINE}" in errors
    assert f"<h3>one {LINE}</h3>" in rest
    assert f"<h3>two {LINE}</h3>" in rest


def test_real_time_and_synchronous_scores_are_compared_apart_and_their_gap_is_shown(
    tmp_path: Path,
) -> None:
    suites = [
        {
            "name": "live",
            "envs": [LINE],
            "episodes": 4,
            "clock": {"latency": 0.1, "mode": "async"},
        },
        {"name": "waiting", "envs": [LINE], "episodes": 4},
    ]
    page = page_of(record(runs(tmp_path, steps=[], suites=suites), lambda _case, _seed: 5))
    row = (
        f"learner, live in real time learner, waiting 0.0 {MINUS}50.0 to +50.0 1.00 1.00 4 4 0 0 0 "
    )
    assert row in page.words
    assert len(page.all("h3")) >= 2


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=8))
def test_differences_share_an_axis_that_holds_them_all(bounds: list[tuple[float, float]]) -> None:
    intervals = [(min(pair), max(pair)) for pair in bounds]
    limit = difference_limit(intervals)
    assert all(-limit <= low <= high <= limit for low, high in intervals)
    left, middle, right = (float(label.replace(MINUS, "-")) for label in difference_labels(limit))
    assert (left, middle, right) == pytest.approx((-100 * limit, 0, 100 * limit))
    ends = [
        difference_glyph(value, (value, value), limit, decided=True).dot
        for value in (-limit, 0.0, limit)
    ]
    axis = difference_glyph(0.0, (0.0, 0.0), limit, decided=True).axis
    assert axis == f"M{ends[0]:g} 8H{ends[2]:g}M{ends[1]:.1f} 2V14", (
        "labels from left to right, including 0"
    )


def test_a_small_difference_is_seen_beside_its_dot() -> None:
    """The interval of +4 to +15 points must be drawn longer than the dot of its estimate."""
    interval = (0.04, 0.15)
    glyph = difference_glyph(0.095, interval, difference_limit([interval]), decided=True)
    assert glyph.range is not None
    assert glyph.dot is not None
    left, right = (float(number) for number in re.findall(r"[MH]([\d.]+)", glyph.range))
    assert left < glyph.dot - 5
    assert right > glyph.dot + 5


@pytest.mark.parametrize("heading", ["Success", "Comparison"])
def test_columns_of_dots_have_an_axis_in_their_head(page: Read, heading: str) -> None:
    head = page.section(heading).split("learner@", 1)[0]
    labels = r"\b0 50 100\b" if heading == "Success" else rf"{MINUS}(\d+) 0 \+\1\b"
    assert re.search(labels, head), head
