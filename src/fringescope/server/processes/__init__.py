"""The hub's two other processes: the instrument, which holds the devices, and the workshop, which computes.

So that no computation and no browser can keep the projector's process waiting, and none of them can take the hub down.
"""
