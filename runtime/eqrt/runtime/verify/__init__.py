"""Is this artifact what the contract promises? Checked on the machine that will run it."""
