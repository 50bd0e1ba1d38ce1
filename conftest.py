"""For all tests, in every process that runs some of them."""

from __future__ import annotations

import os

from dds_domain import reserved_domain
from hypothesis import settings

# What is started in DDS without a domain of its own meets nobody.
DOMAIN, RESERVATION = reserved_domain()
os.environ["ROS_DOMAIN_ID"] = str(DOMAIN)

# Before torch and others are imported. For small tensors more threads only wait for each other, and where the machine
# has other work, they wait for long: up to ten times the processor time.
os.environ["OMP_NUM_THREADS"] = "1"

# No test of time: a busy machine lets one wait for a second at any place.
settings.register_profile("calibslam", parent=settings.default, deadline=None)
settings.load_profile("calibslam")
