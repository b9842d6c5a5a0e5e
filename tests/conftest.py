"""What all tests share."""

import os
import tempfile
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="session")
def _cache_of_its_own() -> Iterator[None]:
    """No test reads or writes the cache of the user's own logs; processes that tests start do not either."""
    with tempfile.TemporaryDirectory(prefix="workbench-cache-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "WORKBENCH_CACHE", folder)
        yield
