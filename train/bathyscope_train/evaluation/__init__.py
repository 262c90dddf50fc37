"""Evaluation in numpy: depth errors, trajectories, naive baselines, data set folders. Needs no torch."""
