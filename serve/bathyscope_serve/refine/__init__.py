"""Cameras and depth made to agree with points that are followed through the video: bundle adjustment."""
