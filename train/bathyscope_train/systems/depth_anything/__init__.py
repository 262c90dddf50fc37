"""What the systems built on Depth Anything share: Video Depth Anything, EndoDAC and EndoDAV.

::

    encoder.py     the DINOv2 transformer without registers, tapped at four blocks
    positions.py   the learnt position table, resized by a factor as published
    pyramid.py     the DPT trunk: four tapped layers to four fused paths, with a place for something between them
    adapters.py    linear layers with low-rank or scaling adapters, and how to merge them away
    neck.py        the convolutional neck after chosen blocks
    disparity.py   sigmoid disparity heads
    option_sets.py which adapters and necks a checkpoint has, by its keys
    schedule.py    what is trained of an adapted network, and when

From disparity to depth: :mod:`bathyscope.depth_range`. Parameters are named as in the published checkpoints.
"""
