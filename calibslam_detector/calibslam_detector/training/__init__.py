"""How the detector and its covariance head are trained."""
