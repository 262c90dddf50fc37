"""What serving and training must see alike: the field of view, the network's grid, cuts.

The one room of core that uses OpenCV; the extras ``serve`` and ``train`` bring it.
"""
