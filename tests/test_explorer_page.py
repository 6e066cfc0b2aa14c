"""A report in a browser: opened from disk, used by mouse and by keyboard, on a screen and on a phone's."""

import io
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from playwright.sync_api import Browser, Page, sync_playwright

from sb3_momba.explorer.report import write_report
from tests.explorer_browser import OPTIONS, PHONE, Watched, click_on_point, text, wait_until
from tests.explorer_runs import NUMBERS, chromium, needs_browser, needs_gl, simplex, train_tiny, write_run

pytestmark = needs_browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def real_report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    write_report([train_tiny(folder / "run")], folder / "report.html", n_films=3)
    return folder / "report.html"


@pytest.fixture(scope="module")
def watched(browser, real_report) -> Iterator[Watched]:
    watched = Watched(browser, real_report)
    yield watched
    watched.close()


@pytest.fixture
def opened(watched) -> Iterator[Page]:
    """The real report, the middle one of its three films chosen."""
    for key in ("Home", "ArrowRight"):
        watched.page.focus("#preference")
        watched.page.keyboard.press(key)
    yield watched.page
    watched.page.evaluate("document.getElementById('film').pause()")  # It costs time.
    watched.check()


def test_numbers_are_written_as_in_python(opened):
    assert opened.evaluate("(numbers) => numbers.map(explorer.number)", list(NUMBERS)) == list(NUMBERS.values())
    assert opened.evaluate("explorer.number(-0)") == "0"


@needs_gl
def test_films_share_one_loop(opened):
    """However many are shown, the page asks for one frame at a time."""
    for _ in range(3):
        for key in ("End", "Home"):
            opened.keyboard.press(key)
            wait_until(opened, "document.getElementById('film').currentTime > 0.05")
    asked = opened.evaluate("""new Promise((done) => {
        const before = window.requestAnimationFrame;
        let asked = 0, frames = 0;
        window.requestAnimationFrame = (call) => { asked += 1; return before.call(window, call); };
        const count = () => {
            frames += 1;
            if (frames < 10) return before.call(window, count);
            window.requestAnimationFrame = before;
            done(asked / frames);
        };
        before.call(window, count); })""")
    assert 0 < asked < 1.5


@needs_gl
def test_the_slider_changes_the_film(opened):
    source, shown = opened.get_attribute("#film", "src"), text(opened, "#film-caption")
    assert shown.startswith("0.50 forward speed, 0.50 jumping height.")
    opened.focus("#preference")
    opened.keyboard.press("ArrowRight")
    assert opened.get_attribute("#film", "src") != source
    assert text(opened, "#film-caption").startswith("1.00 forward speed, 0.00 jumping height.")
    assert text(opened, "#preference-text") == "1.00 / 0.00"
    assert opened.get_attribute("#preference", "aria-valuetext") == "1.00 forward speed, 0.00 jumping height"
    opened.keyboard.press("Home")
    assert text(opened, "#preference-text") == "0.00 / 1.00"


@needs_gl
def test_the_film_plays_and_the_return_runs_with_it(opened):
    wait_until(opened, "document.getElementById('film').currentTime > 0.1")
    opened.evaluate("document.getElementById('film').pause()")
    film = opened.evaluate("JSON.parse(document.getElementById('data').textContent).runs[0].films[1]")
    assert len(film["returns"]) > 4
    for frame in (3, 1):
        seek = f"""new Promise((done) => {{ const film = document.getElementById("film");
            film.addEventListener("seeked", done, {{ once: true }}); film.currentTime = {(frame + 0.5) / 20}; }})"""
        opened.evaluate(seek)
        for i, value in enumerate(film["returns"][frame]):
            assert float(text(opened, f"#now-{i}").replace(",", "")) == pytest.approx(value, rel=2e-3)
    seconds = opened.evaluate("document.getElementById('film').duration")
    assert seconds == pytest.approx(len(film["returns"]) / 20, abs=0.06)


def test_a_click_selects_a_point(opened):
    """Also one that was not filmed: the nearest film is shown, and says so."""
    values = opened.evaluate("JSON.parse(document.getElementById('data').textContent).runs[0].values[1]")
    click_on_point(opened, values)
    opened.wait_for_selector("#preference-text:text-is('0.25 / 0.75')")
    assert text(opened, "#points tr[aria-current] th") == "0.25 / 0.75"
    marked = opened.evaluate("(() => { const t = document.getElementById('front').data.at(-1); return [t.x[0], t.y[0]]; })()")
    assert marked == values


