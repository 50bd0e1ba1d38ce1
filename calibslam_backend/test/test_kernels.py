"""What numba compiles is compiled before the first measurement."""

from __future__ import annotations

import sys
from dataclasses import replace

import numba
import numpy as np
import pytest
from numba.core.event import install_listener
from small_world import CAMERA, SmallWorld, around, objects

from calibslam_backend.association.matching import ESTIMATED
from calibslam_backend.estimator import Estimator, EstimatorSettings
from calibslam_backend.kernels import Announcement, load_kernels


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
    assert before["calibslam_backend.association.revision.squared_distances"]
    assert compiled() == before


def test_compiling_is_announced_once(capsys: pytest.CaptureFixture[str]) -> None:
    with install_listener("numba:compile", Announcement()):
        assert capsys.readouterr().err == ""
        for _ in range(2):  # neither is in a cache
            assert numba.njit(lambda x: x + 1)(1) == 2
    assert numba.njit(lambda x: x + 2)(1) == 3
    assert capsys.readouterr().err.count("compiling, only this once") == 1
