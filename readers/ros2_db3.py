"""The SQLite storage of ROS 2 bags, one ``.db3`` file.

A sound database is read through SQLite, which is kept from writing anything beside it. Where a write-ahead log or a
journal was left beside it, all are copied to a temporary folder and SQLite merges them there. What SQLite cannot read
is read page by page, see `readers.sqlite_pages`.
"""

from __future__ import annotations

import bisect
import contextlib
import mmap
import re
import shutil
import sqlite3
import struct
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from functools import partial
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.parse import quote

from readers.index_cache import Entry
from readers.index_states import Counted, db3_counted, db3_state
from readers.message_log import Channel, Message, MessageLog, Source, escaped, text
from readers.salvage import Cause, Loss, Tally
from readers.sqlite_pages import BrokenRowError, Pages, Row
from readers.streams import RecordingError

_FLOAT, _BLOB, _TEXT = 7, 12, 13
_MESSAGE_COLUMNS = 4
_LOG_HEAD, _LOG_FRAME = struct.Struct(">8I"), struct.Struct(">6I")
_LOG_MAGICS = (0x377F0682, 0x377F0683)
_LATEST_NS = 2**63 - 1
UNKNOWN_TOPIC = "(topic unknown)"
_TYPE = re.compile(r"\w+/(?:\w+/)?\w+")


class Found(NamedTuple):
    """A message in a page of a damaged database; found rows sort by time, then by number."""

    log_ns: int
    number: int
    topic: int
    row: Row


