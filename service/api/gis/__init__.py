"""What the features of all resources share: shapes, boxes, feeds, positions on Earth."""
