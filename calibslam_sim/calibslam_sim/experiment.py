"""`experiment NAME --out DIR`: one of the document's experiments, with table, JSON, CSV and figure.

Conditions are compared on the same worlds and noise. Interrupt it as you like: the same command goes on where it
stopped, unless the code or a file it is computed from has changed. The same command gives the same numbers, whatever
the number of processes.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from calibslam_msgs_py.command import INTERRUPTED, ArgumentParser, command
from calibslam_msgs_py.progress import Progress
from calibslam_msgs_py.settings import SettingsError, add_arguments, from_arguments
from calibslam_sim.experiments.design import Experiment, ExperimentError, ExperimentSettings
from calibslam_sim.experiments.engine import run
from calibslam_sim.experiments.fingerprint import file_hashes, fingerprint
from calibslam_sim.experiments.outputs import result_of, table, write
from calibslam_sim.experiments.registry import MODULES, load
from calibslam_sim.experiments.run_store import RunStore


def perform(
    name: str,
    settings: ExperimentSettings,
    out: Path,
    repetitions: int,
    jobs: int = -1,
    backend: str = "loky",
    overwrite: bool = False,
    command: str = "",
) -> dict[str, object]:
    """Run an experiment, or what is missing of it in `out`, and write its results there; returns result.json.

    Raises:
        ExperimentError: it cannot be run with these settings, here, or in this folder.
    """
    experiment = load(name)
    conditions = experiment.conditions(settings)
    code = fingerprint()
    store = RunStore(out, name, settings, code, file_hashes(experiment.inputs(settings)), overwrite)
    wanted = store.missing(conditions, repetitions)
    with Progress(len(wanted), name) as progress:
        for repetition in run(name, settings, wanted, jobs, backend):
            store.add(repetition)
            progress.step()
    values = store.values(conditions, repetitions)
    result = result_of(name, experiment, settings, values, code, command, store.seconds(conditions, repetitions))
    write(result, out)
    experiment.figure(result, out / f"{name}.png")
    return result


def _name(arguments: Sequence[str]) -> str:
    """The experiment that the first argument names."""
    parser = ArgumentParser(
        prog="experiment",
        usage="experiment NAME --out DIR [--quick] [options]",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="experiment NAME --help tells the options of one experiment.",
    )
    parser.add_argument("name", choices=sorted(MODULES), metavar="NAME", help=", ".join(sorted(MODULES)))
    return str(parser.parse_args(arguments[:1]).name)


def _parser(name: str, experiment: Experiment, is_quick: bool) -> argparse.ArgumentParser:
    """The options of an experiment, with its defaults or the quick ones."""
    parser = ArgumentParser(
        prog=f"experiment {name}",
        description=f"{experiment.title}\n\n{__doc__}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    repetitions = experiment.quick_seeds if is_quick else experiment.seeds
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the result")
    parser.add_argument("--quick", action="store_true", help="reduced sizes: whether it runs, not what is true")
    parser.add_argument("--seeds", type=_positive, default=repetitions, help="repetitions (default: %(default)s)")
    parser.add_argument("--jobs", type=_jobs, default=-1, help="processes (default: one for each core)")
    parser.add_argument(
        "--backend",
        default="loky",
        help="of joblib, by name: loky, multiprocessing, sequential; dask at DASK_SCHEDULER_ADDRESS, or ray at "
        "RAY_ADDRESS, where installed (default: %(default)s)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="begin anew in a folder that is in use, as after a change of code"
    )
    add_arguments(parser, experiment.settings)
    if is_quick:
        parser.set_defaults(**experiment.quick)
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return number


def _jobs(text: str) -> int:
    number = int(text)
    if number == 0:
        raise argparse.ArgumentTypeError("must be at least 1, or -1 for one for each core")
    return number


@command
def main(argv: Sequence[str] | None = None) -> int:
    """Command line of `experiment`; returns the exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    name = _name(words)
    experiment = load(name)
    arguments = _parser(name, experiment, "--quick" in words).parse_args(words[1:])
    command = shlex.join(["./calibslam", "run", "calibslam_sim", "experiment", *words])
    try:
        settings = from_arguments(arguments, experiment.settings)
        result = perform(
            name,
            settings,
            arguments.out,
            arguments.seeds,
            arguments.jobs,
            arguments.backend,
            arguments.overwrite,
            command,
        )
    except KeyboardInterrupt:
        print("experiment: interrupted; the same command goes on where it stopped", file=sys.stderr)
        return INTERRUPTED
    except (ExperimentError, SettingsError) as error:
        print(f"experiment: {error}", file=sys.stderr)
        return 1
    print(f"{experiment.title}\n\n{table(result, experiment.metrics)}\n")
    print(f"{arguments.out}/: result.json, result.csv, {name}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
