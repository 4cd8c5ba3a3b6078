"""Sphinx configuration: `make docs` builds the site into docs/_build."""

import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from generated import GENERATORS  # noqa: E402

NAME = re.compile(r"<name>(.*?)</name>\s*<version>(.*?)</version>")
project, release = NAME.search((DOCS.parent / "package.xml").read_text()).groups()
author = "slpi_ros maintainers"
project_copyright = f"{author}; Apache-2.0"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
highlight_language = "text"

# Docstrings are numpydoc with single backticks for names.
default_role = "code"
napoleon_google_docstring = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = f"{project} {release}"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]

# The line below a marker is for those who read the files.
MARKER = re.compile(r"^<!-- generated: ([\w-]+)(?: (.+?))? -->(?:\n\*In these files: .+\*)?$", re.MULTILINE)
UPWARDS = re.compile(r"\[([^\]]*)\]\((\.\./[\w./-]+)(#[\w-]+)?\)")


def expand(_app, docname, source):
    """Replace markers by what the code and the schemas say, and links out of docs/ by file names."""
    text = MARKER.sub(lambda found: GENERATORS[found[1]](*filter(None, [found[2]])), source[0])

    def link(found):
        path = ((DOCS / docname).parent / found[2]).resolve()
        if path.is_relative_to(DOCS):
            return found[0]
        name = str(path.relative_to(DOCS.parent))
        return found[1] if name in found[1] else f"{found[1]} (`{name}`)"

    source[0] = UPWARDS.sub(link, text)


def setup(app):
    """Connect the generators."""
    app.connect("source-read", expand)
