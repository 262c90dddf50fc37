"""What the systems built on Depth Anything share: Video Depth Anything, EndoDAC and EndoDAV.

::

    encoder.py     the DINOv2 transformer without registers; its position table is resized by factor, not by size
    pyramid.py     the DPT trunk: four tapped layers to four fused paths, with a place for something between them
    adapters.py    linear layers with low-rank or scaling adapters, and how to merge them away
    neck.py        the convolutional neck after chosen blocks
    disparity.py   sigmoid disparity heads, and from disparity to depth

Parameters are named as in the published checkpoints.
"""
