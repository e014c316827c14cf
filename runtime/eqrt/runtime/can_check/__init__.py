"""`eqrt can check`: what a profile makes of a recorded log, and whether that can be right."""
