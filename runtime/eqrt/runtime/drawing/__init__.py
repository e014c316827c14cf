"""What the SVG charts of several commands share."""
