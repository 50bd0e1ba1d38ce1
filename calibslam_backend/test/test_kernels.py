"""What numba compiles is compiled before the first measurement."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association import ESTIMATED
from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.kernels import load_kernels


def compiled() -> dict[str, list[str]]:
    """The argument types that each function of the back end is compiled for."""
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("calibslam_backend.")]
    found = {}
    for module in modules:
        for value in vars(module).values():
            if hasattr(value, "nopython_signatures"):
                name = f"{value.py_func.__module__}.{value.py_func.__name__}"
                found[name] = sorted(map(str, value.nopython_signatures))
    return found


def test_a_run_compiles_nothing() -> None:
    load_kernels()
    before = compiled()
    world = replace(SmallWorld(around(120, turn=2.0), objects()), seed=1)
    estimator = Estimator(CAMERA, np.eye(4), EstimatorSettings(association=ESTIMATED))
    for measurement in world.measurements():
        estimator.add(measurement)
    estimator.finish()
    assert estimator.objects
    assert before["calibslam_backend.revision.squared_distances"]
    assert compiled() == before
