"""Odometry from images with depth."""
