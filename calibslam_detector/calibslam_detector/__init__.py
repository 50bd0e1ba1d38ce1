"""Boxes with calibrated covariances: a detector and its training, and a calibrator for the boxes of any detector."""
