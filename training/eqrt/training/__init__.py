"""The workstation: data, networks and training."""
