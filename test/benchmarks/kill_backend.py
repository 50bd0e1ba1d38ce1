"""The back end is killed (-9) at random moments of a recording and started again at once: what that costs.

    ./calibslam shell -c 'python test/benchmarks/kill_backend.py [RECORDING] [--kills 20] [--per-run 5] [--rate 1]'

RECORDING is a bag or a folder in TUM format (default: fr3_office of the shared data). After each run the map is saved
and its ATE compared with that of an undisturbed run, in processes too. Returns 1 unless all are within 2 %.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import helpers_on_path  # noqa: F401
import numpy as np
from calibslam_msgs.srv import SaveMap
from live import Watcher, kept, random_domain, wait_until
from live_graph import DATA, Player, backend, recording_of, truth_of

from calibslam_backend.output.metrics import Trajectory, ate
from calibslam_backend.output.object_map import ObjectMap
from calibslam_backend.recording import Recording
from calibslam_msgs_py.measurements import Boxes

ALLOWED = 0.02
# A pause in which a process starts is no rest in which the map is to be refined.
REFINE_AFTER = 20.0  # [s]


def run(recording: Recording, truth: Trajectory, moments: list[float], rate: float, scratch: Path) -> float:
    """ATE [m] at the end of a run in which the back end is killed at these shares of the recording."""
    measurements = list(recording.measurements())
    images = sum(isinstance(m, Boxes) for m in measurements)
    domain = random_domain()
    parameters = [f"journal:={scratch / 'journal'}", f"map_folder:={scratch}", f"refine_after:={REFINE_AFTER}"]
    parameters += kept("/detections", "/relative_pose")
    with Watcher(domain) as watcher:
        player = Player(watcher, recording.camera)
        process = backend(domain, *parameters)
        try:
            wait_until(lambda: watcher.sees("/backend"), lambda: process.output)
            playing = threading.Thread(target=player.play, args=(measurements, rate), daemon=True)
            playing.start()
            for moment in moments:
                wait_until(lambda m=moment: player.share >= m, "the recording does not go on", timeout=600.0)
                if not process.running:
                    raise SystemExit(f"the back end has ended by itself:\n{process.output}")
                process.end(signal.SIGKILL)
                process.__exit__()
                process = backend(domain, *parameters)
            playing.join()
            wait_until(
                lambda: used(watcher.counts("/backend")) >= images,
                lambda: f"{images} images, but {watcher.counts('/backend')}",
                timeout=600.0,
            )
            path = scratch / "map.json"
            saved = watcher.call(SaveMap, "/backend/save_map", path=str(path), timeout=300.0)
            if not saved.success:
                raise SystemExit(saved.message)
            counts = watcher.counts("/backend")
            shown = ("rejected_r", "rejected_o", "odometry", "errors", "lost", "journal")
            print(f"  journal {(scratch / 'journal').stat().st_size / 1e6:.1f} MB,", end=" ")
            print({name: count for name, count in counts.items() if name.startswith(shown)}, flush=True)
            process.end()
        finally:
            process.__exit__()
    known = ObjectMap.load(path)
    return ate(Trajectory(np.array(known.stamps), known.poses), truth)


def used(counts: dict[str, str]) -> int:
    """Images that were used or left out for good."""
    return sum(int(counts.get(name, 0)) for name in ("images", "rejected_late", "rejected_image_size"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", type=Path, default=DATA / "fr3_office", metavar="RECORDING")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--per-run", type=int, default=5, help="kills in one run of the recording (default: 5)")
    parser.add_argument("--rate", type=float, default=1.0, help="times real time (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    arguments = parser.parse_args()
    draw = random.Random(arguments.seed)
    worst = 0.0
    with recording_of(arguments.recording) as recording:
        truth = truth_of(recording)
        kills: list[float] = []
        expected = None
        while expected is None or len(kills) < arguments.kills:
            moments = sorted(draw.random() for _ in range(arguments.per_run)) if expected is not None else []
            began = time.monotonic()
            with tempfile.TemporaryDirectory() as scratch:
                error = run(recording, truth, moments, arguments.rate, Path(scratch))
            kills += moments
            expected = error if expected is None else expected
            difference = error / expected - 1.0
            worst = max(worst, abs(difference))
            print(
                f"killed at {[f'{m:.0%}' for m in moments]}: ATE {error:.5f} m, {difference:+.2%}, "
                f"{time.monotonic() - began:.0f} s",
                flush=True,
            )
    print(f"{len(kills)} kills: ATE at most {worst:.2%} from {expected:.5f} m (allowed: {ALLOWED:.0%})")
    return 0 if worst <= ALLOWED else 1


if __name__ == "__main__":
    sys.exit(main())
