"""What the packages of CalibSLAM share: measurements, their messages, bags, settings and node helpers."""
