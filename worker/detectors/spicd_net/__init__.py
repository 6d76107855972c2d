"""SPICD-Net (paper, Section 3.6): a Siamese PointNet with Chamfer statistics.

`layers`, `chamfer` and `network` are the network and need torch alone, `frozen` runs it fast, `training` says how it
is trained, `detector` makes it a detector.
"""
