"""A page in a real browser with the network cut off, and what is seen of it."""

import re
import time

import cv2
import numpy as np
from playwright.sync_api import expect

LAPTOP = {"viewport": {"width": 1366, "height": 768}}
NEAR = 40
"""Of a colour, in levels: marks are drawn with soft edges."""

ON_SCREEN = """
([x, y]) => {
  const part = document.querySelector("#map .tile-part");
  const [level, col, row] = new URL(part.src).pathname.split("/").slice(-3).map(Number);
  const box = part.parentElement.getBoundingClientRect();
  const side = SIDE * 2 ** level;
  return [box.left + (x / side - col) * box.width, box.top + (y / side - row) * box.height];
}
"""


SETTLED = """
[...document.images].every((each) => !each.getAttribute("src") || each.complete)
  && [...document.querySelectorAll(".leaflet-tile")]
    .every((each) => getComputedStyle(each).opacity === "1")
  && !document.querySelector(".leaflet-zoom-anim, .leaflet-pan-anim")
"""
TWO_FRAMES = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
"""Leaflet begins to zoom in the frame after the event that asks for it."""


class Visit:
    """A page that was opened, and what went wrong on it."""

    def __init__(self, browser, url, options):
        self.context = browser.new_context(**{**LAPTOP, **options})
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.asked, self.elsewhere, self.wrong = [], [], []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("console", self._heard)
        self.context.route(re.compile(f"^(?!{re.escape(url)})"), self._cut_off)
        self.url = url
        self.page.goto(url)

    def _heard(self, message):
        if message.type in ("error", "warning"):
            self.wrong.append(message.text)

    def _cut_off(self, route):
        self.elsewhere.append(route.request.url)
        route.abort()

    def again(self):
        """As if it was opened for the first time."""
        self.page.evaluate("localStorage.clear()")
        self.page.mouse.move(0, 0)
        self.page.goto(self.url)

    def was_well(self):
        found = [*self.wrong, *self.elsewhere]
        assert found == [], found  # helpers have no rewritten assertions

    def __getattr__(self, name):
        return getattr(self.page, name)

    def js(self, script, *arguments):
        return self.page.evaluate(script, *arguments)

    def chosen(self, i, count):
        """Waits until view `i` of so many is the selected one."""
        expect(self.page.locator("#chosen-name")).to_have_text(re.compile(f"^{i + 1} of {count}:"))

    def pictured(self, i):
        """Waits until the images of view `i` are there."""
        expect(self.page.locator("#img-view")).to_have_attribute("src", re.compile(f"/{i}/view"))
        self.settled()

    def settled(self):
        """Waits until all images are there and the map stands still."""
        self.page.evaluate(TWO_FRAMES)
        self.until(lambda: self.page.evaluate(SETTLED))

    def until(self, holds):
        """Waits for what does not come at once; scripts of the page must not be made of text."""
        last = time.monotonic() + 120
        while not holds():
            assert time.monotonic() < last
            self.page.wait_for_timeout(30)

    def on_screen(self, xy, chunk_px):
        """Where a pixel of the sheet is on the screen, by where its imagery is."""
        return np.array(self.page.evaluate(ON_SCREEN.replace("SIDE", str(chunk_px)), list(xy)))

    def colour(self, name):
        """A colour of the style sheet, as blue, green, red."""
        script = f"getComputedStyle(document.documentElement).getPropertyValue('--{name}')"
        value = self.page.evaluate(script).strip().removeprefix("#")
        return np.array([int(value[i : i + 2], 16) for i in (4, 2, 0)])

    def picture(self, **clip):
        """What is on the screen, as levels (H, W, 3) of blue, green, red."""
        shot = self.page.screenshot(**clip)
        return cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR).astype(int)


def painted(picture, colour, xy=None, reach_px=6):
    """How many pixels (near a place) have a colour."""
    if xy is not None:
        x, y = np.rint(xy).astype(int)
        picture = picture[y - reach_px : y + reach_px + 1, x - reach_px : x + reach_px + 1]
    return int((np.abs(picture - colour).max(axis=-1) < NEAR).sum())
