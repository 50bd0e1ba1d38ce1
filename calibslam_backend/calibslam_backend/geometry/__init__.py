"""Ellipsoids, the boxes they project to, and boxes as they are measured."""
