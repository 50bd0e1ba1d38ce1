"""The journal: whatever happens to its file, the records before are read, and no others."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibslam_backend.session.journal import MAGIC, Journal, JournalError, Record

RECORDS = [Record(1, b"camera"), Record(2, b""), Record(3, bytes(range(256)) * 20), Record(7, b"\0" * 9)]
HEADER = 9  # bytes before each payload


def write(path: Path, records: list[Record]) -> None:
    journal = Journal(path)
    for record in records:
        journal.append(record)
    journal.close()


def read(path: Path) -> list[Record]:
    journal = Journal(path)
    try:
        return list(journal.records())
    finally:
        journal.close()


def test_what_is_written_is_read_and_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "journal"
    write(path, RECORDS[:2])
    assert read(path) == RECORDS[:2]
    journal = Journal(path)
    assert (journal.found, journal.cut) == (2, 0)
    reading = journal.records()
    assert next(reading) == RECORDS[0]
    for record in RECORDS[2:]:
        journal.append(record)
    assert list(reading) == RECORDS[1:2]  # those that were there when it was opened
    journal.close()
    assert read(path) == RECORDS
    assert path.stat().st_size == len(MAGIC) + sum(HEADER + len(r.payload) for r in RECORDS)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_cut_or_changed_anywhere(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Records before the damage stay, and after it the journal can be gone on with."""
    path = tmp_path_factory.mktemp("damaged") / "journal"
    write(path, RECORDS)
    content = bytearray(path.read_bytes())
    ends = [len(MAGIC)]
    for record in RECORDS:
        ends.append(ends[-1] + HEADER + len(record.payload))
    at = data.draw(st.integers(len(MAGIC), len(content) - 1), label="at")
    if data.draw(st.booleans(), label="cut"):
        content = content[:at]
    else:
        content[at] ^= data.draw(st.integers(1, 255), label="bits")
    path.write_bytes(content)
    whole = sum(end <= at for end in ends[1:])
    journal = Journal(path)
    assert (journal.found, journal.cut) == (whole, len(content) - ends[whole])
    if journal.cut:
        assert Path(f"{path}.damaged").read_bytes() == content[ends[whole] :]
    journal.append(RECORDS[0])
    journal.close()
    assert read(path) == [*RECORDS[:whole], RECORDS[0]]


@pytest.mark.parametrize("content", [b"", MAGIC[:5], b"\0" * 10, MAGIC, MAGIC + b"\0" * 5000])
def test_a_journal_that_had_just_begun(tmp_path: Path, content: bytes) -> None:
    """Also one whose file grew by zeros, as files do when the power fails."""
    path = tmp_path / "journal"
    path.write_bytes(content)
    journal = Journal(path)
    assert journal.found == 0
    journal.append(RECORDS[0])
    journal.close()
    assert read(path) == RECORDS[:1]


def test_what_is_no_journal_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "thesis.txt"
    for content in (b"all of my work, and no journal", b"short"):
        path.write_bytes(content)
        with pytest.raises(JournalError, match=r"thesis\.txt is no journal"):
            Journal(path)
        assert path.read_bytes() == content
    for other in (tmp_path, Path("/dev/null"), path / "journal"):
        with pytest.raises(JournalError, match=r"cannot be opened|not an ordinary file"):
            Journal(other)


def test_one_process_at_a_time(tmp_path: Path) -> None:
    first = Journal(tmp_path / "journal")
    with pytest.raises(JournalError, match="another process"):
        Journal(tmp_path / "journal")
    first.restart(RECORDS)
    with pytest.raises(JournalError, match="another process"):
        Journal(tmp_path / "journal")
    first.close()
    assert read(tmp_path / "journal") == RECORDS


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """A disk that is full beyond so many bytes of a file."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk(tmp_path: Path) -> None:
    """A record that does not fit is not there; later ones are, once there is room."""
    path = tmp_path / "journal"
    journal = Journal(path)
    journal.append(RECORDS[0])
    with largest_file(len(MAGIC) + 100):
        with pytest.raises(OSError):
            journal.append(RECORDS[2])
        assert path.stat().st_size > len(MAGIC) + HEADER + len(RECORDS[0].payload)  # a part of it was written
        journal.append(RECORDS[1])
        with pytest.raises(OSError):
            journal.restart(RECORDS)
    journal.append(RECORDS[3])
    journal.close()
    assert read(path) == [RECORDS[0], RECORDS[1], RECORDS[3]]
    assert not (tmp_path / "journal.part").exists()


def test_beginning_anew(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    write(path, RECORDS)
    journal = Journal(path)
    journal.restart(RECORDS[2:3])
    journal.append(RECORDS[0])
    journal.close()
    assert read(path) == [RECORDS[2], RECORDS[0]]
