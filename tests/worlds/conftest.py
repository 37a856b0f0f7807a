"""SUMO allows one simulation per process: whoever opens a world here gets it closed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest


@pytest.fixture
def open_world() -> Iterator[Callable]:
    """Make SUMO worlds that are closed after the test, whatever happens in it."""
    from harness.worlds.sumo import SumoWorld

    with ExitStack() as worlds:
        yield lambda *arguments, **options: worlds.enter_context(closing(SumoWorld(*arguments, **options)))
