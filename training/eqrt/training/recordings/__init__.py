"""What recordings of traffic say: one reader per format, one form for all of them."""
