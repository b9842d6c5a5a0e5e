"""The fuzz of the readers: it sees what it is there for, and a few of its mutants; `.ci/run` lets it go on for 30 s."""

import dataclasses
import random
from collections import Counter
from pathlib import Path

import fuzz_readers
import pytest
from fuzz_readers import SUBJECTS, Bench, Outcome, checked, counted, fuzz, mutated, only_true_pictures, outlines

from readers import Recording


def test_the_first_mutants_of_every_subject_are_borne(tmp_path: Path) -> None:
    report = fuzz(SUBJECTS, 1, range(3), 60.0, tmp_path)
    assert report.faults == {}
    assert report.counts == {subject.name: 3 for subject in SUBJECTS}


def test_a_mutant_is_the_same_every_time_and_differs_from_the_others(tmp_path: Path) -> None:
    bench = Bench(SUBJECTS[0], tmp_path)
    assert bench.mutant(1, 5) == bench.mutant(1, 5)
    assert len({bench.mutant(seed, number)[1] for seed in (1, 2) for number in range(20)}) > 35
    assert mutated(b"", random.Random(1)) == b""


def test_the_judge_sees_wrong_data_and_silent_loss() -> None:
    both, one = Counter([("/a", 1, b"x"), ("/a", 2, b"y")]), Counter([("/a", 1, b"x")])
    sound, false = Outcome(both, False, ""), Counter([("/a", 1, b"x"), ("/a", 2, b"z")])
    for verdict in (checked, outlines, counted, only_true_pictures):
        assert verdict(sound, sound) == ""
        assert "without a word" in verdict(Outcome(one, False, ""), sound)
        assert verdict(Outcome(one, True, ""), sound) == ""
    assert "never written" in checked(Outcome(false, True, ""), sound)
    assert checked(Outcome(false, True, "read without a checksum"), sound) == ""


def test_errors_of_others_and_slowness_are_faults_and_the_sound_file_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(SUBJECTS[0], tmp_path / "one")
    sound = {path: path.read_bytes() for path in bench.files}
    path, data = bench.mutant(1, 0)
    monkeypatch.setattr(fuzz_readers, "CPU_S", 0.0)
    assert "s of CPU" in bench.fault(path, data)

    def broken(recording: Recording) -> Outcome:
        raise KeyError(recording.path.name)

    monkeypatch.setattr(fuzz_readers, "CPU_S", 5.0)
    bench.subject = dataclasses.replace(bench.subject, read=broken)
    assert bench.fault(path, sound[path]) == "KeyError: 'a.mcap'"
    assert {path: path.read_bytes() for path in bench.files} == sound
