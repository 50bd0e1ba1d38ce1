"""Covariances that mean what they say: losses, recalibration, metrics. docs/calibration.md derives them."""
