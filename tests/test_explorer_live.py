"""The live page, in a browser."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from sb3_momba import MOMBA
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer
from sb3_momba.explorer.opening import open_kit
from tests.explorer_browser import OPTIONS, PHONE, TIMEOUT, Watched, click_on_point, text, wait_until
from tests.explorer_runs import TINY, chromium, needs_browser, needs_gl, serving, train_tiny


@pytest.fixture(scope="module")
def kit(tmp_path_factory) -> Iterator[DecisionKit]:
    folder = tmp_path_factory.mktemp("live")
    with open_kit(train_tiny(folder / "run"), folder=folder / "kept") as kit:
        yield kit


@pytest.fixture(scope="module")
def server(kit) -> Iterator[LiveServer]:
    with serving(kit) as server:
        yield server


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def watched(browser, server) -> Iterator[Watched]:
    watched = Watched(browser, server.url)
    yield watched
    assert watched.said == []
    assert all(url.startswith((server.url, "blob:", "data:")) for url in watched.asked)
    watched.page.close()


@pytest.fixture
def page(watched) -> Iterator[Page]:
    """The live page at rest, equal weights chosen."""
    watched.page.evaluate("document.getElementById('weight-0').value = 50")
    watched.page.dispatch_event("#weight-0", "input")
    still(watched.page)
    yield watched.page
    watched.page.evaluate("document.getElementById('film').pause()")  # It costs time.


def move(page: Page, key: str) -> None:
    page.focus("#weight-0")
    page.keyboard.press(key)


def still(page: Page) -> None:
    page.wait_for_selector("body[data-state='still']", timeout=TIMEOUT)
    assert text(page, "#status") == ""


def ask_for(page: Page, kind: str, value: float) -> None:
    page.select_option("#bound-kind", kind)
    page.fill("#bound-value", str(value))
    page.keyboard.press("Enter")


@needs_browser
@needs_gl
def test_a_choice_by_keyboard(page, watched, kit):
    """Preference moved, new rollout shown, policy kept."""
    assert text(page, "#weight-text-0") == "0.50 / 0.50"
    source = page.get_attribute("#film", "src")
    move(page, "End")
    assert text(page, "#weight-text-0") == "1.00 / 0.00"
    wait_until(page, "document.getElementById('predicted-0').textContent.startsWith("
               f"explorer.number({kit.measured[-1, 0]}))")  # fmt: skip
    still(page)
    assert page.get_attribute("#film", "src") != source
    assert text(page, "#film-caption").startswith("1.00 forward speed, 0.00 jumping height.")
    assert page.evaluate(f"explorer.number({kit.measured[-1, 0]})") == text(page, "#rollout-0")
    assert text(page, "#spoken").startswith(f"forward speed: predicted {text(page, '#predicted-0')}, rollout ")
    marked = page.evaluate("document.getElementById('front').data.at(-1).x[0]")
    assert marked == pytest.approx(kit.measured[-1, 0])

    page.focus("#keep")
    page.keyboard.press("Enter")
    page.wait_for_selector("#kept .good")
    chosen = page.evaluate("document.querySelector('#kept code').textContent")
    assert (Path(chosen) / "policy.onnx").is_file()
    size = page.viewport_size
    page.set_viewport_size(PHONE)
    wait_until(page, "document.documentElement.scrollWidth <= innerWidth")
    assert watched.overflowing() == []
    page.set_viewport_size(size)


@needs_browser
@needs_gl
def test_a_bound_is_kept_and_taken_back(page, kit):
    wanted = float(kit.measured[:, 0].max())
    ask_for(page, "at_least", wanted)
    page.wait_for_selector("#bound-answer .good")
    assert " kept it in its episode: forward speed " in text(page, "#bound-answer")
    still(page)
    shown = page.evaluate("document.getElementById('front').data.at(-1).x[0]")
    assert shown >= wanted
    page.focus("#bound-answer button")
    page.keyboard.press("Enter")
    assert text(page, "#weight-text-0") == "0.50 / 0.50"
    still(page)


@needs_browser
@needs_gl
def test_a_bound_that_nothing_keeps_is_said(page):
    ask_for(page, "at_least", 1e6)
    page.wait_for_selector("#bound-answer .bad")
    assert "No policy that was found has 1 M forward speed" in text(page, "#bound-answer")
    still(page)


@needs_browser
@needs_gl
def test_a_negative_difference_is_no_bound(page, watched):
    ask_for(page, "less", -5)
    page.wait_for_selector("#bound-answer .bad")
    assert text(page, "#bound-answer") == "How much less it may be is 0 or more."
    assert watched.said == []  # The server was not asked, whose refusal browsers log.


@needs_browser
@needs_gl
def test_a_bound_asked_for_while_the_page_is_busy(page, kit, monkeypatch):
    """It waits for the film that is being made, which is not shown any more, and is found."""
    go_on, show_film = threading.Event(), kit.show_film

    def slow(preference):
        go_on.wait()
        return show_film(preference)

    monkeypatch.setattr(kit, "show_film", slow)
    move(page, "Home")
    page.wait_for_selector("body[data-state='filming']")
    ask_for(page, "less", 1e6)
    page.wait_for_selector("body[data-state='bound']")
    go_on.set()
    page.wait_for_selector("#bound-answer .good")
    still(page)


@needs_browser
@needs_gl
def test_a_bound_that_fails_leaves_the_page_usable(page, watched, kit, monkeypatch):
    def fail(*_, **__):
        raise KeyError("joint")

    monkeypatch.setattr(kit, "meet", fail)
    ask_for(page, "less", 1)
    page.wait_for_selector("#bound-answer .bad")
    assert text(page, "#bound-answer") == "KeyError: 'joint'"
    assert " 500 " in watched.said.pop()  # what browsers say of an answer that is an error
    still(page)


@needs_browser
@needs_gl
def test_moving_on_ends_a_search(page, kit, monkeypatch):
    go_on = threading.Event()

    def slow(*_, still_wanted, **__):
        go_on.wait()
        still_wanted()

    monkeypatch.setattr(kit, "meet", slow)
    ask_for(page, "less", 1)
    page.wait_for_selector("body[data-state='bound']")
    move(page, "Home")
    page.wait_for_selector("body[data-state='rolling']")
    go_on.set()
    page.wait_for_selector("#bound-answer .bad")
    assert text(page, "#bound-answer") == "The preference was moved meanwhile: ask again."
    still(page)
    assert text(page, "#weight-text-0") == "0.00 / 1.00"
    assert page.is_hidden("#trouble")


@needs_browser
@needs_gl
def test_another_page_may_come_first(page, server):
    """Then it is said, and the page does not wait for ever."""

    def take_a_turn():
        with server.rollouts.turn():
            pass

    with server.rollouts.turn():
        before = server.rollouts._newest
        move(page, "Home")
        while server.rollouts._newest == before:
            page.wait_for_timeout(10)
        other = threading.Thread(target=take_a_turn)
        other.start()
        while server.rollouts._newest == before + 1:
            page.wait_for_timeout(10)
    other.join()
    page.wait_for_selector("#trouble:not([hidden])")
    assert text(page, "#trouble") == "Another page asked for something newer meanwhile: ask again."
    still(page)


@needs_browser
@needs_gl
def test_an_alternative_is_shown(page, kit, monkeypatch):
    other = {"preference": [0.25, 0.75], "returns": [1.0, 2.0], "distance": 1.234, "differs": "mean of action[0]: 1.00"}
    monkeypatch.setattr(kit, "_alternatives", lambda _: [other])
    move(page, "Home")
    still(page)
    assert text(page, "#alternatives span") == "0.25 / 0.75 returns 1 / 2; difference 1.2, most in the mean of action[0]: 1.00"
    page.focus("#alternatives button")
    page.keyboard.press("Enter")
    assert text(page, "#weight-text-0") == "0.25 / 0.75"
    assert page.evaluate("document.activeElement.id") == "weight-0"
    still(page)


@needs_browser
@needs_gl
def test_a_click_on_the_front_chooses(page, kit):
    k = int(kit.measured[:, 0].argmax())
    click_on_point(page, kit.measured[k])
    page.wait_for_selector(f"#weight-text-0:text-is('{kit.front.preferences[k, 0]:.2f} / {kit.front.preferences[k, 1]:.2f}')")
    still(page)


@needs_browser
def test_three_objectives_without_opengl(browser, tmp_path, monkeypatch):
    """One slider each, which keep the simplex; the page says why there is no film."""
    monkeypatch.setenv("MUJOCO_GL", "disable")
    options: dict[str, Any] = {"policy_kwargs": TINY, "buffer_size": 10, "seed": 0}
    MOMBA("MlpPolicy", "MO-Hopper-3obj-v4", **options).save(tmp_path / "model.zip")
    rates = np.full((3, 3, 3), None)
    rates[0, 1] = [-1.0, 2.0, -0.5]
    with open_kit(tmp_path / "model.zip", "MO-Hopper-3obj-v4") as kit, serving(kit) as server:
        monkeypatch.setattr(kit, "around", lambda _: {"rates": rates.tolist(), "seeds": []})
        watched = Watched(browser, server.url, viewport=PHONE)
        page = watched.page
        assert "MUJOCO_GL is 'disable'" in text(page, "#no-film")
        assert page.is_visible("#no-film")
        assert not page.is_visible("#film")
        page.focus("#weight-0")
        page.keyboard.press("Home")
        assert [text(page, f"#weight-text-{i}") for i in range(3)] == ["0.00", "0.50", "0.50"]
        page.keyboard.press("End")
        assert [text(page, f"#weight-text-{i}") for i in range(3)] == ["1.00", "0.00", "0.00"]
        still(page)
        assert text(page, "#rollout-0") != ""
        assert watched.overflowing() == []
        assert page.eval_on_selector_all("#rates tbody tr", "(rows) => rows.map((row) => row.innerText.split('\\t'))") == [
            ["1 less in forward speed, weight to jumping height", "-1", "+2", "-0.5"]
        ]
        assert watched.said == []
        watched.page.close()
        server.shutdown()
