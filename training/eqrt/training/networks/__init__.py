"""The networks: one module each, all of them speaking the model contract."""
