"""Simulated worlds, odometry, bags, replay and evaluation for CalibSLAM."""
