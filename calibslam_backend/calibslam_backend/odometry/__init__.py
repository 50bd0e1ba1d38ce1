"""From steps of odometry to motions between keyframes, with what they err by."""
