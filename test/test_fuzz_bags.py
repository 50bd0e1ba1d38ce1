"""Bags spoilt at random: slam_bag gives a result that counts what it left out, or one line that says what is wrong.

Size as in test_fuzz_messages.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from fuzzing import fuzz
from mutations import spoilt_bytes, spoilt_message
from rosbags.rosbag2 import StoragePlugin, Writer
from small_bag import Message, messages, write
from small_world import SmallWorld, around, objects

from calibslam_backend import slam_bag
from calibslam_msgs_py.bag_types import calibslam_typestore

WORLD = SmallWorld(around(25), objects())
CONTENT = list(messages(WORLD))
# Definitions with the names of ours and other fields, as an older or a foreign package might have them.
OTHER_DEFINITIONS = (
    "std_msgs/Header header\nfloat32[4] corners\n",
    "string text\n",
    "uint8[] data\nfloat64 x\n",
    "",
    "float64[4 corners\n",
)
Spoil = Callable[[Path, Path, Random], None]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("valid") / "bag", CONTENT)


def the_file(bag: Path) -> Path:
    return next(bag.glob("*.mcap"))


def bytes_of_the_file(bag: Path, out: Path, random: Random) -> None:
    """Flipped bits, other lengths, pieces cut out or off."""
    shutil.copytree(bag, out)
    data = the_file(bag).read_bytes()
    for _ in range(random.choice((1, 1, 5))):
        data = spoilt_bytes(data, random) if random.random() < 0.9 else data[: random.randrange(len(data))]
    the_file(out).write_bytes(data)


def metadata(bag: Path, out: Path, random: Random) -> None:
    """Missing, of another recording, or spoilt."""
    shutil.copytree(bag, out)
    file = out / "metadata.yaml"
    kind = random.randrange(4)
    if kind == 0:
        file.unlink()
    elif kind == 1:
        the_file(out).rename(out / "other.mcap")
    elif kind == 2:
        file.write_bytes(spoilt_bytes(file.read_bytes(), random))
    else:
        lines = file.read_text().splitlines()
        del lines[random.randrange(len(lines))]
        file.write_text("\n".join(lines))


def stamps(bag: Path, out: Path, random: Random) -> None:
    """Log times or stamps of the messages swapped, messages twice, left out, or moved far away in time."""
    content = list(CONTENT)
    for _ in range(random.choice((1, 3, 30))):
        i, j = random.randrange(len(content)), random.randrange(len(content))
        (topic, time, message), other = content[i], content[j]
        kind = random.randrange(5)
        if kind == 0:
            content[i], content[j] = (topic, other[1], message), (other[0], time, other[2])
        elif kind == 1:
            content[i] = (topic, time, replace(message, header=other[2].header))
        elif kind == 2:
            content.insert(j, content[i])
        elif kind == 3 and len(content) > 1:
            del content[i]
        else:
            content[i] = (topic, max(0, time + random.choice((-1, 1)) * 10 ** random.randrange(1, 19)), message)
    write(out, content)


def fields(bag: Path, out: Path, random: Random) -> None:
    """Nonsense in the messages."""
    write(out, [spoilt_entry(entry, random) for entry in CONTENT])


def spoilt_entry(entry: Message, random: Random) -> Message:
    topic, time, message = entry
    return (topic, time, spoilt_message(message, random, lengths_too=False) if random.random() < 0.1 else message)


def schemas(bag: Path, out: Path, random: Random) -> None:
    """One topic with another definition, another type, another name, or with bytes that are no message."""
    store, kind = calibslam_typestore(), random.randrange(4)
    spoilt = random.choice(sorted({topic for topic, _, _ in CONTENT}))
    with Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, time, message in CONTENT:
            name = message.__msgtype__
            data = bytes(store.serialize_cdr(message, name))
            if topic not in connections:
                changes: dict[str, str] = {"msgdef": store.generate_msgdef(name, ros_version=2)[0]}
                written_as, title = name, topic
                if topic == spoilt and kind == 0:
                    changes["msgdef"] = random.choice(OTHER_DEFINITIONS)
                elif topic == spoilt and kind == 1:
                    written_as = random.choice(("std_msgs/msg/String", "other_msgs/msg/Unknown", "nonsense"))
                elif topic == spoilt and kind == 2:
                    title = random.choice(("/other", topic.upper(), topic + "/"))
                connections[topic] = writer.add_connection(
                    title, written_as, msgdef=changes["msgdef"], rihs01="RIHS01_" + 64 * "0"
                )
            if topic == spoilt and kind == 3 and random.random() < 0.5:
                data = spoilt_bytes(data, random)
            writer.write(connections[topic], time, data)


@pytest.mark.parametrize("spoil", [bytes_of_the_file, metadata, stamps, fields, schemas])
def test_spoilt_bags(
    spoil: Spoil, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    ended = {0: 0, 1: 0}

    def run(random: Random) -> None:
        spoilt, out = tmp_path / "spoilt", tmp_path / "run"
        for folder in (spoilt, out):
            shutil.rmtree(folder, ignore_errors=True)
        spoil(bag, spoilt, random)
        code = slam_bag.main([str(spoilt), "--out", str(out)])
        said = capsys.readouterr()
        caplog.clear()
        ended[code] += 1
        if code == 0:
            metrics = json.loads((out / "metrics.json").read_text())
            assert metrics["keyframes"] > 0 and np.isfinite(metrics["wall_s"])
            assert np.isfinite(np.loadtxt(out / "trajectory.tum", ndmin=2)).all()
        else:
            assert said.err.startswith("error: ") and len(said.err) < 3000, said.err
            assert len(said.err.strip()) > len("error:"), "no reason given"

    fuzz(run, few=3, many=110)
    assert sum(ended.values()) >= 3
