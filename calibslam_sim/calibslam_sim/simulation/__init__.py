"""A desk, a camera that moves around it, a detector and odometry that err as they say."""
