"""What a refusal owes the user: one line that names the file or option, and what to do."""

from collections.abc import Callable
from typing import Any

import pytest


def refused(kind: type[Exception], words: str, call: Callable[..., Any], *given: Any, **named: Any) -> str:
    """Check that a call is refused in one line that has the words, which ` ... ` separates; return it."""
    with pytest.raises(kind) as caught:
        call(*given, **named)
    line = str(caught.value)
    assert "\n" not in line and all(part in line for part in words.split(" ... ")), line
    return line
