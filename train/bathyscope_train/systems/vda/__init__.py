"""Video Depth Anything: per-frame features, temporal attention in the head, windows stitched by scale and shift.

::

    settings.py   sizes of the published networks
    temporal.py   the temporal module
    head.py       the DPT head with four of them
    network.py    images to disparity (relative weights) or depth in metres (metric weights)
    loading.py    published weights into a network, key by key
    system.py     the system of the tables
    training.py   the network under a consistency loss, with somebody else's cameras

Parameters are named as in the published checkpoints. Windows and stitching are in :mod:`bathyscope.keyed_windows` and
:mod:`bathyscope.affine_stitch`, because the service needs them too.
"""