@needs_gl
def test_points_are_reached_by_keyboard(opened):
    opened.focus("#all-title + details > summary")
    opened.keyboard.press("Enter")
    opened.focus("#points tr[data-point='3'] button")
    opened.keyboard.press("Enter")
    assert text(opened, "#preference-text") == "0.75 / 0.25"
    assert text(opened, "#film-caption").startswith("The nearest filmed preference: ")


def test_the_slider_of_the_training_shows_earlier_fronts(opened):
    shown = "document.getElementById('growth').data.map((trace) => trace.x)"
    last = opened.evaluate(shown)
    assert text(opened, "#growth-text") == "300 steps"
    opened.focus("#growth-step")
    opened.keyboard.press("Home")
    assert text(opened, "#growth-text") == "100 steps"
    assert opened.evaluate(shown) != last


def test_on_a_phone_nothing_overflows(browser, real_report):
    watched = Watched(browser, real_report, viewport=PHONE)
    watched.page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    assert watched.overflowing() == []
    columns = watched.page.evaluate("getComputedStyle(document.querySelector('.explore')).gridTemplateColumns")
    assert len(columns.split()) == 1
    watched.close()


def test_points_that_lie_close_are_seen(browser, tmp_path):
    # Steps of a pixel: were points outlined in white, each but the last would be white around its centre.
    dense = [[500.0 - 0.1 * k, 2_474.0 + 1.5 * k] for k in range(13)]
    values = np.array([[2_450.0, 1_430.0], [1_500.0, 2_170.0], *dense])
    folder = write_run(tmp_path / "run", values, simplex(2, len(values)), env="MO-HalfCheetah-v4")
    write_report([folder], tmp_path / "report.html")
    watched = Watched(browser, tmp_path / "report.html")
    image = imread(io.BytesIO(watched.page.locator("#front").screenshot()))
    places = watched.page.evaluate(
        """(values) => { const { xaxis, yaxis } = document.getElementById("front")._fullLayout;
            return values.map(([x, y]) => [xaxis._offset + xaxis.d2p(x), yaxis._offset + yaxis.d2p(y)]); }""",
        dense,
    )
    for x, y in places:
        for aside in (-3, 0, 3):
            assert image[round(y), round(x) + aside, 0] < 0.5  # of red, which #0072b2 has none of; white has 1
    watched.close()


@pytest.mark.parametrize("n_objectives", [1, 3, 10], ids="{} objectives".format)
def test_other_numbers_of_objectives(n_objectives, browser, tmp_path):
    preferences = simplex(n_objectives, 6)
    values = np.random.default_rng(0).normal(0, 100, preferences.shape)
    folders = [write_run(tmp_path / name, values + k, preferences, label=name) for k, name in enumerate(("one", "another"))]
    write_report(folders, tmp_path / "report.html")
    watched = Watched(browser, tmp_path / "report.html", viewport=PHONE)
    page = watched.page
    assert text(page, "#no-film") == "No films: The run's folder has no model (model.zip or best_model.zip)."
    page.select_option("#run", "1")
    page.focus("#preference")
    page.keyboard.press("End")
    expected = values[-1] + 1
    cells = page.eval_on_selector_all("#returns tr", "(rows) => rows.map((row) => row.lastChild.textContent)")
    np.testing.assert_allclose([float(cell) for cell in cells], expected, rtol=1e-3)
    assert page.evaluate("document.getElementById('front').data.at(-1).x.length") == (1 if n_objectives == 3 else n_objectives)
    assert watched.overflowing() == []
    if n_objectives == 10:
        words = page.eval_on_selector_all(
            "#front .xtick text, #front .annotation-text",
            """(every) => every.filter((one) => one.checkVisibility({ visibilityProperty: true, opacityProperty: true }))
                .map((one) => { const { left, right, top, bottom } = one.getBoundingClientRect();
                    return [left, right, top, bottom]; })""",
        )
        assert len(words) == 30  # a name and two ends of each axis
        for (left, right, top, bottom), other in combinations(words, 2):
            assert right <= other[0] or other[1] <= left or bottom <= other[2] or other[3] <= top
    watched.close()


def test_a_hostile_record_runs_nothing(browser, tmp_path):
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(2)><a href='https://a.example'>b</a>"
    texts = {"label": hostile, "env": hostile, "objectives": [hostile] * 2, "error": hostile}
    values = np.array([[1.0, 2.0], [2.0, 1.0]])
    folder = write_run(tmp_path / "run", values, np.eye(2), **texts)
    write_report([folder], tmp_path / "report.html")
    watched = Watched(browser, tmp_path / "report.html")
    assert text(watched.page, "h1") == hostile
    assert watched.page.eval_on_selector_all("main a, main img, main script, svg a", "(found) => found.length") == 0
    watched.close()
