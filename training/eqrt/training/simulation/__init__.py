"""Traffic simulated with SUMO, recorded as a car with sensors would have seen it."""
