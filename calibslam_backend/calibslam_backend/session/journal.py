"""A file of records that a process which is killed leaves readable: each is whole, or not there.

    magic, then for each record: kind (1 byte), length (4 bytes), CRC-32 of kind, length and payload (4 bytes), payload

Numbers are little-endian. A record is with the operating system before `append` returns, so that the end of the process
loses none of them; a loss of power may take those of the last seconds.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

MAGIC = b"calibslam journal 1\n"
_HEADER = struct.Struct("<BII")
_CHECKED = struct.Struct("<BI")
LONGEST = 1 << 28  # bytes of a payload


class JournalError(ValueError):
    """A file that cannot be used as a journal; the text names it and what to do."""


@dataclass(frozen=True)
class Record:
    """Something that happened: what kind of thing (1 to 255), and its content."""

    kind: int
    payload: bytes = b""

    def encode(self) -> bytes:
        """As it stands in the file."""
        size = len(self.payload)
        crc = zlib.crc32(self.payload, zlib.crc32(_CHECKED.pack(self.kind, size)))
        return _HEADER.pack(self.kind, size, crc) + self.payload


class Journal:
    """An open journal, written by one process at a time.

    Attributes:
        path: the file.
        found: whole records in it when it was opened.
        cut: bytes behind the last whole record that were cut off then, and are kept in `PATH.damaged`.
    """

    def __init__(self, path: Path) -> None:
        """Open or begin one.

        Raises:
            JournalError: it cannot be opened, is no journal, or another process writes it.
        """
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, 0o644)
        except OSError as error:
            raise JournalError(f"journal {path} cannot be opened: {error.strerror}") from None
        try:
            self._lock(self._file)
            self.found, self._end = self._scan()
            self.cut = self._cut_off()
        except BaseException:
            os.close(self._file)
            raise
        self._found_end = self._end

    def _lock(self, file: int) -> None:
        if not stat.S_ISREG(os.fstat(file).st_mode):
            raise JournalError(f"journal {self.path} is not an ordinary file")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise JournalError(f"journal {self.path} is being written by another process") from None

    def _scan(self) -> tuple[int, int]:
        """Number of whole records and the place [byte] where they end."""
        size = os.fstat(self._file).st_size
        if size < len(MAGIC):
            beginning = os.pread(self._file, size, 0)
            if not MAGIC.startswith(beginning) and beginning.strip(b"\0"):
                raise JournalError(f"{self.path} is no journal: name another file, or move it away")
            os.pwrite(self._file, MAGIC, 0)
            return 0, len(MAGIC)
        if os.pread(self._file, len(MAGIC), 0) != MAGIC:
            raise JournalError(f"{self.path} is no journal of this version: name another file, or move it away")
        ends = [end for _, end in self._read(size)]
        return len(ends), max(ends, default=len(MAGIC))

    def _read(self, size: int) -> Iterator[tuple[Record, int]]:
        """Whole records in the first `size` bytes, each with the place where it ends."""
        at = len(MAGIC)
        while at + _HEADER.size <= size:
            kind, length, crc = _HEADER.unpack(os.pread(self._file, _HEADER.size, at))
            end = at + _HEADER.size + length
            if kind == 0 or length > LONGEST or end > size:
                return
            payload = os.pread(self._file, length, at + _HEADER.size)
            if zlib.crc32(payload, zlib.crc32(_CHECKED.pack(kind, length))) != crc:
                return
            yield Record(kind, payload), end
            at = end

    def _cut_off(self) -> int:
        size = os.fstat(self._file).st_size
        if size > self._end:
            with open(self.path, "rb") as file, open(f"{self.path}.damaged", "wb") as kept:
                file.seek(self._end)
                shutil.copyfileobj(file, kept)
            os.ftruncate(self._file, self._end)
        return max(size - self._end, 0)

    def records(self) -> Iterator[Record]:
        """Those that were there when it was opened; appending meanwhile does no harm."""
        for record, _ in self._read(self._found_end):
            yield record

    def append(self, record: Record) -> None:
        """Write one record.

        Raises:
            OSError: it could not be written, and is not in the journal; the next one may be.
        """
        self._end += _write(self._file, record.encode(), self._end)

    def restart(self, records: Iterable[Record]) -> None:
        """Replace all records by these, in one step.

        Raises:
            OSError: it could not be written; the old records stay.
        """
        part = self.path.with_name(self.path.name + ".part")
        file = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            self._lock(file)
            end = _write(file, MAGIC + b"".join(record.encode() for record in records), 0)
            os.fsync(file)
            os.replace(part, self.path)
        except BaseException:
            os.close(file)
            part.unlink(missing_ok=True)
            raise
        os.close(self._file)
        self._file, self._end, self._found_end, self.found = file, end, len(MAGIC), 0

    def close(self) -> None:
        """Have the disk take everything, and let another process write."""
        try:
            os.fsync(self._file)
        finally:
            os.close(self._file)


def _write(file: int, data: bytes, at: int) -> int:
    """Write all of it at a place [byte]; returns how much that was. What is left of a failed write is written over."""
    done = 0
    while done < len(data):
        done += os.pwrite(file, data[done:], at + done)
    return done
