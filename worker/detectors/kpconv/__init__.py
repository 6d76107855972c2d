"""Siamese-KPConv (paper, Table 6): rigid kernel point convolution on a grid-subsampled pyramid (Thomas et al. 2019).

`kernel_points` places the kernel's points, `pyramid` subsamples clouds and finds neighbours with NumPy, `network` is
the encoder, `training` and `detector` join it with what all Siamese networks of tiles share.
"""
