"""SPICD-Net (paper, Section 3.6): a Siamese PointNet with Chamfer statistics.

`layers` and `network` are the network and need torch alone, `frozen` runs it fast, `detector` makes it a
detector.
"""
