"""Cuts, flips and random mutations of MCAP files; all of them: ``python tests/mcap_mutations.py``.

WORKBENCH_EVERY_BYTE=1 tries every byte, WORKBENCH_FUZZ_S sets the seconds of the random mutations, WORKBENCH_FUZZ_SEED
their seed.
"""

import os
from pathlib import Path

import pytest
from mcap_mutations import CODECS, Small, cuts, flips, mutations, outcomes, small_log

STEP = 1 if os.environ.get("WORKBENCH_EVERY_BYTE") else 29
FUZZ_S = float(os.environ.get("WORKBENCH_FUZZ_S", "5"))
SEED = int(os.environ.get("WORKBENCH_FUZZ_SEED", "1"))
FINE = {"", "reported loss", "refused", "flagged wrong data"}


@pytest.fixture(scope="module", params=CODECS)
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Small:
    return small_log(tmp_path_factory.mktemp("small") / "a.mcap", request.param)


def test_every_cut_gives_only_what_was_written_and_is_said(tmp_path: Path, small: Small) -> None:
    found = outcomes(tmp_path / "a.mcap", small, cuts(small, STEP), torn=True)
    assert set(found) <= {"", "reported loss"}
    assert found[""] > 0


def test_every_flip_gives_only_what_was_written_and_no_loss_is_silent(tmp_path: Path, small: Small) -> None:
    found = outcomes(tmp_path / "a.mcap", small, flips(small, STEP))
    assert set(found) <= {"", "reported loss"}
    assert found[""] > 0.2 * found.total()


def test_random_mutations_raise_nothing_and_lose_nothing_silently(tmp_path: Path, small: Small) -> None:
    found = outcomes(tmp_path / "a.mcap", small, mutations(small, SEED, FUZZ_S / len(CODECS)))
    assert set(found) <= FINE, found
    assert found.total() > 5


def test_the_judge_sees_wrong_data_and_silent_loss(tmp_path: Path, small: Small) -> None:
    path = tmp_path / "a.mcap"
    fewer = Small(small.data, small.keys[:-1])
    more = Small(small.data, [*small.keys, ("/a", 1, b"")])
    assert outcomes(path, fewer, [small.data]) == {"WRONG DATA": 1}
    assert outcomes(path, more, [small.data]) == {"SILENT LOSS": 1}
