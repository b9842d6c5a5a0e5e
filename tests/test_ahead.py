"""Blocks unpacked ahead: in order, bounded, errors where they are asked for, nothing after the end."""

import threading
import time
from concurrent.futures import Future

import pytest

from readers.ahead import AHEAD_BLOCKS, AHEAD_BYTES, Ahead, settle


def test_every_block_comes_once_and_no_more_are_begun_than_allowed() -> None:
    begun: list[int] = []
    ahead = Ahead(lambda key: begun.append(key) or key * 10, [(key, 1000) for key in range(20)], 0.0)  # type: ignore[func-returns-value]
    assert ahead.take(0) == 0
    assert begun == [0]
    for key in range(1, 20):
        assert ahead.take(key) == key * 10
        assert max(begun) <= key + AHEAD_BLOCKS
    assert sorted(begun) == list(range(20))


def test_large_blocks_are_not_heaped_up() -> None:
    begun: list[int] = []
    lock = threading.Lock()

    def load(key: int) -> int:
        with lock:
            begun.append(key)
        return key

    ahead = Ahead(load, [(key, AHEAD_BYTES) for key in range(6)], 0.0)
    for key in range(4):
        assert ahead.take(key) == key
        assert max(begun) <= key + 1


def test_an_error_comes_out_where_its_block_is_asked_for() -> None:
    def load(key: int) -> int:
        if key == 3:
            raise ValueError("three")
        return key

    ahead = Ahead(load, [(key, 1) for key in range(6)], 0.0)
    assert [ahead.take(key) for key in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        ahead.take(3)
    assert [ahead.take(5), ahead.take(4)] == [5, 4]


def test_nothing_runs_after_stop() -> None:
    running: list[int] = []

    def load(key: int) -> int:
        running.append(key)
        time.sleep(0.02)
        running.remove(key)
        return key

    ahead = Ahead(load, [(key, 1) for key in range(10)], 0.0)
    ahead.take(0)
    ahead.take(1)
    ahead.stop()
    assert running == []
    time.sleep(0.05)
    assert running == []


@pytest.mark.parametrize(("pause_s", "ahead_too"), [(60.0, False), (0.02, True)])
def test_blocks_are_begun_only_where_there_is_work_to_hide_them_behind(pause_s: float, ahead_too: bool) -> None:
    ahead = Ahead(lambda key: threading.get_ident(), [(key, 1) for key in range(6)], pause_s)
    ahead.take(0)
    time.sleep(0.03)
    ahead.take(1)
    assert (ahead.take(2) != threading.get_ident()) is ahead_too
    ahead.stop()


def test_who_looks_at_the_first_blocks_alone_has_no_other_unpacked() -> None:
    begun: list[int] = []
    ahead = Ahead(lambda key: begun.append(key), [(key, 1) for key in range(9)], 0.0, after=3)  # type: ignore[func-returns-value]
    for key in range(3):
        ahead.take(key)
    time.sleep(0.05)
    assert begun == [0, 1, 2]
    ahead.take(3)
    ahead.take(4)
    ahead.stop()
    assert max(begun) > 4


def test_what_was_given_up_half_way_is_settled_before_the_file_is_closed() -> None:
    slow, done = threading.Event(), []

    def load(key: str) -> str:
        slow.wait(0.01 if key in "ab" else 0.3)
        done.append(key)
        return key

    running: set[Future[str]] = set()
    keys = list("abcdefgh")
    ahead = Ahead(load, [(key, 1) for key in keys], 0.0, running)
    ahead.take(keys[0])
    ahead.take(keys[1])
    assert running
    del ahead
    settle(running)
    count = len(done)
    assert not running
    slow.set()
    time.sleep(0.05)
    assert len(done) == count  # nothing goes on behind the back of who closed the file
