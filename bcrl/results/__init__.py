"""A seed's result files: one definition for writer and reader."""
