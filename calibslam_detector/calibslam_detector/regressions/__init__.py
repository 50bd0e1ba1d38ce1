"""Two small regressions on which losses for covariances are compared; docs/calibration.md tells how and why so."""
