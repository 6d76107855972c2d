"""What a survey leaves: states of tiles, coloured cloud, picture, manifest."""
