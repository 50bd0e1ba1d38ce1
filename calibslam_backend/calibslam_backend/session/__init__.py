"""A live estimator: what waits for it, its sense of time, its journal."""
