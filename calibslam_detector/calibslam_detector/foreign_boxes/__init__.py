"""Covariances for the boxes of somebody else's detector."""
