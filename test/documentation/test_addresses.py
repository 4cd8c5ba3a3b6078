"""No address in the repository leads nowhere: links lead to files, hosts exist, mail addresses are placeholders."""

import os
import re
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Folders that builds, tests and tools leave behind.
MADE = re.compile(r"(build|install|log)(-\w+)?|dist|_build|demo_output|__pycache__|.*\.egg-info|\.(?!ci$|github$).*")
TEXT = {
    "",
    ".cfg",
    ".css",
    ".ini",
    ".ipynb",
    ".json",
    ".md",
    ".py",
    ".rst",
    ".sh",
    ".toml",
    ".txt",
    ".xml",
    ".yaml",
    ".yml",
}
# Hosts of standards, formats and projects that this one builds on, and this machine. Any other one was made up, or is a
# repository that moves: say "where you cloned it from".
HOSTS = {
    "127.0.0.1",
    "download.ros.org",
    "fmi-standard.org",
    "github.com",
    "json-schema.org",
    "mcap.dev",
    "sqlite.org",
    "www.apache.org",
    "www.eprosima.com",
    "www.mathworks.com",
    "www.ros.org",
    "www.w3.org",
}
# What `ros2 pkg create` writes, and the domains that RFC 2606 keeps free.
PLACEHOLDERS = ("todo.todo", "example.com", "example.org")


def texts():
    """Yield every text file of the repository that no build has made."""
    for folder, folders, files in os.walk(ROOT):
        folders[:] = sorted(name for name in folders if not MADE.fullmatch(name))
        yield from (Path(folder) / name for name in sorted(files) if Path(name).suffix in TEXT)


FILES = list(texts())
PAGES = [path for path in FILES if path.suffix == ".md"]


def test_the_files_of_the_repository_are_found():
    names = {str(path.relative_to(ROOT)) for path in FILES}
    assert {"package.xml", "setup.py", "docs/how-to/install.md", ".github/workflows/test.yml", ".ci/run"} <= names


def test_every_host_is_known():
    found = {
        (str(path.relative_to(ROOT)), host)
        for path in FILES
        for host in re.findall(
            r"\b(?:https?|ssh|git|ftp)://(?:\w+@)?([\w-]+\.[\w.-]+)", path.read_text(errors="replace")
        )
    }
    assert len(found) >= 5
    assert not {each for each in found if each[1] not in HOSTS}


def test_every_mail_address_is_a_placeholder():
    found = [
        (str(path.relative_to(ROOT)), domain)
        for path in FILES
        for domain in re.findall(
            r"\b[\w.+-]+@([a-z0-9-]+(?:\.[a-z0-9-]+)*\.[a-z]{2,})\b", path.read_text(errors="replace")
        )
    ]
    assert {"package.xml", "setup.py"} <= {name for name, _ in found}
    assert not [each for each in found if not each[1].endswith(PLACEHOLDERS)]


def anchors(path):
    """Return the anchors of a page's headings, as its readers on the web get them."""
    text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file_and_a_heading(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"\w+:", link):
            continue
        name, _, anchor = unquote(link).partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), link
        elif anchor:
            assert int(anchor.removeprefix("L")) <= len(target.read_text().splitlines()), link
