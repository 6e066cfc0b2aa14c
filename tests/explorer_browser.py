"""A page of the explorer in Chromium, for the tests of the report and of the live page."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page

OPTIONS = ["--no-sandbox", "--enable-unsafe-swiftshader"]  # as root; 3-D without a graphics card
TIMEOUT = 120_000  # ms; a busy machine is slow
PHONE = {"width": 390, "height": 844}


class Watched:
    """A page, and what it says and asks for."""

    def __init__(self, browser: Browser, path: Path | str, **options: Any):
        self.page: Page = browser.new_page(**options)
        self.page.set_default_timeout(TIMEOUT)
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text) if message.type == "error" else None)
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("dialog", lambda dialog: self.said.append(dialog.message))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path if isinstance(path, str) else path.as_uri())
        self.page.wait_for_selector("body[data-ready]")

    def check(self) -> None:
        """No error was said, and nothing asked for outside of the file."""
        assert self.said == []
        assert [url for url in self.asked if not url.startswith(("data:", "blob:"))] == self.asked[:1]

    def close(self) -> None:
        """Check, and end."""
        self.check()
        self.page.close()

    def overflowing(self) -> list[str]:
        """What reaches beyond the right edge."""
        return self.page.evaluate("""
            () => [document.documentElement, ...document.querySelectorAll("body *")]
                .filter((one) => one.matches("html") || !one.closest(".scroll, .skip, svg"))
                .filter((one) => Math.max(one.getBoundingClientRect().right, one.matches("html") ? one.scrollWidth : 0)
                    > innerWidth + 0.5)
                .map((one) => `${one.tagName} ${one.id} ${one.className}`)""")


def wait_until(page: Page, expression: str) -> None:
    """Playwright's own way evaluates strings in the page, which the page does not let anyone do."""
    give_up = time.monotonic() + TIMEOUT / 1_000
    while not page.evaluate(expression):
        assert time.monotonic() < give_up, expression
        page.wait_for_timeout(50)


def text(page: Page, selector: str) -> str:
    return str(page.text_content(selector))


def click_on_point(page: Page, values: Sequence[float]) -> None:
    """Where the front's chart of two objectives shows these returns."""
    x, y = page.evaluate(
        """(values) => {
            const chart = document.getElementById("front");
            const box = chart.getBoundingClientRect(), { xaxis, yaxis } = chart._fullLayout;
            return [box.left + xaxis._offset + xaxis.d2p(values[0]), box.top + yaxis._offset + yaxis.d2p(values[1])]; }""",
        list(values),
    )
    page.mouse.click(x, y)
