"""Whole evaluations: many systems on many data sets, resumable, with tables, plots and comparisons."""
