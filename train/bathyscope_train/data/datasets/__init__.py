"""Data sets as they lie on disk: readers, split lists, checks. Nothing here imports torch."""
