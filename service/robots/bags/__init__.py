"""Scans of ROS recordings: point clouds of a topic with the poses that the recording has. Needs `spicd[ros]`."""
