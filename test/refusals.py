"""How a call is refused: the type of the error, in one line, with the data that tell one case from another."""

import re
from collections.abc import Callable
from typing import Any

import pytest


def refusal(kind: type[Exception], call: Callable[..., Any], *args: Any, **kwargs: Any) -> str:
    """Return the one line with which a call refuses by exactly this type of error."""
    with pytest.raises(kind) as caught:
        call(*args, **kwargs)
    assert caught.type is kind
    message = str(caught.value)
    assert message and "\n" not in message
    return message


def holds(message: str, *data: object) -> bool:
    """Return whether each value, name, path or command stands in a message, and not as a part of a longer word."""
    return all(re.search(rf"(?<!\w){re.escape(str(one))}(?!\w)", message) for one in data)
