"""The player in a real browser, the system's own: it plays, follows the slider and the keys, and says no error."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import harness
from harness.fitting.files import fit_files
from harness.runner.compare import compare_campaigns
from harness.runner.stored import write_report
from tests.fitting.trajectories import overtaking
from tests.in_process import one_process
from tests.report.test_player import crashed, scenes_in
from tests.runner.test_compare_families import HARDER
from tests.runner.test_families import campaign as hours
from tests.stored_runs import copy_of

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = (
    "no-sandbox disable-gpu disable-quic no-first-run disable-background-networking disable-component-update "
    "disable-sync"
)
LENGTH_M, WIDTH_M, STEP_S = 5.0, 1.9, 0.1
api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="there is no Chromium or Chrome on this machine"),
]


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[api.BrowserContext]:
    with api.sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=BROWSER, args=[f"--{option}" for option in OPTIONS.split()])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def report(stored_run, tmp_path_factory) -> Path:
    return write_report(copy_of(stored_run("shells-twin"), tmp_path_factory.mktemp("report") / "run"))


@pytest.fixture(scope="module")
def replayed(stored_run, tmp_path_factory) -> Path:
    folder, file = stored_run("shells-lateral-sumo"), tmp_path_factory.mktemp("replay") / "crash.html"
    harness.write_motion(harness.replay(folder, crashed(folder)[0]), file)
    return file


@pytest.fixture
def opened(browser) -> Iterator[Callable[..., api.Page]]:
    """Opens a page, whose clock stands still; nothing may be said on the console, nor asked of anybody else."""
    said, contexts = [], []

    def open_page(file: Path, width: int = 1280, scheme: str = "light") -> api.Page:
        contexts.append(browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme))
        page = contexts[-1].new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: said.append(request.url) if request.url != file.as_uri() else None)
        page.clock.install(time=0)
        page.goto(file.as_uri())
        page.clock.pause_at(1000)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert said == []


def seconds(page: api.Page) -> float:
    return float(page.inner_text(".clock").removesuffix(" s"))


def cell(page: api.Page, vehicle: str, column: str) -> str:
    head = page.locator(".now thead th").all_text_contents()
    row = page.locator(".now tbody tr").filter(has=page.get_by_role("rowheader", name=vehicle, exact=True))
    return row.locator("th, td").nth(head.index(column)).inner_text()


def test_it_plays_at_the_chosen_speed_and_stops_and_leads_to_moments_by_keys_and_buttons(opened, replayed):
    page, [scene] = opened(replayed), scenes_in(replayed.read_text())
    first, begin = STEP_S * scene["first"], seconds(page)
    page.select_option(".bar select", "0.5")
    page.click(".go")
    page.clock.run_for(1000)
    assert seconds(page) == pytest.approx(begin + 0.5, abs=0.03)
    page.click(".go")
    stopped = seconds(page)
    page.clock.run_for(1000)
    assert seconds(page) == stopped
    page.click(".go")
    page.clock.run_for(60_000)
    end = scene["first"] + max(len(each["x"]) for each in (*scene["tracks"], *scene["ghosts"])) - 1
    assert seconds(page) == pytest.approx(STEP_S * end)
    assert "Play" in page.inner_text(".go")
    for step, name in scene["moments"]:
        page.get_by_role("button", name=name, exact=True).click()
        assert seconds(page) == pytest.approx(STEP_S * step)
    page.focus(".player")
    for key, after in (("Home", 0.0), ("ArrowRight", 0.1), ("Shift+ArrowRight", 1.1), ("ArrowLeft", 1.0)):
        page.keyboard.press(key)
        assert seconds(page) == pytest.approx(first + after)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Space")
    page.clock.run_for(400)
    assert (seconds(page), page.input_value(".bar select")) == (pytest.approx(first + 1.1, abs=0.03), "0.25")


def test_the_slider_shows_each_step_as_it_was_and_to_scale(opened, replayed):
    page, [scene] = opened(replayed), scenes_in(replayed.read_text())
    _, bv, av = scene["tracks"]
    for step in (scene["first"], scene["event"], scene["event"] + 2, av["crash"]):
        page.fill(".bar input", str(step))
        i, place = step - scene["first"], {}
        assert seconds(page) == pytest.approx(STEP_S * step)
        assert cell(page, "AV", "speed, m/s") == f"{av['v'][i]:.1f}"
        gap = bv["x"][i] - LENGTH_M - av["x"][i]
        assert cell(page, "AV", "gap to BV, m") == f"{gap if abs(gap) >= 0.05 else 0.0:.1f}".replace("-", "−")
        assert page.locator(".star").is_visible() == (step == av["crash"])
        body = page.locator(".car:not(.dashed) .body").first
        pixels = float(body.get_attribute("width")) / LENGTH_M
        assert float(body.get_attribute("height")) == pytest.approx(WIDTH_M * pixels)
        for car in page.locator(".car:not(.dashed)").all():
            x, y = re.findall(r"[-\d.]+", car.get_attribute("transform"))
            place[car.locator("text").text_content()] = float(x), float(y)
        for track in scene["tracks"][:2]:
            ahead_m, (x, y) = track["x"][i] - av["x"][i], place[track["name"]]
            over = track["over"][min(i, len(track["over"]) - 1)]
            assert x - place["AV"][0] == pytest.approx(ahead_m * pixels, abs=0.02)
            assert place["AV"][1] - y == pytest.approx((1.0 - over) * 3.6 * pixels, abs=0.02)


def test_a_report_changes_between_crashes(opened, report):
    page, scenes = opened(report), scenes_in(report.read_text())
    assert page.locator(".pick button").all_text_contents() == [str(scene["episode"]) for scene in scenes]
    assert page.inner_text(".player h3") == scenes[0]["title"]
    page.locator(".pick button").nth(1).click()
    assert page.inner_text(".player h3") == scenes[1]["title"]
    page.locator("#worst summary").last.click()  # the table is folded
    page.locator("a[data-scene='0']").click()
    assert page.inner_text(".player h3") == scenes[0]["title"]
    assert page.locator(".told dt").all_text_contents() == [name for name, _ in scenes[0]["facts"]]
    page.keyboard.press("End")
    assert page.locator(".go").is_visible()


def test_a_comparison_plays_both_on_the_same_cut_in(opened, compared, tmp_path):
    file = write_report(copy_of(compared, tmp_path / "out"))
    page, scene = opened(file, 400, "dark"), scenes_in(file.read_text())[0]
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    for step, hit in ((scene["event"], False), (scene["tracks"][2]["crash"], True)):
        page.fill(".bar input", str(step))
        for name, track in (("B", scene["tracks"][2]), ("A", scene["ghosts"][0])):
            assert cell(page, name, "speed, m/s") == f"{track['v'][step - scene['first']]:.1f}"
        assert page.locator(".star").is_visible() == hit
    begin = seconds(page)
    assert page.locator(".car.dashed").is_visible()
    page.click(".go")
    page.clock.run_for(1000)
    assert seconds(page) > begin
    page.locator(".pick button").last.click()
    assert "Only A crashes" in page.inner_text(".player h3")


@pytest.fixture(scope="module")
def pages(report, replayed, crashing, compared, tmp_path_factory) -> list[Path]:
    """One of each kind: a run's in each scenario, of a comparison, of one test; without a player of a sum, of a fit."""
    place = tmp_path_factory.mktemp("pages")
    runs = [write_report(copy_of(crashing[name], place / name)) for name in ("lead_brakes", "cut_out")]
    with_player = [report, replayed, *runs, write_report(copy_of(compared, place / "compared"))]
    overtaking(2.0).to_parquet(place / "rows.parquet", index=False)
    fit_files([place / "rows.parquet"], (file := place / "mine.html").with_suffix(".yaml"), n_replicates=2)
    with one_process():
        sums = harness.run(hours(), place / "sum", workers=1).folder / "report.html"
        return [*with_player, sums, compare_campaigns(hours(), hours(HARDER), place / "pairs", workers=1).report, file]


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark"), (390, "light")])
def test_axe_finds_nothing_and_nothing_is_wider_than_the_screen(width, scheme, browser, pages):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="it brings axe-core").Axe()
    context = browser.new_context(
        viewport={"width": width, "height": 844}, color_scheme=scheme, bypass_csp=True, offline=True
    )
    for file in pages:
        page = context.new_page()
        page.goto(file.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
        page.add_style_tag(content=".scroll { background: none }")  # contrast on a gradient is not judged
        found = axe.run(page).response["violations"]
        assert [(file, each["id"], [node["target"] for node in each["nodes"]]) for each in found] == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.close()
    context.close()


def test_a_vehicle_out_of_view_is_named_above_the_road_where_no_other_is(opened, crashing):
    file = write_report(copy_of(crashing["lead_brakes"], crashing["lead_brakes"].parent / "far"))
    text, scenes = file.read_text(), scenes_in(file.read_text())
    data = re.search(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)[1]
    for scene in scenes:
        scene["tracks"][0]["x"] = [x + 200.0 for x in scene["tracks"][0]["x"]]
        for ghost in scene["ghosts"]:  # at the right end of the view, where the name would stand
            ghost |= {key: scene["tracks"][-1][key] for key in "xv"}
            ghost["x"] = [x + 86.0 for x in ghost["x"]]
    file.write_text(text.replace(data, json.dumps(scenes)))
    page = opened(file)
    label, road = page.get_by_text(re.compile(r"^LV \d+ m")), page.locator(".asphalt").bounding_box()
    box, other = label.bounding_box(), page.locator(".car.dashed .body").first.bounding_box()
    assert box["y"] + box["height"] <= road["y"] + 1.0
    assert road["x"] < box["x"] < box["x"] + box["width"] <= road["x"] + road["width"]
    assert other["x"] < road["x"] + road["width"] - 8.0
