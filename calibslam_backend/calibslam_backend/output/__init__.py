"""Maps, metrics, plots, and the folder of a run."""
