"""What all tests share."""

import os
import tempfile
from collections.abc import Iterator

import pytest
from command_line import Shell, caller


@pytest.fixture(autouse=True, scope="session")
def _cache_of_its_own() -> Iterator[None]:
    """No test reads or writes the cache of the user's own logs; processes that tests start do not either."""
    with tempfile.TemporaryDirectory(prefix="workbench-cache-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setitem(os.environ, "WORKBENCH_CACHE", folder)
        yield


@pytest.fixture
def shell(capfd: pytest.CaptureFixture[str]) -> Shell:
    """Runs a command line; exit status, stdout, stderr."""
    return caller(capfd)


@pytest.fixture(scope="session", autouse=True)
def _compiled(worker_id: str) -> None:
    """Where two processes test, each compiles other kernels first: whoever comes to them later finds them compiled."""
    if worker_id == "gw0":
        _odometry_steps()
    elif worker_id == "gw1":
        import semidirect_flights

        semidirect_flights.flight(24)


def _odometry_steps() -> None:
    """A few steps of the correlation odometry with each preset."""
    import numpy as np
    from semidirect_flights import flown, sample

    from pipelines.correlation.odometry import CorrelationOdometry
    from pipelines.correlation.settings import CorrelationSettings

    ground = np.random.default_rng(0).integers(0, 255, (260, 340), np.uint8)
    frames = [sample(np.ascontiguousarray(ground[:240, 2 * k : 320 + 2 * k]), k) for k in range(4)]
    for preset in CorrelationSettings.presets():
        settings = CorrelationSettings.preset(preset).model_copy(update={"metres_per_px": 1e-3})
        flown(CorrelationOdometry(settings), frames)
