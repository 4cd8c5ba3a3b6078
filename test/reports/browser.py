"""A headless Chromium that tests drive as a person would: it opens a page, looks at it, points and clicks."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
import time

import pytest

PATIENCE = 60.0
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--window-size=1280,900"),
)
# Chromium listens on descriptor 3 and answers on 4.
_START = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); os.execv(sys.argv[3], sys.argv[3:])"
)


class Browser:
    """One window, over the DevTools protocol on a pipe."""

    def __init__(self, profile):
        program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
        if not program:
            pytest.skip("no Chromium on this machine")
        (hears, ask), (answers, says) = os.pipe(), os.pipe()
        theirs = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (hears, says)]
        command = [sys.executable, "-c", _START, *map(str, theirs), program, *_FLAGS, f"--user-data-dir={profile}"]
        self.process = subprocess.Popen(
            [*command, "--remote-debugging-pipe", "about:blank"], pass_fds=theirs, stderr=subprocess.DEVNULL
        )
        for end in (hears, says, *theirs):
            os.close(end)
        self.ask, self.answers = os.fdopen(ask, "wb", buffering=0), os.fdopen(answers, "rb")
        self.rest, self.session, self.asked, self.events = b"", None, 0, []
        pages = [target for target in self.call("Target.getTargets")["targetInfos"] if target["type"] == "page"]
        self.session = self.call("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self):
        self.process.terminate()
        self.process.wait(timeout=PATIENCE)
        self.ask.close()
        self.answers.close()

    def call(self, method, **parameters):
        self.asked += 1
        message = {"id": self.asked, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.ask.write(json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self.asked:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def _next(self):
        while b"\0" not in self.rest:
            more = self.answers.read1(1 << 16)
            assert more, "Chromium has gone"
            self.rest += more
        first, self.rest = self.rest.split(b"\0", 1)
        return json.loads(first)

    def run(self, script):
        """Return what JavaScript gives; a promise is waited for."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, script):
        """Wait until JavaScript gives something true."""
        end = time.monotonic() + PATIENCE
        while not self.run(script):
            assert time.monotonic() < end, f"never true: {script}"
            time.sleep(0.05)

    def open(self, path):
        """Open a file and wait until its charts are drawn."""
        self.events.clear()
        self.call("Page.navigate", url=path.as_uri())
        self.until("document.readyState === 'complete' && document.body.dataset.drawn === 'all'")

    def complaints(self):
        """Return what the page reported as errors since it was opened."""
        return [event for event in self.events if event["method"] in ("Runtime.exceptionThrown", "Log.entryAdded")]

    def fetched(self):
        """Return the addresses of everything that the page asked for since it was opened."""
        sent = [event for event in self.events if event["method"] == "Network.requestWillBeSent"]
        return [event["params"]["request"]["url"] for event in sent]

    def place_of(self, script):
        """Scroll to the element that JavaScript gives, and return where it is: left, top, width, height."""
        return self.run(
            f"(() => {{ const e = {script}; e.scrollIntoView({{block: 'center'}});"
            " const r = e.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()"
        )

    def drag(self, start, stop):
        """Press the mouse at one place of the window, release it at another."""
        at = dict(zip("xy", start, strict=True))
        self.call("Input.dispatchMouseEvent", type="mouseMoved", **at)
        self.call("Input.dispatchMouseEvent", type="mousePressed", button="left", clickCount=1, **at)
        for share in (0.3, 0.6, 1.0) if start != stop else ():
            at = {name: a + share * (b - a) for name, a, b in zip("xy", start, stop, strict=True)}
            self.call("Input.dispatchMouseEvent", type="mouseMoved", button="left", **at)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", button="left", clickCount=1, **at)

    def click_legend(self, chart, name):
        """Click a name in the legend of the chart with an id."""
        items = f"[...document.getElementById({json.dumps(chart)}).querySelectorAll('.legend .traces')]"
        script = f"{items}.find(item => item.textContent === {json.dumps(name)}).querySelector('.legendtoggle')"
        left, top, width, height = self.place_of(script)
        here = (left + width / 2, top + height / 2)
        self.drag(here, here)
