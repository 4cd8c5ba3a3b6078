"""What the tests of pages share: a page taken apart, and what its charts hold."""

import base64
import json
from html.parser import HTMLParser

import numpy as np


class Parsed(HTMLParser):
    """A page's elements, its texts by id, and the data of its charts."""

    VOID = ("meta", "img", "br", "link", "input")

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.texts, self.charts, self.title = [], [], {}, {}, ""
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open and self.open[-1][0] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        if self.open and self.open[-1] == ("script", {"type": "application/json"}):
            chart = next(a["id"] for tag, a in reversed(self.elements) if tag == "div" and "id" in a)
            self.charts[chart] = json.loads(data)
        for _, attributes in self.open:
            if "id" in attributes:
                self.texts[attributes["id"]] = self.texts.get(attributes["id"], "") + data

    def tags(self, name):
        return [attributes for tag, attributes in self.elements if tag == name]


def parsed(path):
    return Parsed(path.read_text(encoding="utf-8"))


def unpacked(packed):
    """Return the numbers that plotly.js reads."""
    assert packed["dtype"] == "f4"
    return np.frombuffer(base64.b64decode(packed["bdata"]), "<f4").astype(float)


def trace(chart, name, axis="y"):
    """Return x and y of the trace of a name on an axis."""
    found = [one for one in chart["data"] if one["name"] == name and one["yaxis"] == axis]
    return unpacked(found[-1]["x"]), unpacked(found[-1]["y"])
