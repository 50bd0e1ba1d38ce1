"""Object SLAM from boxes that carry their own covariances: geometry, factors, map."""