class SqliteLog(MessageLog):
    """One ``.db3`` file of a ROS 2 bag.

    Raises:
        RecordingError: no database of a ROS 2 bag, or one of which nothing can be read.
    """

    def __init__(self, path: Path, cached: Entry | None = None) -> None:
        super().__init__(path, "ROS 2 bag, sqlite3", cached)
        self._by_id: dict[int, Channel] = {}
        self._copy: TemporaryDirectory[str] | None = None
        self._readable = path
        self._pages: Pages | None = None
        self._found: list[Found] = []
        self._table = "messages"
        self._size = path.stat().st_size
        self._database = self._connect()
        try:
            self._list_channels()
        except BaseException:
            self.close()
            raise

    def _harm(self, cause: Cause, sentence: str, **known: Any) -> None:
        self.lose(Loss(what=cause, text=sentence, file_bytes=self._size, **known))

    # ---------------------------------------------------------------------------- a sound one

    def _connect(self) -> sqlite3.Connection:
        beside = [self.path.with_name(self.path.name + end) for end in ("-wal", "-journal")]
        pending = [file for file in beside if file.is_file() and file.stat().st_size > 0]
        if not pending:
            uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
            return sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._copy = TemporaryDirectory(prefix="workbench-")
        self._readable = Path(self._copy.name) / self.path.name
        for file in (self.path, *pending):
            shutil.copyfile(file, self._readable.with_name(file.name))
        self.notes.append(
            f"{pending[0].name} lies beside the database; both were copied and merged in a temporary folder."
        )
        database = sqlite3.connect(self._readable, check_same_thread=False)
        if pending[0].name.endswith("-wal"):
            self._judge_log(database)
        return database

    def _judge_log(self, database: sqlite3.Connection) -> None:
        """Merge the copy of a write-ahead log, and say what of it SQLite does not take, which it keeps to itself."""
        path = self._readable.with_name(self._readable.name + "-wal")
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as log:
            size, written = len(log), frames_of(log)
        try:
            _, _, taken = database.execute("PRAGMA wal_checkpoint").fetchone()
        except sqlite3.DatabaseError:
            return  # the database itself is damaged, which is told where it is read
        if taken < 0:
            self.notes.append("The database is of a kind that has no write-ahead log; the one beside it is not read.")
        elif written < 0:
            self._harm(Cause.CUT, f"the write-ahead log of {size} bytes is damaged and cannot be merged")
        elif taken < written:
            words = f"the last {written - taken} of {written} pages in the write-ahead log were not completed"
            self._harm(Cause.CUT, f"{words} or are damaged; what they hold is lost")

    _SUM = "sum(timestamp % 1000003 * (id % 1009))"
    _COUNT = (
        "SELECT topic_id, typeof(timestamp) = 'integer', data IS NULL, count(*),"
        f" min(timestamp), max(timestamp), {_SUM} FROM messages GROUP BY 1, 2, 3"
    )

    def _cut(self) -> str:
        """How the file is too short for the pages that it states, which SQLite fills with zeros; "" if it is not."""
        with self.path.open("rb") as file:
            pages = Pages(memoryview(file.read(100)))
        whole = self._size % pages.page_bytes == 0 and pages.stated * pages.page_bytes <= self._size
        return "" if whole or self._copy is not None else "the file is cut off"

    def _list_channels(self) -> None:
        if fault := self._cut():
            with contextlib.suppress(sqlite3.DatabaseError, RecordingError, UnicodeDecodeError, TypeError):
                self._database.execute("PRAGMA writable_schema = ON")
                self._read_tables()
            self._read_pages(fault, listed=False)
            return
        try:
            self._read_tables()
            counted, fault = self._counts()
        except (sqlite3.DatabaseError, UnicodeDecodeError, TypeError) as error:
            self._read_pages(str(error), listed=False)
            return
        if fault:
            self._read_pages(fault, listed=False)
            return
        strangers = 0
        for number, timed, empty, count, first_ns, last_ns, _ in counted:
            channel = self._by_id.get(number)
            if channel is None:
                strangers += count
            elif not timed or empty:
                what = "no data" if timed else "no number as time"
                topics = {channel.topic: Tally(undecodable=count)}
                self._harm(Cause.SCHEMA, f"{count} messages have {what} and are left out", topics=topics)
            else:
                channel.count, channel.first_ns, channel.last_ns = count, first_ns, last_ns
        self._judge_strangers(strangers)

    def _index_fault(self, messages: int, total: int) -> str:
        """Compare the index of times with the table: its number of `messages`, and their `total` by `_SUM`.

        An index that differs is not used; one that has more messages than the table is a fault of that, told in words.
        """
        listed = self._database.execute("SELECT name FROM pragma_index_list('messages') WHERE NOT partial")
        columns = "SELECT name FROM pragma_index_info(?)"
        names = [n for (n,) in list(listed) if [c for (c,) in self._database.execute(columns, (n,))] == ["timestamp"]]
        for index in names:
            quoted = index.replace('"', '""')
            try:
                query = f'SELECT count(*), {self._SUM} FROM messages INDEXED BY "{quoted}"'
                count, found = self._database.execute(query).fetchone()
            except sqlite3.DatabaseError:
                count, found = 0, None
            if count > messages:
                return f"the index of times names {count} messages, the table holds {messages}"
            if (count, found or 0) != (messages, total):
                self._table = "messages NOT INDEXED"
                self._harm(Cause.ORDER, "the index of times differs from the messages, which are read without it")
        return ""

    def _counts(self) -> tuple[Counted, str]:
        """What `_COUNT` gives, and the fault of the index of times; "" for none.

        Both take a pass over all rows, so the answer is kept, but not of an index that differs from the table, nor
        where a log lies beside.
        """
        found: Counted = []
        if self._copy is not None:
            self.cached = None
        if self.recall(lambda state: found.extend(db3_counted(state))):
            return found, ""
        begun = time.perf_counter()
        found = list(self._database.execute(self._COUNT))
        fault = self._index_fault(sum(row[3] for row in found), sum(row[-1] or 0 for row in found))
        if not fault and self._table == "messages":
            self.keep(lambda: db3_state(found), time.perf_counter() - begun)
        return found, fault

    def _judge_strangers(self, count: int) -> None:
        if count:
            words = f"{count} messages are of topics that the database does not describe"
            self._harm(Cause.SCHEMA, words, topics={UNKNOWN_TOPIC: Tally(withheld=count)})

    def _read_tables(self) -> None:
        tables = {row[0] for row in self._database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise RecordingError(
                self.path, "the database has no tables topics and messages", "give the .db3 file of a ROS 2 bag"
            )
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (encoding, source) for name, encoding, source in self._database.execute(query)}
        query = "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        self._describe(self._database.execute(query), definitions)

    def _describe(self, topics: Iterable[tuple[Any, ...]], definitions: dict[str, tuple[str, str]]) -> None:
        for number, topic, kind, encoding in topics:
            schema_encoding, schema = definitions.get(kind, ("", ""))
            self._by_id[number] = Channel(
                topic=escaped(_word(topic)),
                type=escaped(_word(kind)),
                encoding=escaped(_word(encoding)),
                schema_encoding=escaped(_word(schema_encoding)),
                schema=_word(schema).encode(),
            )
        self.channels = list(self._by_id.values())

    # -------------------------------------------------------------------------------- reading

    def sources(
        self, channels: Collection[Channel], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterable[Source]:
        """One source for the whole database."""
        numbers = [number for number, channel in self._by_id.items() if channel in channels and channel.count]
        if not numbers:
            return
        first_ns = min(self._by_id[number].first_ns for number in numbers)
        last_ns = max(self._by_id[number].last_ns for number in numbers)
        start_ns = first_ns if start_ns is None else max(start_ns, first_ns)
        stop_ns = last_ns + 1 if stop_ns is None else min(stop_ns, last_ns + 1)
        if start_ns < stop_ns:
            read = self._sound if self._pages is None else self._salvaged
            yield Source(start_ns, partial(read, numbers, start_ns, stop_ns))

    def _query(self, columns: str, numbers: Collection[int]) -> str:
        """A query for messages of some topics in a range of time; the plain one lets SQLite skip other rows soonest."""
        which = "" if len(numbers) == len(self._by_id) else f"topic_id IN ({', '.join('?' * len(numbers))}) AND "
        return (
            f"SELECT {columns} FROM {self._table} WHERE {which}timestamp >= ? AND timestamp <= ?"
            " AND typeof(timestamp) = 'integer' AND data IS NOT NULL"
        )

    def _arguments(self, numbers: Collection[int], start_ns: int, stop_ns: int) -> list[int]:
        return [*(() if len(numbers) == len(self._by_id) else numbers), start_ns, min(stop_ns - 1, _LATEST_NS)]

    def _sound(self, numbers: list[int], start_ns: int, stop_ns: int) -> Iterator[Message]:
        """The messages in the order of time; from where SQLite gives up, what their pages still hold."""
        query = self._query("id, topic_id, timestamp, data", numbers) + " ORDER BY timestamp, id"
        last, channel_of, new = (start_ns, -1), self._by_id.get, tuple.__new__
        try:
            for row, number, log_ns, data in self._database.execute(query, self._arguments(numbers, start_ns, stop_ns)):
                last = log_ns, row
                if (channel := channel_of(number)) is not None:
                    stored = data if type(data) is bytes else str(data).encode()
                    yield new(Message, (log_ns, channel, stored, -1, -1))
            return
        except sqlite3.DatabaseError as error:
            self._read_pages(str(error))
        yield from self._salvaged(numbers, start_ns, stop_ns, last)

    def count_before(self, channels: Collection[Channel], stop_ns: int) -> int:
        """How many messages of `channels` were logged before `stop_ns`."""
        numbers = [number for number, channel in self._by_id.items() if channel in channels]
        if self._pages is None:
            try:
                query = self._query("count(*)", numbers)
                count: int = self._database.execute(query, self._arguments(numbers, -(2**63), stop_ns)).fetchone()[0]
                return count
            except sqlite3.DatabaseError as error:
                self._read_pages(str(error))
        return sum(found.topic in numbers for found in self._found[: bisect.bisect_left(self._found, (stop_ns,))])

    # ------------------------------------------------------------------------------- a damaged one

    def _read_pages(self, fault: str, *, listed: bool = True) -> None:
        """List the messages that the pages of the file still hold, and count those that are known to be lost.

        Counts and times of the channels are taken from them if they are not `listed` already.
        """
        if self._pages is not None:
            return
        if self._copy is not None:
            self._merge()
        with self._readable.open("rb") as file:
            pages = Pages(memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)))
        rows = list(pages.rows())
        if not self._by_id:
            self._describe(*_tables(pages, rows))
        self._pages = pages
        self._found, lost = self._find(pages, rows)
        if not self._found and not listed:
            cure = "recover it with sqlite3's .recover command"
            raise RecordingError(self.path, f"no message of the database can be read ({fault})", cure)
        if not listed:
            for message in self._found:
                self._by_id[message.topic].note(message.log_ns)
        self._judge_pages(fault, lost)

    def _find(self, pages: Pages, rows: Iterable[Row]) -> tuple[list[Found], dict[int, Found]]:
        """The messages among the rows in the order of time, and by row number those that are not whole."""
        found: dict[int, Found] = {}
        broken: dict[int, Found] = {}
        strangers = 0
        for row in rows:
            message = _message(pages, row)
            if message is None:
                continue
            if message.topic not in self._by_id:
                strangers += 1
            elif pages.is_whole(row):
                found.setdefault(row.number, message)
            else:
                broken[row.number] = message
        self._judge_strangers(strangers)
        lost = {number: message for number, message in broken.items() if number not in found}
        return sorted(found.values(), key=lambda one: one[:2]), lost

    def _judge_pages(self, fault: str, lost: dict[int, Found]) -> None:
        assert self._pages is not None
        expected, have = self._pages.stated * self._pages.page_bytes, self._size
        topics = {
            c.topic: Tally(lost=n) for i, n in Counter(m.topic for m in lost.values()).items() if (c := self._by_id[i])
        }
        numbers = {message.number for message in self._found} | lost.keys()
        gaps = max(max(numbers, default=0), self._pages.largest_key()) - len(numbers)
        if gaps > 0:
            topics[UNKNOWN_TOPIC] = Tally(lost=gaps)
        words = f"{len(self._found)} messages could be read, {len(lost) + max(gaps, 0)} are known to be lost: {fault}"
        if expected > have:
            loss = Loss(what=Cause.CUT, text=words, start=have, stop=expected, file_bytes=expected, topics=topics)
            self.lose(loss)
        else:
            self._harm(Cause.CUT, words, topics=topics)

    def _salvaged(
        self, numbers: Collection[int], start_ns: int, stop_ns: int, after: tuple[int, int] = (-(2**63), -1)
    ) -> Iterator[Message]:
        """The messages that lie in the pages, from those on that come after a time and row number."""
        assert self._pages is not None
        for found in self._found:
            if found.topic in numbers and start_ns <= found.log_ns < stop_ns and found[:2] > after:
                yield Message(found.log_ns, self._by_id[found.topic], _data(self._pages, found.row))

    def _merge(self) -> None:
        """Bring what the write-ahead log holds into the copy of the database, as far as that can be done."""
        try:
            self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        except sqlite3.DatabaseError:
            self.notes.append("The write-ahead log could not be merged; what it alone holds is not read.")

    def close(self) -> None:
        """Release the database and the temporary copy, if there is one."""
        self._database.close()
        self._found = []
        if self._copy is not None:
            self._copy.cleanup()


