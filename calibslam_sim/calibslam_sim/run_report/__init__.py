"""Runs on one page: `calibslam_sim.report` is the command line."""
