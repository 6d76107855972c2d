"""Siamese-PointNet++ (paper, Table 6): set abstraction by farthest points and ball query (Qi et al. 2017).

`grouping` finds centres and neighbours with NumPy, `network` is the encoder, `training` and `detector` join it with
what all Siamese networks of tiles share.
"""
