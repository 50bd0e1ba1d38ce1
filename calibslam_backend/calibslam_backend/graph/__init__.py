"""The factor graph: factors, their noise, and ISAM2."""
