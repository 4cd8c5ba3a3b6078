"""The pages of the documentation, and what their readers do with them."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
PROGRAMS = ROOT / os.environ.get("SLPI_INSTALL", "install") / "slpi_ros" / "lib" / "slpi_ros"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$|^<!-- (?!generated)(\w[\w ]*): ([^\n]+) -->$", re.DOTALL | re.MULTILINE)
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Step:
    """A block of a page with its language, or a remark to the test (`<!-- WHAT: TEXT -->`, which no reader sees)."""

    what: str
    text: str


def steps_of(page):
    found = BLOCK.finditer(page.read_text())
    return [Step(one[1], one[2]) if one[1] else Step(one[3], one[4]) for one in found]


def commands_of(page, *languages):
    """Return the commands in the blocks of these languages, words split, continued lines joined."""
    text = "\n".join(step.text for step in steps_of(page) if step.what in languages).replace("\\\n", " ")
    lines = re.sub(r"<<'END'.*?^END$", "", text, flags=re.DOTALL | re.MULTILINE).splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


class Reader:
    """Somebody who types the commands of a page in a folder, in terminals as they are needed."""

    def __init__(self, folder):
        self.folder, self.running = folder, {}
        tools = folder / "bin"
        tools.mkdir()
        stand_in = Path(__file__).with_name("ros2_stand_in.py")
        for name, command in (("ros2", f"{sys.executable} {stand_in}"), ("python3", sys.executable)):
            (tools / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
            (tools / name).chmod(0o755)
        self.environment = os.environ | {"PATH": f"{tools}:{PROGRAMS}:{os.environ['PATH']}"}

    def type(self, text, patience=PATIENCE_S):
        """Type a block: wait for its end, unless its program runs until it is interrupted."""
        name = self.lasting(text)
        log = self.folder / f"{name or 'last'}.log"
        with log.open("wb") as console:
            process = subprocess.Popen(
                ["bash", "-euc", f"exec {text}" if name else text], cwd=self.folder, env=self.environment,
                stdout=console, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        if name:
            self.running[name] = process
            return name
        try:
            code = process.wait(patience)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        assert code == 0, (text, code, log.read_text())
        return ""

    @staticmethod
    def lasting(text):
        """Return the name of the program in a block if it runs until it is interrupted."""
        found = re.match(r"ros2 run slpi_ros (stage_simulator|recorder|compensator|identify)\b", text)
        return found[1] if found else next((name for name in ("driver.py", "pub -r") if name in text), "")

    def interrupt(self, name):
        """Press Ctrl-C."""
        process = self.running.pop(name)
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(PATIENCE_S)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)

    def check_alive(self):
        for name, process in self.running.items():
            assert process.poll() is None, (name, (self.folder / f"{name}.log").read_text())

    def close(self):
        while self.running:
            self.interrupt(next(reversed(self.running)))

    def until(self, spin, done, what):
        end = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < end, f"waited in vain for {what}"
            self.check_alive()
            spin()
