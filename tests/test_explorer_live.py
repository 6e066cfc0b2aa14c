"""The live page, in a browser."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import sync_playwright

from sb3_momba import MOMBA
from sb3_momba.explorer.kit import DecisionKit
from sb3_momba.explorer.live import LiveServer
from sb3_momba.explorer.opening import open_kit
from tests.explorer_browser import OPTIONS, PHONE, TIMEOUT, Watched, text, wait_until
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


def still(page: Any) -> None:
    page.wait_for_selector("body[data-state='still']", timeout=TIMEOUT)


@needs_browser
@needs_gl
def test_a_choice_by_keyboard(server, kit):
    """Preference moved, new rollout shown, bound kept, policy kept."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
        watched = Watched(browser, server.url, viewport=PHONE)
        page = watched.page
        still(page)
        assert text(page, "#weight-text-0") == "0.50 / 0.50"
        source = page.get_attribute("#film", "src")
        page.focus("#weight-0")
        page.keyboard.press("End")
        assert text(page, "#weight-text-0") == "1.00 / 0.00"
        wait_until(page, "document.getElementById('predicted-0').textContent.startsWith("
                   f"explorer.number({kit.measured[-1, 0]}))")  # fmt: skip
        still(page)
        assert page.get_attribute("#film", "src") != source
        assert text(page, "#film-caption").startswith("1.00 forward speed, 0.00 jumping height.")
        assert page.evaluate(f"explorer.number({kit.measured[-1, 0]})") == text(page, "#rollout-0")
        marked = page.evaluate("document.getElementById('front').data.at(-1).x[0]")
        assert marked == pytest.approx(kit.measured[-1, 0])
        assert watched.overflowing() == []

        page.select_option("#bound-kind", "at_least")
        page.fill("#bound-value", "1e6")
        page.keyboard.press("Enter")
        page.wait_for_selector("#bound-answer .bad")
        assert "No policy that was found has 1 M forward speed" in text(page, "#bound-answer")

        page.focus("#keep")
        page.keyboard.press("Enter")
        page.wait_for_selector("#kept .good")
        chosen = page.evaluate("document.querySelector('#kept code').textContent")
        assert (Path(chosen) / "policy.onnx").is_file()
        still(page)
        page.evaluate("document.getElementById('film').pause()")
        assert watched.said == []
        assert all(url.startswith((server.url, "blob:", "data:")) for url in watched.asked)
        browser.close()


@needs_browser
def test_three_objectives_without_opengl(tmp_path, monkeypatch):
    """One slider each, which keep the simplex; the page says why there is no film."""
    monkeypatch.setenv("MUJOCO_GL", "disable")
    options: dict[str, Any] = {"policy_kwargs": TINY, "buffer_size": 10, "seed": 0}
    MOMBA("MlpPolicy", "MO-Hopper-3obj-v4", **options).save(tmp_path / "model.zip")
    with (
        open_kit(tmp_path / "model.zip", "MO-Hopper-3obj-v4") as kit,
        serving(kit) as server,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium() or "chromium", args=OPTIONS)
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
        assert watched.said == []
        browser.close()
        server.shutdown()
