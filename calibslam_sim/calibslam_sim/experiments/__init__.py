"""The document's experiments, one module each; `calibslam_sim.experiment` is their command line.

An experiment's module has an `EXPERIMENT` (see `design.Experiment`) and stands in `registry.MODULES`.
"""
