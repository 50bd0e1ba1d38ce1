"""The network: boxes and their covariances from images."""
