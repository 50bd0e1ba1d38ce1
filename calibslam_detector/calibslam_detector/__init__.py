"""Boxes with calibrated covariances: a calibrator for the boxes of any detector."""
