"""Cuts and flips of MCAP files; WORKBENCH_EVERY_BYTE=1 tries every byte."""

import os
from pathlib import Path

import pytest
from mcap_mutations import CODECS, Small, cuts, flips, outcomes, small_log

STEP = 1 if os.environ.get("WORKBENCH_EVERY_BYTE") else 29


@pytest.fixture(scope="module", params=CODECS)
def small(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Small:
    return small_log(tmp_path_factory.mktemp("small") / "a.mcap", request.param)


@pytest.mark.parametrize("codec", CODECS)
def test_cuts_and_flips_of_a_file_without_an_index_lose_nothing_in_silence(tmp_path: Path, codec: str) -> None:
    bare = small_log(tmp_path / "a.mcap", codec, index=False)
    kinds = [
        bare.data[:at] + bytes([bare.data[at] ^ 1 << bit]) + bare.data[at + 1 :] for at in (33,) for bit in range(8)
    ]
    for files, torn in ((cuts(bare, STEP), True), (flips(bare, STEP), False), (kinds, False)):
        found = outcomes(tmp_path / "a.mcap", bare, files, torn=torn)
        assert set(found) <= {"", "reported loss"}
        assert found[""] > 0


def test_every_cut_gives_only_what_was_written_and_is_said(tmp_path: Path, small: Small) -> None:
    found = outcomes(tmp_path / "a.mcap", small, cuts(small, STEP), torn=True)
    assert set(found) <= {"", "reported loss"}
    assert found[""] > 0


def test_every_flip_gives_only_what_was_written_and_no_loss_is_silent(tmp_path: Path, small: Small) -> None:
    found = outcomes(tmp_path / "a.mcap", small, flips(small, STEP))
    assert set(found) <= {"", "reported loss"}
    assert found[""] > 0.2 * found.total()


def test_the_judge_sees_wrong_data_and_silent_loss(tmp_path: Path, small: Small) -> None:
    path = tmp_path / "a.mcap"
    fewer = Small(small.data, small.keys[:-1])
    more = Small(small.data, [*small.keys, ("/a", 1, b"")])
    assert outcomes(path, fewer, [small.data]) == {"WRONG DATA": 1}
    assert outcomes(path, more, [small.data]) == {"SILENT LOSS": 1}