def frames_of(log: mmap.mmap) -> int:
    """How many pages were written to a write-ahead log, the last of which may be cut; -1 if it is none.

    Pages of an earlier use of it, behind those, have other salts. https://sqlite.org/fileformat2.html, section 4.1.
    """
    if len(log) < _LOG_HEAD.size:
        return -1
    magic, _, page_bytes, _, *salts = _LOG_HEAD.unpack_from(log)[:6]
    if magic not in _LOG_MAGICS or not 512 <= page_bytes <= 65536:
        return -1
    places = range(_LOG_HEAD.size, len(log), _LOG_FRAME.size + page_bytes)
    mine = (list(_LOG_FRAME.unpack_from(log, at)[2:4]) == salts for at in places if at + _LOG_FRAME.size <= len(log))
    return sum(takewhile(bool, mine))


def _word(value: object) -> str:
    """A value that should be a text; SQLite takes any other for one, too."""
    return text(value) if isinstance(value, bytes) else str(value)


def _message(pages: Pages, row: Row) -> Found | None:
    """The row as one of the table of messages (number, topic, time, data); None if it is none."""
    serials = [column.serial for column in row.columns]
    if len(serials) != _MESSAGE_COLUMNS or serials[-1] < _BLOB:
        return None
    if row.columns[2].stop > row.local or not all(0 < s < _BLOB and s != _FLOAT for s in serials[1:3]):
        return None
    topic, log_ns = pages.value(row, 1), pages.value(row, 2)
    return Found(log_ns, row.number, topic, row) if isinstance(log_ns, int) and isinstance(topic, int) else None


def _data(pages: Pages, row: Row) -> memoryview:
    column = row.columns[-1]
    return pages.payload(row)[column.start : column.stop]


def _tables(pages: Pages, rows: Iterable[Row]) -> tuple[list[tuple[Any, ...]], dict[str, tuple[str, str]]]:
    """The topics (number, name, type, format), and the definitions (encoding, text) by type, among the rows.

    They are told by their form: at least three texts, the second of which is a type, or the name of an encoding.
    """
    topics: list[tuple[Any, ...]] = []
    definitions: dict[str, tuple[str, str]] = {}
    for row in rows:
        if len(row.columns) < _MESSAGE_COLUMNS or any(c.serial < _TEXT or c.serial % 2 == 0 for c in row.columns[1:4]):
            continue
        try:
            one, two, three = (str(pages.value(row, column)) for column in (1, 2, 3))
        except BrokenRowError:
            continue
        if two.startswith("ros2"):
            definitions[one] = (two, three)
        elif _TYPE.fullmatch(two) and all(row.number != topic[0] for topic in topics):
            topics.append((row.number, one, two, three))
    return sorted(topics), definitions
