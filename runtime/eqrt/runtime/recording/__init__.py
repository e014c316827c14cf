"""Recordings: all that went into the service and came out of it, as MCAP files."""
