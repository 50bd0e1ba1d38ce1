"""The one module that reads and writes bags: rosbag2 folders in MCAP format, through rosbags, without ROS.

What is written, `ros2 bag`, the mcap tools and Foxglove read: CDR messages, their definitions inside, chunks
compressed with zstd. The same input gives the same bytes (rosbags writes no times or identifiers of its own).
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

from calibslam_msgs_py.bag_types import BagError, BagTypes, calibslam_typestore, new_typestore
from calibslam_msgs_py.files import partial_of

__all__ = ["BagError", "BagReader", "BagWriter", "refuse_to_replace", "types"]

# The message classes of bags, for `conversions`.
types = BagTypes()

# The metadata format of ROS 2 Jazzy.
ROSBAG2_VERSION: Literal[9] = 9


class BagReader:
    """Reads a rosbag2 folder or a single .mcap file; a context manager.

    Attributes:
        path: of the bag.
        topics: name -> message type.
        counts: name -> number of messages.
        start, end: log times of the first and last message [ns]; 0 where there is none.
        rejected: topic -> number of messages that could not be decoded and were skipped.

    Raises:
        BagError: no bag, or one that cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.rejected: Counter[str] = Counter()
        self._reader = _open(self.path)
        connections = self._reader.connections
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in sorted(connections, key=lambda c: c.topic)}
        self.counts: Counter[str] = Counter()
        for connection in connections:
            self.counts[connection.topic] += connection.msgcount
        empty = self._reader.message_count == 0
        self.start = 0 if empty else self._reader.start_time
        self.end = 0 if empty else self._reader.end_time - 1  # rosbags gives the time after the last

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time [ns], message) of these topics in the order of the log times.

        Raises:
            BagError: a topic is missing, its type is unknown, or the file is damaged.
        """
        connections = self._connections(topics)
        store = self._typestore(connections)
        for connection, time, data in self._raw(connections):
            try:
                message = store.deserialize_cdr(data, connection.msgtype)
            except Exception:  # whatever garbage makes of generated code
                self.rejected[connection.topic] += 1
                continue
            yield connection.topic, time, message

    def raw_messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """As `messages`, but serialised (CDR), as an rclpy publisher takes them."""
        for connection, time, data in self._raw(self._connections(topics)):
            yield connection.topic, time, bytes(data)

    def _connections(self, topics: Collection[str]) -> list[Connection]:
        if missing := sorted(set(topics) - set(self.topics)):
            there = "\n".join(f"  {name}  ({kind}, {self.counts[name]})" for name, kind in self.topics.items())
            raise BagError(f"{self.path} has no topic {', '.join(missing)}; it has:\n{there or '  none'}")
        return [connection for connection in self._reader.connections if connection.topic in topics]

    def _typestore(self, connections: list[Connection]) -> Typestore:
        """The definitions inside the bag; those of ROS 2 Jazzy and of this version where it has none."""
        store = get_typestore(Stores.EMPTY)
        for connection in connections:
            try:
                store.register(self._definitions(connection))
            except TypesysError as error:
                raise self._unusable(connection, error) from error
        return store

    def _definitions(self, connection: Connection) -> Typesdict:
        """The type of a topic with all that it consists of."""
        name, definition = connection.msgtype, connection.msgdef
        text = definition.data
        if not text.strip():  # recorded where the type was not installed, or by an old version of ROS
            fallback = calibslam_typestore()
            if name not in fallback.fielddefs:
                raise BagError(
                    f"{self.path}: unknown message type {name} (topic {connection.topic}): the bag holds "
                    "no definition of it; record it again where that package is installed"
                )
            text = fallback.generate_msgdef(name, ros_version=2)[0]
        try:
            if definition.format is MessageDefinitionFormat.IDL:
                return get_types_from_idl(text)
            return get_types_from_msg(text, name)
        except Exception as error:
            raise self._unusable(connection, error) from error

    def _unusable(self, connection: Connection, error: Exception) -> BagError:
        return BagError(
            f"{self.path}: the definition of {connection.msgtype} (topic {connection.topic}) is not usable: {error}"
        )

    def _raw(self, connections: list[Connection]) -> Iterator[tuple[Connection, int, bytes | memoryview]]:
        messages = self._reader.messages(connections) if connections else iter(())
        while True:
            try:
                item = next(messages)
            except StopIteration:
                return
            except Exception as error:  # rosbags passes on whatever a damaged chunk raises
                raise _damaged(self.path, error) from error
            yield item


def _open(path: Path) -> Reader:
    if not path.exists():
        raise BagError(f"{path} does not exist; expected a rosbag2 folder or an .mcap file")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise BagError(
                f"{path} is not a rosbag2 folder: it has no metadata.yaml and {len(files)} .mcap files; "
                f"if it was recorded and interrupted: ros2 bag reindex {path}"
            )
        path = files[0]  # an interrupted recording: the file may well be complete
    if path.is_file() and path.suffix not in (".mcap", ".db3"):
        raise BagError(f"{path} is not a bag; expected a rosbag2 folder or an .mcap file")
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # rosbags passes on whatever a damaged file raises
        raise _damaged(path, error) from error
    return reader


def _damaged(path: Path, error: Exception) -> BagError:
    files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    file = files[0] if files else path / "FILE.mcap"
    reason = str(error) or type(error).__name__
    return BagError(
        f"{path} cannot be read, it is truncated or damaged ({reason}); "
        f"recover what is left with: mcap recover {file} -o recovered.mcap"
    )


class BagWriter:
    """Writes a rosbag2 folder, or a single file if the path ends in .mcap; a context manager.

    It is written beside its place and put there when it is complete. If the context is left by an exception, or the
    disk is full, nothing of it stays behind, and a bag that was to be replaced is as it was.

    Args:
        path: of the bag; missing parent folders are made.
        overwrite: replace an existing bag (never anything that is not a bag).

    Raises:
        BagError: the path exists, or cannot be written.
    """

    def __init__(self, path: str | Path, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._overwrite = overwrite
        self._refuse_to_lose()
        self._single_file = self.path.suffix == ".mcap"
        # A bag holds its own name: the folder in which it is written has another one, not the bag.
        self._scratch = partial_of(self.path)
        self._store = calibslam_typestore()
        self._connections: dict[str, Connection] = {}
        try:
            if self._scratch.exists():
                shutil.rmtree(self._scratch)
            # rosbags writes folders only: of a single file's, the file is moved out at the end.
            folder = self._scratch / (self.path.stem if self._single_file else self.path.name)
            self._writer = Writer(folder, version=ROSBAG2_VERSION, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except OSError as error:
            shutil.rmtree(self._scratch, ignore_errors=True)
            raise self._unwritable(error) from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._writer.close()
                self._put_in_place()
        except OSError as failure:
            raise self._unwritable(failure) from failure
        finally:
            with suppress(OSError):  # what is left of it does not fit on the disk either
                self._writer.abort()
            shutil.rmtree(self._scratch, ignore_errors=True)

    def _put_in_place(self) -> None:
        """Move what was written to its path, and what is there out of the way first; it goes with the scratch."""
        self._refuse_to_lose()  # somebody may have put something there meanwhile
        written = self._writer.path
        if self._single_file:
            written = written / f"{self.path.stem}.mcap"
        if not _is_there(self.path) or (self._single_file and not self.path.is_dir()):
            written.replace(self.path)
            return
        replaced = self._scratch / f"{self.path.name}.replaced"
        self.path.rename(replaced)
        try:
            written.rename(self.path)
        except BaseException:
            replaced.rename(self.path)
            raise

    def _refuse_to_lose(self) -> None:
        """Refuse to replace what is there, unless it is a bag and this is wanted."""
        if not _is_there(self.path):
            return
        if not self._overwrite:
            raise BagError(f"{self.path} exists already; choose another path, or replace it: --overwrite")
        _refuse_unless_bag(self.path)

    def _unwritable(self, error: OSError) -> BagError:
        return BagError(f"cannot write {self.path}: {error.strerror or error}; make room, or choose another path")

    def write(self, topic: str, message: Any, stamp: int) -> None:
        """Add a message of `bags.types` at a log time [ns]; the topic is made with the first message."""
        kind = message.__msgtype__
        self.write_raw(topic, kind, self._store.serialize_cdr(message, kind), stamp)

    def write_raw(self, topic: str, kind: str, data: bytes | memoryview, stamp: int) -> None:
        """Add a serialised (CDR) message of type `kind`, such as "nav_msgs/msg/Path"."""
        self.add_topic(topic, kind)
        try:
            self._writer.write(self._connections[topic], int(stamp), data)
        except OSError as error:
            raise self._unwritable(error) from error

    def adopt(self, bag: BagReader) -> list[str]:
        """Learn the message types of another bag; returns its topics whose messages can be copied as they are.

        Not those of which the bag holds no definition, or one that contradicts ours of the same name.
        """
        self._store = new_typestore()
        topics = set()
        for connection in bag._reader.connections:
            try:
                self._store.register(bag._definitions(connection))
            except (BagError, TypesysError):
                continue
            topics.add(connection.topic)
        return sorted(topics)

    def add_topic(self, topic: str, kind: str) -> None:
        """Make a topic, also if no message follows.

        Raises:
            BagError: the type is unknown, or the topic has another type.
        """
        connection = self._connections.get(topic)
        if connection is None:
            if kind not in self._store.fielddefs:
                raise BagError(f"unknown message type {kind} for topic {topic}")
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        elif connection.msgtype != kind:
            raise BagError(f"topic {topic} has type {connection.msgtype}, not {kind}")


def refuse_to_replace(out: Path, *read: str | Path) -> None:
    """Refuse to write where something is read from; call it before anything is written.

    Args:
        out: bag or other file to write.
        read: bags, each a folder or a file.

    Raises:
        BagError: `out` is such a bag, a file in it, or the folder that it lies in, whatever links lead there.
    """
    if not out.exists():
        return
    for bag in map(Path, read):
        for part in [bag, *(bag.iterdir() if bag.is_dir() else ())]:
            lost = [part, *part.absolute().parents, *Path(os.path.realpath(part)).parents]
            if any(place.exists() and place.samefile(out) for place in lost):
                raise BagError(f"{out} would replace {part}, which is read: choose another path for the result")


def _is_there(path: Path) -> bool:
    """Whether a path is taken, if only by a link that leads nowhere."""
    return path.exists() or path.is_symlink()


def _refuse_unless_bag(path: Path) -> None:
    """Refuse to replace anything but a bag."""
    if path.is_file() and path.suffix == ".mcap":
        return
    foreign = (
        [p for p in path.iterdir() if p.name != "metadata.yaml" and p.suffix != ".mcap"] if path.is_dir() else [path]
    )
    if foreign:
        raise BagError(f"{path} is not overwritten: it is not a bag, or holds other files ({foreign[0].name})")
