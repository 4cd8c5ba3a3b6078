"""The schemas say of effects what the effects say of themselves."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

from make_schemas import GENERATED, SCHEMAS, read, text  # noqa: E402


@pytest.mark.parametrize("name", GENERATED)
def test_schemas_are_generated_from_the_facts_of_effects(name):
    stored = (SCHEMAS / f"{name}.schema.json").read_text()
    assert stored == text(GENERATED[name](read(stored))) + "\n", "run make schemas"
