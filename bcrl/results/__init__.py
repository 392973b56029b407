"""Results on disk: their layout, reading and checking them, and live logging."""
