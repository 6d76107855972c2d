"""What a survey leaves: states of tiles, objects, coloured cloud, picture, manifest."""
