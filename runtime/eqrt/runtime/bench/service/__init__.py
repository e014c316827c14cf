"""How fast the whole service answers on a bus: traffic, service and measuring are processes."""
