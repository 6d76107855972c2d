"""What the Siamese networks of tiles share: only the encoder of a patch differs from one to the next.

`layers`, `chamfer` and `head` are parts of networks and need torch alone, `network` joins an encoder with the head,
`training` says how such a network is trained, `detector` makes it a detector.
"""
