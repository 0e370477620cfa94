"""Checks the messages and attributes of expected errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from vkc_pin.errors import InputError


@contextmanager
def expect_error(match: str | None = None, **attributes: object) -> Iterator[None]:
    """Expect an `InputError` with a message that matches, and with given attributes.

    Only an `UnknownNameError` has `nearest` and `choices`.
    """
    with pytest.raises(InputError, match=match) as caught:
        yield
    found = {name: getattr(caught.value, name) for name in attributes}
    assert found == attributes, str(caught.value)
