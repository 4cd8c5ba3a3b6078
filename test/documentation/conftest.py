"""A reader of the pages, for the tests that follow them."""

import pytest
from documentation.pages import Reader


@pytest.fixture
def reader(tmp_path, installed):
    """Return a reader in an empty folder."""
    installed("compensator")
    reader = Reader(tmp_path)
    yield reader
    reader.close()
