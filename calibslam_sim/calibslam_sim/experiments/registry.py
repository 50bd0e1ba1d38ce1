"""Which experiments there are; a module is loaded only when its experiment is wanted."""

from __future__ import annotations

from importlib import import_module

from calibslam_sim.experiments.design import Experiment

# Name on the command line -> module with an EXPERIMENT.
MODULES = {
    "kalman": "calibslam_sim.experiments.kalman",
    "toy": "calibslam_sim.experiments.toy",
    "quadric_sim": "calibslam_sim.experiments.quadric_sim",
    "tum": "calibslam_sim.experiments.tum",
    "image": "calibslam_sim.experiments.image",
    "fcal": "calibslam_sim.experiments.fcal",
}


def load(name: str) -> Experiment:
    """The experiment of this name, a key of `MODULES`."""
    experiment: Experiment = import_module(MODULES[name]).EXPERIMENT
    return experiment
