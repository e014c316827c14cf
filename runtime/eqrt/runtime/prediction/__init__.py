"""The model file, the map tile, and the last check on what they give."""
