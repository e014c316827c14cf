"""How fast the model answers here, what it costs, and whether the figures can be trusted."""
