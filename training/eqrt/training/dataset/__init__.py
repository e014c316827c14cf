"""Training data on disk: windows cut from recordings, in memory-mapped shards."""
