"""Images and depth images of the simulated desk."""
